"""The methods of ``lsmgeo reconstruct``: what is done for whole scenes, and what is told of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo._checks import check_whole
from lsmgeo.classical.stereo import Reconstruction, reconstruct_views, surface_of
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.classical.views import default_depth_range, select_neighbours
from lsmgeo.errors import DataError, OptionError
from lsmgeo.reconstruct.write_results import Looked, Results

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages
    from lsmgeo.data.meshes import Mesh

__all__ = ["mesh_facts", "named_colour", "readable", "sweep_results"]

MOST_NAMED = 5
# Kept pixels below this fraction are worth a word.
FEW = 0.05
# Along the longest side of the box of the mesh.
MOST_VOXELS = 1024
# The default density of a view that no other is checked against.
VIEW_DENSITY = 0.4


def readable(scene: PosedImages) -> tuple[PosedImages, tuple[str, ...]]:
    """A scene without the photographs that cannot be read, and a note on those.

    Returns:
        The scene itself where all can be read.

    Raises:
        DataError: none can be read.
    """
    kept: list[int] = []
    reasons: list[str] = []
    for view in range(len(scene)):
        try:
            scene.load(view)
        except DataError as error:
            if len(scene) == len(reasons) + 1:
                raise
            reasons.append(str(error))
        else:
            kept.append(view)
    if not reasons:
        return scene, ()
    points = scene.points
    if points is not None:
        points = points._replace(observations=tuple(points.observations[view] for view in kept))
    fewer = replace(
        scene,
        names=tuple(scene.names[view] for view in kept),
        paths=tuple(scene.paths[view] for view in kept),
        cameras=scene.cameras.at(kept),
        points=points,
        lenses=None if scene.lenses is None else tuple(scene.lenses[view] for view in kept),
        depths=None if scene.depths is None else tuple(scene.depths[view] for view in kept),
    )
    return fewer, (f"Left out, as it cannot be read: {_some(reasons)}",)


def sweep_results(
    scene: PosedImages,
    view: int | None,
    title: str,
    options: SweepOptions,
    *,
    check: int,
    resolution: int,
) -> Results:
    """Plane-sweep stereo of one view, or of all that can be swept.

    Args:
        scene: posed photographs.
        view: the one to sweep; None for all.
        title: of the page and the figures.
        options: of the sweeps.
        check: the number of neighbours of one view that are swept too; all of them must agree with it.
        resolution: voxels along the longest side of the box of the mesh.

    Raises:
        OptionError: an option out of range, or no view can be swept.
        DataError: a photograph cannot be read.
    """
    check_whole("reconstruct", "resolution", resolution, 8, MOST_VOXELS)
    notes: tuple[str, ...] = ()
    mesh: Mesh | None = None
    views: tuple[Reconstruction, ...]
    if view is not None:
        one = _checked_view(scene, view, check, options)
        views, points, colours = (one,), one.points, one.colours
        mesh = surface_of(views, points, resolution) if len(points) else None
    else:
        able, notes = _able(scene, options)
        found = reconstruct_views(scene, able, options, resolution=resolution, progress=True)
        views, points, colours, mesh = found.views, found.points, found.colours, found.mesh
    if not len(points):
        notes += (
            "No pixel was kept: nowhere do the photographs match with any certainty. They may lack texture, be too "
            "far apart, or have wrong cameras (lsmgeo info tells), or the true depth lies outside near and far.",
        )
    pixels, whole = sum(int(one.mask.sum()) for one in views), sum(one.mask.numel() for one in views)
    if 0 < pixels < FEW * whole:
        other = ". They are cut out: --method hull is the other way" if scene.cut_out else ""
        notes += (
            f"Only {100 * pixels / whole:.1f} % of the pixels were kept: the photographs may be few, far apart or "
            f"without texture, or their cameras wrong (lsmgeo info tells){other}.",
        )
    facts = [("scene", f"{len(scene)} photographs, {scene.source}")]
    first = views[0]
    if view is not None:
        matched = ", ".join(scene.names[other] for other in first.neighbours)
        facts.append(("view", f"{view} ({scene.names[view]}), matched with {matched}"))
    else:
        together = ", checked against each other and fused" if len(views) > 1 else ""
        facts.append(("views", f"{len(views)} of {len(scene)} swept{together}"))
    height, width = first.mask.shape
    low, high = (float(np.median([one.depths[end] for one in views])) for end in (0, -1))
    typical = " (the middle of the views' own ranges)" if len(views) > 1 else ""
    planes = f"{len(first.depths)} planes from {low:.4g} to {high:.4g}{typical}"
    facts.append(("sweep", f"{width} x {height} pixels, {planes}"))
    facts.append(("memory", f"at most {options.memory >> 20} MiB a sweep beyond the libraries and the photographs"))
    facts.append(("kept", f"{pixels} pixels, {100 * pixels / whole:.1f} %"))
    errors = [one.error for one in views if one.error is not None and one.error.points]
    if errors:
        median = np.median([error.median for error in errors])
        count, observed = sum(error.points for error in errors), sum(error.observed for error in errors)
        of_views = "" if len(views) == 1 else ", median of the views'"
        words = f"median {100 * median:.3f} % of the depth at {count} of {observed} sparse points{of_views}"
        facts.append(("depth error", words))
    facts += mesh_facts(mesh)
    used = tuple({other for one in views for other in one.neighbours})
    return Results(title, tuple(facts), notes, tuple(map(_looked, views)), points, colours, mesh, used)


def named_colour(background: str | None) -> str | tuple[float, ...] | None:
    """A colour as `lsmgeo.classical.silhouettes` takes it, of a name or of three numbers with commas between."""
    if background is None or "," not in background:
        return background
    try:
        return tuple(float(part) for part in background.split(","))
    except ValueError:
        raise OptionError(
            f"background must be black, white or three numbers such as 0.1,0.8,0.2; got {background!r}"
        ) from None


def _some(reasons: list[str]) -> str:
    more = f"; and {len(reasons) - MOST_NAMED} more" if len(reasons) > MOST_NAMED else ""
    return "; ".join(reasons[:MOST_NAMED]) + more


def _checked_view(scene: PosedImages, view: int, check: int, options: SweepOptions) -> Reconstruction:
    """One view, with the pixels kept with which its best neighbours agree that can be swept themselves."""
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
    """The views that have a depth range and neighbours, and a note on the others; one may have to be among them."""
    able, reasons = [], []
    for view in range(len(scene)):
        near, far = options.near, options.far
        try:
            if near is None or far is None:
                lower, upper = default_depth_range(scene, view)
                near, far = lower if near is None else near, upper if far is None else far
                # One end alone may suit most views and lie beyond what another sees.
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
    words = _some([f"{scene.names[view]}: {error}" for view, error in reasons])
    return able, (f"Not swept: {words}",) if reasons else ()


def mesh_facts(mesh: Mesh | None) -> list[tuple[str, str]]:
    """How large a mesh is; nothing of one without faces."""
    if mesh is None or not len(mesh.faces):
        return []
    return [("mesh", f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces")]


def _looked(one: Reconstruction) -> Looked:
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
    return Looked(one.view, one.image, one.camera, depth, confidence, "confidence", tuple(numbers))
