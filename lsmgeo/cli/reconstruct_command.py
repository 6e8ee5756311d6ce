"""`lsmgeo reconstruct`: depth maps, points, a mesh and a page from posed images."""

from __future__ import annotations

import sys
from typing import Any, Literal

__all__ = ["reconstruct"]


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
    from lsmgeo.classical.sweep_options import SweepOptions
    from lsmgeo.errors import OptionError
    from lsmgeo.reconstruct.hull_method import hull_results
    from lsmgeo.reconstruct.sweep_method import readable, sweep_results
    from lsmgeo.reconstruct.write_results import write_results

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
        from lsmgeo.reconstruct.learnt_method import learnt_results

        masked |= {"method": method, "weights": weights, "views": views, "box": box, "threshold": threshold}
        results = learnt_results(images, reference, title, **masked)
    else:
        options = SweepOptions(
            neighbours=neighbours,
            size=size,
            planes=planes,
            spacing=spacing,
            near=near,
            far=far,
            score=score,
            window=window,
            density=density,
            memory=memory << 20,
            who="reconstruct",
        )
        results = sweep_results(images, reference, title, options, check=check, resolution=resolution)
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
