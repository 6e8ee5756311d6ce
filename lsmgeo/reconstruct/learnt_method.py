"""``lsmgeo reconstruct`` with learnt models: from a scene's photographs to voxels or depth maps."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lsmgeo import rays
from lsmgeo._checks import check_choice, check_number, check_whole
from lsmgeo.cameras import CameraTensors, resize, stack, unproject_depth
from lsmgeo.classical.consistency import consistent_views
from lsmgeo.classical.gathering import fitted, resized
from lsmgeo.classical.silhouettes import mask_folder, silhouettes
from lsmgeo.classical.surface import drop_specks, extract_mesh
from lsmgeo.classical.tsdf import fuse_depth, voxel_side
from lsmgeo.drawing import as_pixels
from lsmgeo.errors import OptionError
from lsmgeo.functional import plane_sweep_project
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.depth_lsm import DepthLSM
from lsmgeo.models.voxel_lsm import VoxelLSM
from lsmgeo.models.weights import load
from lsmgeo.reconstruct.hull_method import colour_vertices, hull_depth, outline_iou
from lsmgeo.reconstruct.object_frame import (
    DISTANCE,
    Framed,
    Placement,
    frame_view,
    in_model_frame,
    place_box,
    place_object,
    seen_from,
    spread_views,
)
from lsmgeo.reconstruct.sweep_method import mesh_facts, named_colour
from lsmgeo.reconstruct.write_results import Looked, Results

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.data import PosedImages
    from lsmgeo.models.r2n2 import R2N2

__all__ = ["METHODS", "Prediction", "learnt_results", "predict_scene"]

METHODS: dict[str, type[VoxelLSM | DepthLSM]] = {"v-lsm": VoxelLSM, "d-lsm": DepthLSM}
# Nearer than that, in sizes of the object, a camera stands in its cube; outside the range, models were not trained.
NEAREST, TRAINED = 0.9, (1.5, 2.7)
# Views that silhouettes are read of to tell where the object is.
MOST_MASKS = 24
# How far the unit cube reaches from its middle, and so depth from the distance.
REACH = 3**0.5 / 2
# The surface is sampled more finely than the voxels that a model gives, so that it has colours as fine.
FINER, FINEST = 4, 128
# Depth maps of a model agree with each other to about that; what fusing takes for noise, in sizes of the object.
AGREEMENT, TRUNCATION = 0.02, 0.05
SPECK_FACES = 20
# On the validation split: a network below this IoU, or above this depth error, has barely begun to learn.
LEAST_IOU, LARGEST_ERROR = 0.3, 0.1
# Rays along which the largest probability is looked for, and how often.
LARGEST_SAMPLED, PLANES = 192, 96


class Prediction(NamedTuple):
    """What a model says of a scene."""

    result: Any  # of the model's run, in its own frame
    placement: Placement
    views: tuple[int, ...]
    framed: tuple[Framed, ...]  # the photographs as it took them
    silhouettes: tuple[Tensor | None, ...]  # (H, W) bool, of the whole photographs
    notes: tuple[str, ...]


def predict_scene(
    scene: PosedImages,
    model: VoxelLSM | DepthLSM | R2N2,
    *,
    first: int | None = None,
    views: int = 8,
    box: Sequence[float] | None = None,
    masks: str | os.PathLike[str] | None = None,
    background: str | Sequence[float] | None = None,
) -> Prediction:
    """Run a model on a scene: find the object, cut the photographs as in training, and let the model see them.

    Args:
        scene: posed photographs.
        model: from `lsmgeo.models.create` or `load`.
        first: the photograph that is read first; by default the scene's first that shows the object.
        views: how many photographs are used at most, from all around.
        box: where the object is, x, y, z and side of a cube in world units; told by default, see
            `lsmgeo.reconstruct.object_frame.place_object`.
        masks: folder of silhouettes, see `lsmgeo.classical.silhouettes`.
        background: the colour behind the object, see there.

    Raises:
        OptionError: an option out of range, or no place for the object is told.
        DataError: a photograph or a mask cannot be read.
    """
    who = "reconstruct"
    check_whole(who, "views", views, 1, 1000)
    step = max(1, -(-len(scene) // MOST_MASKS))
    sought = list(dict.fromkeys([*([] if first is None else [first]), *range(0, len(scene), step)]))
    known = _silhouettes(scene, sought, masks, background)
    placement = place_object(scene, known, sought) if box is None else place_box(scene, box)
    away, is_seen = seen_from(scene, placement)
    usable = [number for number in range(len(scene)) if is_seen[number] and away[number] > NEAREST]
    if not usable:
        raise OptionError(
            f"{who}: no photograph shows the middle of the object, as told by {placement.told_by}, from outside; give "
            "box, x,y,z,side of a cube around it"
        )
    chosen = spread_views(scene, placement, sorted(usable, key=lambda number: number != first), views)
    outlines: Sequence[Tensor | None] = _silhouettes(scene, chosen, masks, background) or [None] * len(chosen)
    framed = [
        frame_view(scene, number, placement, model.image_size, outline)
        for number, outline in zip(chosen, outlines, strict=True)
    ]
    cameras = in_model_frame(stack([one.camera for one in framed]), placement)
    result = model.run(torch.stack([one.image for one in framed])[None], cameras.at(None), by_view=False)
    notes = _notes(scene, first, usable, float(np.median(away[chosen])), has_masks=known is not None)
    return Prediction(result, placement, tuple(chosen), tuple(framed), tuple(outlines), notes)


def learnt_results(
    scene: PosedImages,
    view: int | None,
    title: str,
    *,
    method: str,
    weights: str | os.PathLike[str] | None,
    views: int = 8,
    box: str | None = None,
    threshold: float = 0.4,
    masks: str | None = None,
    background: str | None = None,
    resolution: int = 192,
    size: int = 640,
) -> Results:
    """What a learnt model makes of a scene.

    Args:
        scene: posed photographs.
        view: the one that is looked from first, and read first.
        title: of what is written.
        method: "v-lsm", voxels and their surface; or "d-lsm", depth maps, points and the surface that they fuse to.
        weights: a file of `lsmgeo.models.write_weights`, a checkpoint or a run folder.
        views: see `predict_scene`, like box, masks and background.
        box: four numbers with commas between.
        threshold: probability from which a voxel is solid, for "v-lsm".
        masks: see `predict_scene`.
        background: "black", "white", or three numbers from 0 to 1 with commas between.
        resolution: voxels along a side of the cube in which the surface is made, at most.
        size: longer side in pixels of the pictures that voxels are shown in.

    Raises:
        OptionError: no weights or those of another model, an option out of range, no place for the object is told.
        CheckpointError: the weights cannot be read.
        DataError: a photograph or a mask cannot be read.
    """
    who = "reconstruct"
    check_choice(who, "method", method, tuple(METHODS))
    check_whole(who, "resolution", resolution, 8, 1024)
    check_whole(who, "size", size, 16)
    if not 0 < check_number(who, "threshold", threshold, "a number between 0 and 1") < 1:
        raise OptionError(f"{who}: threshold must be a number between 0 and 1; got {threshold}")
    cube = None if box is None else _cube(box)
    model = _load(method, weights)
    found = predict_scene(
        scene, model, first=view, views=views, box=cube, masks=masks, background=named_colour(background)
    )
    x, y, z = found.placement.center
    facts = (
        ("scene", f"{len(scene)} photographs, {scene.source}"),
        ("model", f"{model.name}, {sum(one.numel() for one in model.parameters())} parameters"),
        ("views", f"{len(found.views)}: {', '.join(map(str, found.views))}"),
        (
            "object",
            f"a cube of {found.placement.side:.4g} about {x:.4g}, {y:.4g}, {z:.4g}, told by {found.placement.told_by}",
        ),
    )
    notes = (*_barely_trained(model.about), *found.notes)
    results = Results(title, facts, notes)
    if method == "v-lsm":
        return _with_voxels(scene, results, found, model.grid, threshold, resolution, size)
    return _with_depth(results, found, model.grid, resolution)


def _with_voxels(
    scene: PosedImages,
    results: Results,
    found: Prediction,
    grid: VoxelGrid,
    threshold: float,
    resolution: int,
    size: int,
) -> Results:
    """Results with the surface of a model's voxels, and how it looks in the photographs."""
    probability = found.result.occupancy[0].float().cpu()
    place = found.placement.scene_from_model()
    side = max(grid.shape[0], min(FINER * grid.shape[0], resolution))  # type: ignore[index]
    fine = interpolate(probability[None, None], (side,) * 3, mode="trilinear")[0, 0]
    coarse_grid, fine_grid = (VoxelGrid(n, grid.lower, grid.upper, place) for n in (probability.shape[0], side))
    seen, looked = [], []
    for view, outline in zip(found.views, found.silhouettes, strict=True):
        shape = fitted(scene.size(view), size)
        camera, image = resize(scene.camera(view), *shape), resized(scene.load(view), shape)
        depth = hull_depth(fine > threshold, fine_grid, camera)
        numbers = [("model", f"{100 * float((depth > 0).float().mean()):.1f} % of the picture")]
        coloured = depth
        if outline is not None:
            mask = resized(outline[None].float(), shape)[0] > 0.5
            numbers.append(("IoU of silhouette and model", f"{outline_iou(depth, mask):.3f}"))
            # Where the model is too large, a photograph shows what is behind the object.
            coloured = torch.where(mask, depth, 0.0)
        certain = _largest(probability, coarse_grid, camera, found.placement)
        looked.append(Looked(view, image, camera, depth, certain, "probability", tuple(numbers)))
        seen.append(looked[-1]._replace(depth=coloured))
    mesh = drop_specks(extract_mesh(fine, fine_grid, level=threshold), SPECK_FACES)
    solid = 100 * float((probability > threshold).float().mean())
    facts = [("voxels", f"{' x '.join(map(str, probability.shape))}, {solid:.1f} % above {threshold:g}")]
    notes: tuple[str, ...] = ()
    if len(mesh.faces):
        mesh = colour_vertices(mesh, seen, 2 * voxel_side(coarse_grid))
    else:
        notes = (
            f"No voxel is more likely solid than {threshold:g}; the largest probability is {probability.max():.2g}.",
        )
    return results._replace(
        facts=(*results.facts, *facts, *mesh_facts(mesh)), notes=results.notes + notes, views=tuple(looked), mesh=mesh
    )


