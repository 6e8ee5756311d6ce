"""What the command line does with models; `lsmgeo.cli` lists it. Heavy imports wait until a command runs."""

from __future__ import annotations

import sys
from typing import Any, Literal

__all__ = ["evaluate", "reconstruct", "train"]


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

    from lsmgeo.errors import OptionError
    from lsmgeo.models import evaluation
    from lsmgeo.models.evaluation.evaluate import FEW

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


def reconstruct(
    scene: str,
    method: Literal["sweep", "hull", "v-lsm", "d-lsm"] = "sweep",
    view: int | str | None = None,
    out: str = "lsmgeo-reconstruct",
    neighbours: int = 4,
    size: int = 640,
    planes: int = 300,
    spacing: Literal["inverse", "depth", "disparity"] = "inverse",
    near: float | None = None,
    far: float | None = None,
    score: Literal["zncc", "sad", "census"] = "zncc",
    window: int = 5,
    density: float | None = None,
    check: int = 2,
    resolution: int = 192,
    rule: Literal["all", "mean"] = "all",
    masks: str | None = None,
    background: str | None = None,
    memory: int = 1024,
    weights: str | None = None,
    views: int = 8,
    box: str | None = None,
    threshold: float = 0.4,
) -> int:
    """Reconstruct posed photographs: depth maps, coloured points, a mesh, and a page to turn it around in.

    Args:
        scene: posed photographs in any form that lsmgeo reads.
        method: "sweep" is plane-sweep stereo, "hull" the visual hull of silhouettes; "v-lsm" and "d-lsm" are learnt:
            voxels, and depth maps.
        view: a photograph, its number (by name, from 0) or its name: sweep this one alone; a hull is looked at from
            there, and a learnt model reads it first. By default all are swept, checked against each other and fused.
        out: folder for the results; created where it does not exist.
        neighbours: for sweeps, number of other photographs to match with.
        size: longer side in pixels at which photographs are used.
        planes: for sweeps, number of depth planes.
        spacing: for sweeps, what is even between planes; with "disparity" a step is a pixel, and their number follows.
        near: for sweeps, nearest depth in world units; by default told from the scene.
        far: for sweeps, farthest depth.
        score: for sweeps, how patches are compared.
        window: for sweeps, side of the patches in pixels.
        density: for sweeps, largest fraction of the pixels to keep; by default 0.8, or 0.4 of one view alone.
        check: for the sweep of one view, how many of its neighbours are swept too; they must agree with it. 0 takes a
            third of the time.
        resolution: voxels along the longest side of the box in which the mesh is made.
        rule: for hulls, whether a voxel must lie in "all" silhouettes, or in three quarters of them ("mean"), which
            forgives wrong ones.
        masks: for hulls and learnt models, a folder of silhouettes; by default alpha, or a folder masks or silhouettes
            beside the photographs.
        background: for hulls and learnt models, the colour behind the object, which then tells the silhouettes,
            whatever else could: white, black, or three numbers such as 0.1,0.8,0.2.
        memory: for sweeps, MiB that one may take.
        weights: for learnt models, a file of weights, a checkpoint or a run folder of lsmgeo train.
        views: for learnt models, how many photographs are used at most, from all around.
        box: for learnt models, where the object is: x,y,z,side of a cube in world units; by default told from
            silhouettes, sparse points or the cameras.
        threshold: for v-lsm, the probability from which a voxel is solid.

    Returns:
        The exit status: 0, or 1 where nothing could be told.
    """
    import os
    import time
    from pathlib import Path

    from lsmgeo import data
    from lsmgeo.classical.hull_scene import hull_results
    from lsmgeo.classical.methods import readable, sweep_results
    from lsmgeo.classical.outputs import write_results
    from lsmgeo.errors import OptionError

    learnt = ("v-lsm", "d-lsm")
    for option, value, methods in (
        ("masks", masks, ("hull", *learnt)),
        ("background", background, ("hull", *learnt)),
        ("near", near, ("sweep",)),
        ("far", far, ("sweep",)),
        ("density", density, ("sweep",)),
        ("weights", weights, learnt),
        ("box", box, learnt),
    ):
        if value is not None and method not in methods:
            raise OptionError(f"{option} is for method {', '.join(methods)}; got method {method}")
    start = time.perf_counter()
    images = data.open(scene)
    name = images.names[view] if isinstance(view, int) and 0 <= view < len(images) else view
    if name is not None and name not in images.names:
        named = "" if isinstance(view, int) else " or be a photograph's name"
        raise OptionError(f"view must lie in 0..{len(images) - 1}{named}; got {view!r}")
    if any(path.resolve().is_relative_to(Path(out).resolve()) for path in images.paths):
        raise OptionError(f"out must be a folder without the photographs, which it could replace; got {out!r}")
    # Told before the work, not after.
    there = next(str(path) for path in (Path(out).resolve(), *Path(out).resolve().parents) if os.path.exists(path))
    if not os.path.isdir(there) or not os.access(there, os.W_OK | os.X_OK):
        raise OptionError(f"out must be a folder that can be written or made; got {out!r}")
    images, left_out = readable(images)
    if name is not None and name not in images.names:
        raise OptionError(f"view must be a photograph that can be read: {left_out[0]}")
    reference = None if name is None else images.names.index(str(name))
    title = {"hull": "visual hull", "sweep": "plane sweep"}.get(method, method.upper())
    title = f"{Path(scene).resolve().name}, {title}{'' if name is None else f', from {name}'}"
    masked: dict[str, Any] = {"masks": masks, "background": background, "resolution": resolution, "size": size}
    if method == "hull":
        results = hull_results(images, reference, title, rule=rule, **masked)
    elif method in learnt:
        from lsmgeo.models.reconstructing import learnt_results

        masked |= {"method": method, "weights": weights, "views": views, "box": box, "threshold": threshold}
        results = learnt_results(images, reference, title, **masked)
    else:
        results = sweep_results(
            images,
            reference,
            title,
            check=check,
            resolution=resolution,
            density=density,
            neighbours=neighbours,
            size=size,
            planes=planes,
            spacing=spacing,
            near=near,
            far=far,
            score=score,
            window=window,
            memory=memory << 20,
        )
    facts = (*results.facts, ("time", f"{time.perf_counter() - start:.1f} s"))
    results = results._replace(facts=facts, notes=left_out + results.notes)
    written = write_results(images, results, out)
    for fact, value in results.facts:
        print(f"{fact + ':':<13}{value}")
    for what, path in written.items():
        print(f"{what + ':':<18}{path.resolve()}")
    for note in results.notes:
        print(f"lsmgeo: warning: {note}", file=sys.stderr)
    return 0 if len(results.points) or results.mesh is not None else 1


