"""`lsmgeo evaluate`: a table or figure of the paper from trained models."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

__all__ = ["evaluate"]


def evaluate(
    checkpoints: str,
    report: str = "auto",
    shards: str | None = None,
    shapes: int | None = None,
    views: int | None = None,
    out: str = "lsmgeo-evaluate",
    seed: int = 0,
    batch: int = 4,
    threshold: float = 0.4,
    background: str = "random",
    degrees: str = "0,5,10,15,20",
    orders: int = 8,
    planes: int = 300,
    split: Literal["test", "val", "train"] = "test",
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """Make a table or figure of the paper from trained models: printed, and written as JSON, CSV and images.

    How a model was trained is read from its file.

    Args:
        checkpoints: weights, checkpoints or run folders of lsmgeo train, separated by commas, each PATH or NAME=PATH,
            such as runs/vlsm,R2N2=runs/r2n2.
        report: for voxel models, "iou": IoU by views and categories, with visual hulls (tables 1, 3, 4);
            "backgrounds": IoU on white and other backgrounds; "unseen": its drop on categories that were not trained on
            (for models trained on all, the first and the second categories); "pose-noise": IoU by the noise of poses;
            "order": its spread over orders of the views; "sequences": images after each view. For depth models,
            "depth": the error, with that of plane sweep (table 5); "clouds": shaded depth and point clouds. "auto" is
            iou or depth.
        shards: a folder of shards, from lsmgeo render or lsmgeo convert; by default synthetic-13.
        shapes: their number, from the categories in turn; by default all of the shards, 130 of synthetic-13, and fewer
            if every shape is drawn (sequences 13, clouds 3) or measuring is slow (depth 26).
        views: the largest number of views; by default as in the paper: 8, 4 for backgrounds, pose-noise and sequences,
            10 for depth, 20 for clouds.
        out: folder for the results; created if it does not exist.
        seed: seed of the order of views and of noise.
        batch: shapes at a time.
        threshold: threshold on probabilities, for IoU.
        background: for backgrounds: random, or a folder of images.
        degrees: for pose-noise, the largest angles, separated by commas.
        orders: for order, the number of orders.
        planes: for depth and clouds, the number of planes of the plane sweep.
        split: the part of the set.
        device: auto is a GPU if there is one.

    Returns:
        The exit status.
    """
    import time

    import torch

    from lsmgeo import evaluation
    from lsmgeo._checks import check_choice
    from lsmgeo.errors import OptionError

    check_choice("evaluate", "report", report, ("auto", *evaluation.REPORTS))
    try:
        angles = tuple(float(angle) for angle in degrees.split(","))
    except ValueError:
        raise OptionError(f"degrees must be numbers separated by commas, such as 0,10,20; got {degrees!r}") from None
    options = evaluation.Options(
        views=views,
        threshold=threshold,
        batch=batch,
        seed=seed,
        background=background,
        degrees=angles,
        orders=orders,
        planes=planes,
        progress=True,
    )
    start = time.perf_counter()
    methods = evaluation.open_methods(
        checkpoints, ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    )
    if report == "auto":
        report = "depth" if methods[0].has_depth else "iou"
    if shapes is None:
        shapes = evaluation.REPORTS[report].shapes
    size = max(method.size for method in methods)
    found = evaluation.open_shapes(shards, size=size, shapes=shapes, seed=seed, split=split)
    made = evaluation.evaluate(methods, found, report, options)
    print(f"data:     {found.about}" + ("" if shards is None else f", {Path(shards).resolve()}"))
    for method in methods:
        print(f"model:    {method.name}, {method.path}")
    _print_report(made, evaluation.write_report(made, out), Path(out), time.perf_counter() - start)
    return 0


def _print_report(report: Any, written: list[Path], out: Path, seconds: float) -> None:
    from lsmgeo.evaluation import format_table

    for table in report.tables:
        print(f"\n{format_table(table)}")
    kinds = sorted({path.suffix[1:].upper() for path in written})
    print(f"\ntime:     {seconds:.1f} s")
    print(f"written:  {len(written)} files ({', '.join(kinds)}) in {out.resolve()}")
    for note in report.notes:
        print(f"lsmgeo: warning: {note}", file=sys.stderr)