def _with_depth(results: Results, found: Prediction, grid: VoxelGrid, resolution: int) -> Results:
    """Results with a model's depth maps, their points and the surface that they fuse to."""
    placement = found.placement
    maps = found.result.depth[0].float().cpu()
    shape = (maps.shape[1], maps.shape[2])
    cameras = [resize(one.camera, *shape) for one in found.framed]
    images = [resized(one.image, shape) for one in found.framed]
    known = []
    for one, depth, camera in zip(found.framed, maps, cameras, strict=True):
        middle = float(in_model_frame(camera, placement).cam_from_world[2, 3])
        on = one.inside if one.mask is None else one.mask
        on = resized(on[None].float(), shape)[0] > 0.5
        on = on & ((depth - middle).abs() < REACH) & (depth > 0)
        known.append(torch.where(on, depth * placement.side, 0.0))
    looked, points, colours = [], [], []
    for number, (view, depth, camera, image) in enumerate(zip(found.views, known, cameras, images, strict=True)):
        others = [other for other in range(len(known)) if other != number]
        support = consistent_views(
            depth,
            camera,
            [known[other] for other in others],
            [cameras[other] for other in others],
            pixels=2.0,
            relative=AGREEMENT,
        )
        # Of two views alone, what either sees would be lost by asking the other.
        kept = (depth > 0) & ((support > 0) | (len(others) < 2))
        share = support / max(1, len(others)) if others else (depth > 0).float()
        numbers = [("kept", f"{100 * float(kept.float().mean()):.1f} %")]
        if bool(kept.any()):
            numbers.append(("median depth", f"{float(depth[kept].median()):.4g}"))
        if others and bool((depth > 0).any()):
            numbers.append(("other views that agree", f"{float(support[depth > 0].float().mean()):.1f} on average"))
        looked.append(Looked(view, image, camera, depth, share.float(), "share of views that agree", tuple(numbers)))
        points.append(unproject_depth(camera.at(None), depth[None, None].double())[0, 0][kept].float().numpy())
        colours.append(as_pixels(image)[kept])
    side = min(resolution, FINEST)
    fine = VoxelGrid(side, grid.lower, grid.upper, placement.scene_from_model())
    fused = fuse_depth(
        known,
        stack(cameras),
        fine,
        colours=images,
        truncation=max(TRUNCATION * placement.side, 3 * voxel_side(fine)),
        background=_empty(found, shape),
    )
    mesh = extract_mesh(fused, fine, specks=SPECK_FACES)
    count = sum(map(len, points))
    facts = [("kept", f"{count} pixels, {100 * count / maps.numel():.1f} %"), *mesh_facts(mesh)]
    notes = () if count else ("No depth lies in the cube of the object.",)
    return results._replace(
        facts=results.facts + tuple(facts),
        notes=results.notes + notes,
        views=tuple(looked),
        points=np.concatenate(points),
        colours=np.concatenate(colours),
        mesh=mesh if len(mesh.faces) else None,
    )


