"""Reconstruction with learnt models: from the images of a scene to voxels or depth maps."""

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
from lsmgeo.reconstruct.hull_method import SPECK_FACES, colour_vertices, hull_depth, silhouette_iou
from lsmgeo.reconstruct.object_frame import (
    DISTANCE,
    Crop,
    ObjectFrame,
    crop_view,
    estimate_object_box,
    frame_of_box,
    in_model_frame,
    object_distances,
    spread_views,
)
from lsmgeo.reconstruct.scene_input import named_colour
from lsmgeo.reconstruct.write_results import Results, ViewResult, mesh_facts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.data import PosedImages
    from lsmgeo.models.r2n2 import R2N2

__all__ = ["METHODS", "Prediction", "learnt_results", "predict_scene"]

METHODS: dict[str, type[VoxelLSM | DepthLSM]] = {"v-lsm": VoxelLSM, "d-lsm": DepthLSM}
# In sizes of the object: below the first distance a camera is in its cube; models were trained between the others.
NEAREST, TRAINED = 0.9, (1.5, 2.7)
# Views of which silhouettes are read to estimate the box of the object.
MOST_MASKS = 24
# Half the diagonal of the unit cube: the largest difference between depth and the distance of its centre.
REACH = 3**0.5 / 2
# The surface is sampled more finely than the voxels of a model, so that its colours are finer.
FINER, FINEST = 4, 128
# The relative difference within which depth maps agree, and the truncation of fusing in sizes of the object.
AGREEMENT, TRUNCATION = 0.02, 0.05
# On the validation split: a network below this IoU, or above this depth error, is barely trained.
LEAST_IOU, LARGEST_ERROR = 0.3, 0.1
# The size of the map of largest probabilities in pixels, and the samples along each ray.
LARGEST_SAMPLED, PLANES = 192, 96


