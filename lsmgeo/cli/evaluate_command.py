"""`lsmgeo evaluate`: a table or figure of the paper from trained models."""

from __future__ import annotations

import sys
from typing import Literal

__all__ = ["evaluate"]


def evaluate(
    checkpoints: str,
    report: Literal[
        "auto", "iou", "backgrounds", "unseen", "pose-noise", "order", "sequences", "depth", "clouds"
    ] = "auto",
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
    """Make a table or figure of the paper from trained models: printed, and written as JSON, CSV and pictures.

    Every figure takes its models in one list; what each of them is and was trained on stands in its file. The data are
    the test shapes of shards, or of synthetic-13, which are rendered as they are needed.

    Args:
        checkpoints: files of weights, checkpoints or run folders of lsmgeo train, with commas between, each PATH or
            NAME=PATH, such as runs/vlsm,R2N2=runs/r2n2.
        report: "iou" is voxel IoU by views and categories beside visual hulls (tables 1, 3, 4), "backgrounds" that in
            front of white and of other backgrounds, "unseen" its drop on categories that were not trained on (it takes
            models trained on all, the first and the second categories), "pose-noise" its curve over wrong poses,
            "order" its spread over orders of the views, "sequences" pictures after each view; of depth models,
            "depth" is the error beside plane sweep's (table 5) and "clouds" shaded depth and point clouds. "auto" is
            iou or depth.
        shards: a folder of shards, as lsmgeo render and lsmgeo convert make them; by default synthetic-13.
        shapes: how many, from the categories in turn; by default all of the shards, 130 of synthetic-13, and fewer
            where every shape is drawn (sequences 13, clouds 3) or it takes long (depth 26).
        views: the largest number of views; by default what the paper has: 8, 4 for backgrounds, pose-noise and
            sequences, 10 for depth, 20 for clouds.
        out: folder for the results; created where it does not exist.
        seed: decides the order of views, and noise.
        batch: shapes at a time.
        threshold: of probabilities, for IoU.
        background: for backgrounds, what stands behind: random, or a folder of pictures.
        degrees: for pose-noise, the largest angles, with commas between.
        orders: for order, how many.
        planes: for depth and clouds, of the plane sweep.
        split: the part of the set.
        device: auto takes a GPU where there is one.

    Returns:
        The exit status.
    """
    import time
    from pathlib import Path

    import torch

    from lsmgeo import evaluation
    from lsmgeo.errors import OptionError
    from lsmgeo.evaluation.evaluate import FEW

    try:
        angles = tuple(float(angle) for angle in degrees.split(","))
    except ValueError:
        raise OptionError(f"degrees must be numbers with commas between, such as 0,10,20; got {degrees!r}") from None
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
    place = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    contenders = evaluation.open_contenders(checkpoints, place)
    if report == "auto":
        report = "depth" if contenders[0].has_depth else "iou"
    found = evaluation.open_shapes(
        shards,
        size=max(contender.size for contender in contenders),
        shapes=FEW.get(report) if shapes is None else shapes,
        seed=seed,
        split=split,
    )
    made = evaluation.evaluate(contenders, found, report, options)
    print(f"data:     {found.about}" + ("" if shards is None else f", {Path(shards).resolve()}"))
    for contender in contenders:
        print(f"model:    {contender.name}, {contender.path}")
    for table in made.tables:
        print(f"\n{evaluation.format_table(table)}")
    written = evaluation.write_report(made, out)
    kinds = sorted({path.suffix[1:].upper() for path in written})
    print(f"\ntime:     {time.perf_counter() - start:.1f} s")
    print(f"written:  {len(written)} files ({', '.join(kinds)}) in {Path(out).resolve()}")
    for note in made.notes:
        print(f"lsmgeo: warning: {note}", file=sys.stderr)
    return 0