def _largest(probability: Tensor, grid: VoxelGrid, camera: CameraTensors, placement: Placement) -> Tensor:
    """(h, w) the largest probability along each ray, at the camera's size; sampled at a size that voxels need."""
    whole = int(torch.as_tensor(camera.height)), int(torch.as_tensor(camera.width))
    shape = fitted(whole, LARGEST_SAMPLED)
    middle = float(in_model_frame(camera, placement).cam_from_world[2, 3])
    planes = torch.linspace(max(middle - REACH, 1e-3), middle + REACH, PLANES, dtype=torch.float64) * placement.side
    maps, _ = plane_sweep_project(probability[None, None], camera.at(None), grid, planes, shape)
    largest = rays.max_along_rays(maps[0, 0])
    return resized(largest[None].clamp(0, 1), whole)[0]


def _empty(found: Prediction, shape: tuple[int, int]) -> list[Tensor] | None:
    """Where silhouettes say that there is nothing, (h, w) bool of every view; None without silhouettes."""
    if any(one.mask is None for one in found.framed):
        return None
    off = (one.inside & ~one.mask for one in found.framed if one.mask is not None)
    return [resized(one[None].float(), shape)[0] > 0.5 for one in off]


def _load(method: str, weights: str | os.PathLike[str] | None) -> VoxelLSM | DepthLSM:
    if weights is None:
        raise OptionError(f"reconstruct: method {method} needs weights, a file, checkpoint or run folder; got none")
    model = load(weights)
    if isinstance(model, METHODS[method]):
        return model
    name = getattr(model, "name", type(model).__name__)
    suited = next((other for other, kind in METHODS.items() if kind.name == name), None)
    other = f"use method {suited}" if suited else "no method of reconstruct takes these, lsmgeo evaluate measures them"
    raise OptionError(
        f"reconstruct: method {method} needs weights of a {METHODS[method].name}; {os.fspath(weights)} holds those of "
        f"a {name}: {other}"
    )


