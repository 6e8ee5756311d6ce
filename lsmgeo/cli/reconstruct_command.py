"""`lsmgeo reconstruct`: depth maps, points, a mesh and a page from posed images."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

__all__ = ["reconstruct"]

TITLES = {"hull": "visual hull", "sweep": "plane sweep"}
SILHOUETTE, LEARNT = ("hull", "v-lsm", "d-lsm"), ("v-lsm", "d-lsm")
# The methods of the options whose default is None: given with another method, they are errors.
METHODS = {
    "masks": SILHOUETTE,
    "background": SILHOUETTE,
    "near": ("sweep",),
    "far": ("sweep",),
    "density": ("sweep",),
    "weights": LEARNT,
    "box": LEARNT,
}


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
    """Reconstruct posed images: depth maps, coloured points, a mesh, and a page with an interactive model.

    Args:
        scene: posed images in any supported format.
        method: "sweep" is plane-sweep stereo, "hull" the visual hull of silhouettes; "v-lsm" and "d-lsm" are learnt,
            for voxels and depth maps.
        view: number (from 0, in the order of names) or name of an image: the only one to sweep, the one from which a
            hull is shown first, or the first input of a learnt model. By default all are swept, checked against each
            other and fused.
        out: folder for the results; created if it does not exist.
        neighbours: for sweeps, number of other images to match with.
        size: longer side of the images in pixels, to which larger ones are reduced.
        planes: for sweeps, number of depth planes.
        spacing: for sweeps, the quantity with even steps between planes; with "disparity" a step is one pixel, which
            sets their number.
        near: for sweeps, nearest depth in world units; by default inferred from the scene.
        far: for sweeps, farthest depth.
        score: for sweeps, the comparison of patches.
        window: for sweeps, side of the patches in pixels.
        density: for sweeps, largest fraction of the pixels to keep; by default 0.8, or 0.4 of a single view.
        check: for the sweep of one view, the number of neighbours that are swept too and must agree with it. With 0 it
            takes a third of the time.
        resolution: voxels along the longest side of the box of the mesh.
        rule: for hulls, whether a voxel must be within "all" silhouettes, or within three quarters of them ("mean"),
            which tolerates wrong ones.
        masks: for hulls and learnt models, a folder of silhouettes; by default alpha, or a folder masks or silhouettes
            beside the images.
        background: for hulls and learnt models, the colour of the background, from which silhouettes are computed; it
            takes precedence. White, black, or three numbers such as 0.1,0.8,0.2.
        memory: for sweeps, the largest memory of one sweep in MiB.
        weights: for learnt models, weights, a checkpoint or a run folder of lsmgeo train.
        views: for learnt models, the largest number of images to use, from all around.
        box: for learnt models, x,y,z,side of a cube around the object in world units; by default inferred from
            silhouettes, sparse points or the cameras.
        threshold: for v-lsm, the probability from which a voxel is occupied.

    Returns:
        The exit status: 0, or 1 if nothing was reconstructed.
    """
    sweep: dict[str, Any] = {"neighbours": neighbours, "planes": planes, "spacing": spacing, "near": near, "far": far}
    sweep |= {"score": score, "window": window, "density": density, "memory": memory << 20, "check": check}
    silhouettes: dict[str, Any] = {"masks": masks, "background": background}
    learnt = silhouettes | {"weights": weights, "views": views, "box": box, "threshold": threshold}
    options = {"sweep": sweep, "hull": silhouettes | {"rule": rule}}.get(method, learnt | {"method": method})
    _check_options(method, sweep | learnt)
    _check_folder(out)
    return _reconstruct(scene, view, Path(out), method, options | {"resolution": resolution, "size": size})


def _check_options(method: str, given: dict[str, Any]) -> None:
    from lsmgeo.errors import OptionError

    for option, methods in METHODS.items():
        if given[option] is not None and method not in methods:
            raise OptionError(f"{option} is for method {', '.join(methods)}; got method {method}")


def _check_folder(out: str) -> None:
    """Before the work, not after it."""
    import os

    from lsmgeo.errors import OptionError

    existing = next(path for path in (Path(out).resolve(), *Path(out).resolve().parents) if os.path.exists(path))
    if not os.path.isdir(existing) or not os.access(existing, os.W_OK | os.X_OK):
        raise OptionError(f"out must be a folder that can be written or created; got {out!r}")


def _reconstruct(path: str, view: int | str | None, out: Path, method: str, options: dict[str, Any]) -> int:
    """Open the scene, run the method, write and print the results."""
    import time

    from lsmgeo.reconstruct.scene_input import open_scene
    from lsmgeo.reconstruct.write_results import write_results

    start = time.perf_counter()
    scene, index, notes = open_scene(path, view, out)
    title = f"{Path(path).resolve().name}, {TITLES.get(method, method.upper())}"
    if index is not None:
        title += f", from {scene.names[index]}"
    results = _function_of(method)(scene, index, title, **options)
    facts = (*results.facts, ("time", f"{time.perf_counter() - start:.1f} s"))
    results = results._replace(facts=facts, notes=notes + results.notes)
    written = write_results(scene, results, out)
    for fact, value in results.facts:
        print(f"{fact + ':':<13}{value}")
    for what, file in written.items():
        print(f"{what + ':':<18}{file.resolve()}")
    for note in results.notes:
        print(f"lsmgeo: warning: {note}", file=sys.stderr)
    return 0 if len(results.points) or results.mesh is not None else 1


def _function_of(method: str) -> Callable[..., Any]:
    if method == "sweep":
        from lsmgeo.reconstruct.sweep_method import sweep_results

        return sweep_results
    if method == "hull":
        from lsmgeo.reconstruct.hull_method import hull_results

        return hull_results
    from lsmgeo.reconstruct.learnt_method import learnt_results

    return learnt_results