class Prediction(NamedTuple):
    """The output of a model for a scene."""

    result: Any  # of the run of the model, in its own frame
    frame: ObjectFrame
    views: tuple[int, ...]
    crops: tuple[Crop, ...]  # the images as the input of the model
    silhouettes: tuple[Tensor | None, ...]  # (H, W) bool, of the whole images
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
    """Run a model on a scene: estimate where the object is, crop the images as in training, and apply the model.

    Args:
        scene: posed images.
        model: from `lsmgeo.models.create` or `load`.
        first: the image that is used first; by default the first of the scene that shows the object.
        views: the largest number of images to use, from all around.
        box: a cube around the object, x, y, z and side in world units; estimated by default, see
            `lsmgeo.reconstruct.object_frame.estimate_object_box`.
        masks: folder of silhouettes, see `lsmgeo.classical.silhouettes`.
        background: the colour of the background, see there.

    Raises:
        OptionError: an option out of range, or the position of the object cannot be inferred.
        DataError: an image or a mask cannot be read.
    """
    who = "reconstruct"
    check_whole(who, "views", views, 1, 1000)
    step = max(1, -(-len(scene) // MOST_MASKS))
    sought = list(dict.fromkeys([*([] if first is None else [first]), *range(0, len(scene), step)]))
    known = _silhouettes(scene, sought, masks, background)
    frame = estimate_object_box(scene, known, sought) if box is None else frame_of_box(scene, box)
    away, is_seen = object_distances(scene, frame)
    usable = [number for number in range(len(scene)) if is_seen[number] and away[number] > NEAREST]
    if not usable:
        raise OptionError(
            f"{who}: no image shows the centre of the object, as inferred from {frame.inferred_from}, from outside; "
            "give box, x,y,z,side of a cube around it"
        )
    chosen = spread_views(scene, frame, sorted(usable, key=lambda number: number != first), views)
    of_views: Sequence[Tensor | None] = _silhouettes(scene, chosen, masks, background) or [None] * len(chosen)
    crops = [
        crop_view(scene, number, frame, model.image_size, mask) for number, mask in zip(chosen, of_views, strict=True)
    ]
    cameras = in_model_frame(stack([one.camera for one in crops]), frame)
    result = model.run(torch.stack([one.image for one in crops])[None], cameras.at(None), by_view=False)
    notes = _notes(scene, first, usable, float(np.median(away[chosen])), has_masks=known is not None)
    return Prediction(result, frame, tuple(chosen), tuple(crops), tuple(of_views), notes)


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
    """Reconstruct a scene with a learnt model: "v-lsm" for voxels and their surface, "d-lsm" for fused depth maps.

    Raises:
        OptionError: no weights, or weights of another model; an option out of range; the position of the object cannot
            be inferred.
        CheckpointError: the weights cannot be read.
        DataError: an image or a mask cannot be read.
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
    frame = found.frame
    x, y, z = frame.center
    facts = (
        ("scene", f"{len(scene)} images, {scene.source}"),
        ("model", f"{model.name}, {sum(one.numel() for one in model.parameters())} parameters"),
        ("views", f"{len(found.views)}: {', '.join(map(str, found.views))}"),
        ("object", f"a cube of {frame.side:.4g} about {x:.4g}, {y:.4g}, {z:.4g}, inferred from {frame.inferred_from}"),
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
    """Results with the surface of the voxels, and its depth in the images."""
    probability = found.result.occupancy[0].float().cpu()
    place = found.frame.scene_from_model()
    side = max(grid.shape[0], min(FINER * grid.shape[0], resolution))  # type: ignore[index]
    fine = interpolate(probability[None, None], (side,) * 3, mode="trilinear")[0, 0]
    coarse_grid, fine_grid = (VoxelGrid(n, grid.lower, grid.upper, place) for n in (probability.shape[0], side))
    seen, views = [], []
    for view, whole_mask in zip(found.views, found.silhouettes, strict=True):
        shape = fitted(scene.size(view), size)
        camera, image = resize(scene.camera(view), *shape), resized(scene.load(view), shape)
        depth = hull_depth(fine > threshold, fine_grid, camera)
        numbers = [("model", f"{100 * float((depth > 0).float().mean()):.1f} % of the image")]
        coloured = depth
        if whole_mask is not None:
            mask = resized(whole_mask[None].float(), shape)[0] > 0.5
            numbers.append(("IoU of silhouette and model", f"{silhouette_iou(depth, mask):.3f}"))
            # Where the model is too large, an image shows the background.
            coloured = torch.where(mask, depth, 0.0)
        confidence = _largest(probability, coarse_grid, camera, found.frame)
        views.append(ViewResult(view, image, camera, depth, confidence, "probability", tuple(numbers)))
        seen.append(views[-1]._replace(depth=coloured))
    mesh = drop_specks(extract_mesh(fine, fine_grid, level=threshold), SPECK_FACES)
    solid = 100 * float((probability > threshold).float().mean())
    facts = [("voxels", f"{' x '.join(map(str, probability.shape))}, {solid:.1f} % above {threshold:g}")]
    notes: tuple[str, ...] = ()
    if len(mesh.faces):
        mesh = colour_vertices(mesh, seen, 2 * voxel_side(coarse_grid))
    else:
        notes = (f"No voxel has a probability above {threshold:g}; the largest is {probability.max():.2g}.",)
    return results._replace(
        facts=(*results.facts, *facts, *mesh_facts(mesh)), notes=results.notes + notes, views=tuple(views), mesh=mesh
    )


def _with_depth(results: Results, found: Prediction, grid: VoxelGrid, resolution: int) -> Results:
    """Results with the depth maps, their points and the surface that they fuse to."""
    frame = found.frame
    maps = found.result.depth[0].float().cpu()
    shape = (maps.shape[1], maps.shape[2])
    cameras = [resize(one.camera, *shape) for one in found.crops]
    images = [resized(one.image, shape) for one in found.crops]
    known = []
    for one, depth, camera in zip(found.crops, maps, cameras, strict=True):
        middle = float(in_model_frame(camera, frame).cam_from_world[2, 3])
        on = one.inside if one.mask is None else one.mask
        on = resized(on[None].float(), shape)[0] > 0.5
        on = on & ((depth - middle).abs() < REACH) & (depth > 0)
        known.append(torch.where(on, depth * frame.side, 0.0))
    views, points, colours = [], [], []
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
        # With only two views, a check would drop what only one of them shows.
        kept = (depth > 0) & ((support > 0) | (len(others) < 2))
        share = support / max(1, len(others)) if others else (depth > 0).float()
        numbers = [("kept", f"{100 * float(kept.float().mean()):.1f} %")]
        if bool(kept.any()):
            numbers.append(("median depth", f"{float(depth[kept].median()):.4g}"))
        if others and bool((depth > 0).any()):
            numbers.append(("other views that agree", f"{float(support[depth > 0].float().mean()):.1f} on average"))
        views.append(ViewResult(view, image, camera, depth, share.float(), "share of views that agree", tuple(numbers)))
        points.append(unproject_depth(camera.at(None), depth[None, None].double())[0, 0][kept].float().numpy())
        colours.append(as_pixels(image)[kept])
    side = min(resolution, FINEST)
    fine = VoxelGrid(side, grid.lower, grid.upper, frame.scene_from_model())
    fused = fuse_depth(
        known,
        stack(cameras),
        fine,
        colours=images,
        truncation=max(TRUNCATION * frame.side, 3 * voxel_side(fine)),
        background=_empty(found, shape),
    )
    mesh = extract_mesh(fused, fine, specks=SPECK_FACES)
    count = sum(map(len, points))
    facts = [("kept", f"{count} pixels, {100 * count / maps.numel():.1f} %"), *mesh_facts(mesh)]
    notes = () if count else ("No depth is in the cube of the object.",)
    return results._replace(
        facts=results.facts + tuple(facts),
        notes=results.notes + notes,
        views=tuple(views),
        points=np.concatenate(points),
        colours=np.concatenate(colours),
        mesh=mesh if len(mesh.faces) else None,
    )


def _largest(probability: Tensor, grid: VoxelGrid, camera: CameraTensors, frame: ObjectFrame) -> Tensor:
    """The largest probability along each ray (h, w), at the size of the camera."""
    whole = int(torch.as_tensor(camera.height)), int(torch.as_tensor(camera.width))
    shape = fitted(whole, LARGEST_SAMPLED)
    middle = float(in_model_frame(camera, frame).cam_from_world[2, 3])
    planes = torch.linspace(max(middle - REACH, 1e-3), middle + REACH, PLANES, dtype=torch.float64) * frame.side
    maps, _ = plane_sweep_project(probability[None, None], camera.at(None), grid, planes, shape)
    largest = rays.max_along_rays(maps[0, 0])
    return resized(largest[None].clamp(0, 1), whole)[0]


def _empty(found: Prediction, shape: tuple[int, int]) -> list[Tensor] | None:
    """The background by the silhouettes, (h, w) bool of every view; None without silhouettes."""
    if any(one.mask is None for one in found.crops):
        return None
    off = (one.inside & ~one.mask for one in found.crops if one.mask is not None)
    return [resized(one[None].float(), shape)[0] > 0.5 for one in off]


def _load(method: str, weights: str | os.PathLike[str] | None) -> VoxelLSM | DepthLSM:
    if weights is None:
        raise OptionError(f"reconstruct: method {method} needs weights, a file, checkpoint or run folder; got none")
    model = load(weights)
    if isinstance(model, METHODS[method]):
        return model
    name = getattr(model, "name", type(model).__name__)
    suited = next((other for other, kind in METHODS.items() if kind.name == name), None)
    other = f"use method {suited}" if suited else "no method of reconstruct uses these; lsmgeo evaluate measures them"
    raise OptionError(
        f"reconstruct: method {method} needs weights of a {METHODS[method].name}; {os.fspath(weights)} holds those of "
        f"a {name}: {other}"
    )


def _barely_trained(about: Mapping[str, Any]) -> tuple[str, ...]:
    """A note if the network is still bad on its validation split, according to its file."""
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
    """The silhouettes that are given, or that the scene has; None without any."""
    if masks is None and background is None and not scene.cut_out and mask_folder(scene) is None:
        return None
    return silhouettes(scene, views, folder=masks, background=background)


def _notes(
    scene: PosedImages, first: int | None, usable: Sequence[int], away: float, *, has_masks: bool
) -> tuple[str, ...]:
    notes = []
    if not has_masks:
        notes.append(
            "No silhouettes: the models were trained on objects on a white background, and another background disturbs "
            "them. Give masks, a folder of silhouettes, or background, its colour."
        )
    if first is not None and first not in usable:
        notes.append(f"{scene.names[first]} does not show the centre of the object, and is not used.")
    low, high = TRAINED
    if not low < away < high:
        notes.append(
            f"The cameras are {away:.1f} sizes of the object away from it; models are trained with {DISTANCE:g}. If "
            "its inferred position is wrong, give box."
        )
    return tuple(notes)