def _barely_trained(about: Mapping[str, Any]) -> tuple[str, ...]:
    """A note where training left a network that is still bad on its validation split, as its file says."""
    validation: Any = about.get("validation")
    try:
        is_iou, value, step = validation["measure"] == "iou", float(validation["by_view"][-1]), int(validation["step"])
    except (TypeError, KeyError, IndexError, ValueError):
        return ()
    if not (value < LEAST_IOU if is_iou else value > LARGEST_ERROR):
        return ()
    measured = f"IoU is {100 * value:.0f} %" if is_iou else f"median depth error is {value:.2f} of the object's size"
    return (f"The network is barely trained: its {measured} on the validation split at step {step}.",)


def _cube(box: str) -> list[float]:
    try:
        numbers = [float(part) for part in box.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not np.isfinite(numbers).all() or not numbers[3] > 0:
        raise OptionError(f"reconstruct: box must be x,y,z,side of a cube, such as 0,0,0,1; got {box!r}")
    return numbers


def _silhouettes(
    scene: PosedImages,
    views: Sequence[int],
    masks: str | os.PathLike[str] | None,
    background: str | Sequence[float] | None,
) -> list[Tensor] | None:
    """Those that are named or that lie beside the photographs; None where there are none."""
    if masks is None and background is None and not scene.cut_out and mask_folder(scene) is None:
        return None
    return silhouettes(scene, views, folder=masks, background=background)


def _notes(
    scene: PosedImages, first: int | None, usable: Sequence[int], away: float, *, has_masks: bool
) -> tuple[str, ...]:
    notes = []
    if not has_masks:
        notes.append(
            "No silhouettes: the models were trained on objects before white, and what is behind this one will disturb "
            "them. Give masks, a folder of silhouettes, or background, the colour behind the object."
        )
    if first is not None and first not in usable:
        notes.append(f"{scene.names[first]} does not show the middle of the object, and is not used.")
    low, high = TRAINED
    if not low < away < high:
        notes.append(
            f"The cameras are {away:.1f} sizes of the object away from it; models are trained from {DISTANCE:g}. Where "
            "the object was told wrongly, give box."
        )
    return tuple(notes)
