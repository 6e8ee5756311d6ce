"""Reconstruction by plane-sweep stereo, of one view or of all."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lsmgeo._checks import check_whole
from lsmgeo.classical.stereo import Reconstruction, reconstruct_views, surface_of
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.classical.views import default_depth_range, select_neighbours
from lsmgeo.errors import OptionError
from lsmgeo.reconstruct.scene_input import first_few
from lsmgeo.reconstruct.write_results import Results, ViewResult, mesh_facts

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages
    from lsmgeo.data.meshes import Mesh

__all__ = ["sweep_results"]

# Below this fraction of kept pixels the results have a note.
FEW = 0.05
# Along the longest side of the box of the mesh.
MOST_VOXELS = 1024
# The default density of a view that no other is checked against.
VIEW_DENSITY = 0.4


def sweep_results(
    scene: PosedImages,
    view: int | None,
    title: str,
    *,
    check: int,
    resolution: int,
    **options: Any,
) -> Results:
    """Plane-sweep stereo of one view, or of all that can be swept; ``options`` are the fields of `SweepOptions`.

    Raises:
        OptionError: an option out of range, or no view can be swept.
        DataError: an image cannot be read.
    """
    sweep = SweepOptions(**options, who="reconstruct")
    check_whole("reconstruct", "resolution", resolution, 8, MOST_VOXELS)
    notes: tuple[str, ...] = ()
    mesh: Mesh | None = None
    views: tuple[Reconstruction, ...]
    if view is not None:
        one = _checked_view(scene, view, check, sweep)
        views, points, colours = (one,), one.points, one.colours
        mesh = surface_of(views, points, resolution) if len(points) else None
    else:
        able, notes = _able(scene, sweep)
        found = reconstruct_views(scene, able, sweep, resolution=resolution, progress=True)
        views, points, colours, mesh = found.views, found.points, found.colours, found.mesh
    if not len(points):
        notes += (
            "No pixel was kept: the images match nowhere with enough confidence. They may lack texture, be too far "
            "apart, or have wrong cameras (see lsmgeo info), or the true depth is not between near and far.",
        )
    pixels, whole = sum(int(one.mask.sum()) for one in views), sum(one.mask.numel() for one in views)
    if 0 < pixels < FEW * whole:
        other = ". They are cut out, which suits --method hull" if scene.cut_out else ""
        notes += (
            f"Only {100 * pixels / whole:.1f} % of the pixels were kept: the images may be few, far apart or without "
            f"texture, or their cameras wrong (see lsmgeo info){other}.",
        )
    facts = [("scene", f"{len(scene)} images, {scene.source}")]
    first = views[0]
    if view is not None:
        matched = ", ".join(scene.names[other] for other in first.neighbours)
        facts.append(("view", f"{view} ({scene.names[view]}), matched with {matched}"))
    else:
        together = ", checked against each other and fused" if len(views) > 1 else ""
        facts.append(("views", f"{len(views)} of {len(scene)} swept{together}"))
    height, width = first.mask.shape
    low, high = (float(np.median([one.depths[end] for one in views])) for end in (0, -1))
    typical = " (the median over views)" if len(views) > 1 else ""
    planes = f"{len(first.depths)} planes from {low:.4g} to {high:.4g}{typical}"
    facts.append(("sweep", f"{width} x {height} pixels, {planes}"))
    facts.append(("memory", f"at most {sweep.memory >> 20} MiB per sweep, besides the libraries and the images"))
    facts.append(("kept", f"{pixels} pixels, {100 * pixels / whole:.1f} %"))
    errors = [one.error for one in views if one.error is not None and one.error.points]
    if errors:
        median = np.median([error.median for error in errors])
        count, observed = sum(error.points for error in errors), sum(error.observed for error in errors)
        of_views = "" if len(views) == 1 else ", median over views"
        words = f"median {100 * median:.3f} % of the depth at {count} of {observed} sparse points{of_views}"
        facts.append(("depth error", words))
    facts += mesh_facts(mesh)
    used = tuple({other for one in views for other in one.neighbours})
    return Results(title, tuple(facts), notes, tuple(map(_view_result, views)), points, colours, mesh, used)


def _checked_view(scene: PosedImages, view: int, check: int, options: SweepOptions) -> Reconstruction:
    """One view, of which the pixels are kept that agree with those of its best neighbours that can be swept."""
    if check < 0:
        raise OptionError(f"check must be 0 or more; got {check}")
    others = []
    if check and len(scene) > 1:
        able, _ = _able(scene, options, only=view)
        near, far = options.near, options.far
        others = [other for other in select_neighbours(scene, view, check, near=near, far=far) if other in able]
    if not others and options.density is None:
        options = replace(options, density=VIEW_DENSITY)
    found = reconstruct_views(scene, [view, *others], options, min_support=len(others), mesh=False, progress=True)
    return found.views[0]


def _able(scene: PosedImages, options: SweepOptions, *, only: int | None = None) -> tuple[list[int], tuple[str, ...]]:
    """The views that have a depth range and neighbours, and a note on the others; `only` must be one of them."""
    able, reasons = [], []
    for view in range(len(scene)):
        near, far = options.near, options.far
        try:
            if near is None or far is None:
                lower, upper = default_depth_range(scene, view)
                near, far = lower if near is None else near, upper if far is None else far
                # If only one end is given, it may suit most views but not the range of another.
                if not near < far:
                    raise OptionError(f"near and far must be positive, finite and ascending; got {near} and {far}")
            select_neighbours(scene, view, options.neighbours, near=near, far=far)
        except OptionError as error:
            if view == only:
                raise
            reasons.append((view, error))
        else:
            able.append(view)
    if not able and reasons:
        raise reasons[0][1]
    words = first_few([f"{scene.names[view]}: {error}" for view, error in reasons])
    return able, (f"Not swept: {words}",) if reasons else ()


def _view_result(one: Reconstruction) -> ViewResult:
    depth = torch.where(one.mask, one.depth_map.depth, 0.0)
    numbers = [("kept", f"{100 * float(one.mask.float().mean()):.1f} %")]
    if bool(one.mask.any()):
        inside = one.depth_map.depth[one.mask]
        numbers.append(("median depth", f"{float(inside.median()):.4g}"))
    numbers.append(("swept", f"{float(one.depths[0]):.4g} to {float(one.depths[-1]):.4g}"))
    numbers.append(("neighbours", ", ".join(map(str, one.neighbours))))
    if one.support is not None and bool(one.mask.any()):
        numbers.append(("other views that agree", f"{float(one.support[one.mask].float().mean()):.1f} on average"))
    if one.error is not None and one.error.points:
        numbers.append(("error at sparse points", f"{100 * one.error.median:.3f} % ({one.error.points} points)"))
    confidence = one.depth_map.confidence
    return ViewResult(one.view, one.image, one.camera, depth, confidence, "confidence", tuple(numbers))