def train(configuration: str, out: str = "lsmgeo-run", set: list[str] | None = None, quiet: bool = False) -> int:
    """Train a model, or go on where a run stopped; on several devices with torchrun, see the guide.

    Args:
        configuration: a TOML or JSON file; examples/configs holds some.
        out: the run's folder, for checkpoints, the log and pictures; where it holds a run already, that goes on.
        set: a setting that comes before the file's, such as --set run.steps=100; may be given again and again.
        quiet: whether to show no progress.

    Returns:
        The exit status: 0; 143 after SIGTERM or 130 after Ctrl-C, when everything was saved and the same command goes
        on.
    """
    import os
    from pathlib import Path

    import torch

    from lsmgeo.models import training

    config = training.read_config(configuration, set or ())
    if "OMP_NUM_THREADS" not in os.environ:
        # The processes that read ahead take a core each: threads that wait for one slow all others down.
        torch.set_num_threads(max(1, torch.get_num_threads() - config.data.workers))
    trained = training.train(config, out, quiet=quiet)
    if trained.is_first:
        why = {"steps": "all its steps are taken", "minutes": "its time is over", "stop": "it was asked to"}
        print(f"ended:       at step {trained.step}, since {why[trained.ended]}")
        if trained.evaluation is not None:
            print(f"{trained.evaluation.title + ':':<13}{trained.evaluation.words}")
        print(f"checkpoint:  {trained.checkpoint.resolve()}")
        best = None if trained.best is None else trained.checkpoint.with_name(f"step_{trained.best:08d}")
        # A full disk may have had no room for it.
        if trained.best != trained.step and best is not None and best.is_dir():
            print(f"best:        {best.resolve()}")
        print(f"log:         {(Path(out) / 'log.jsonl').resolve()}; tensorboard --logdir {Path(out).resolve()}")
        print(f"evaluate:    lsmgeo evaluate {trained.checkpoint}")
        if trained.ended == "stop":
            print("go on:       the same command")
    return trained.exit_code
