"""The visual hull: the largest solid with given silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, pad

from lsmgeo import functional
from lsmgeo._checks import check_choice, check_finite, check_geometry, check_number, check_whole, describe
from lsmgeo._sites import Cameras
from lsmgeo.cameras import CameraTensors, as_tensors, crop, rays, resize
from lsmgeo.classical.gathering import fitted
from lsmgeo.classical.silhouettes import signed_distance
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.grids import VoxelGrid

__all__ = ["VisualHull", "default_grid", "hull_box", "visual_hull"]

RULES = ("mean", "all")
# The largest memory of a slab in bytes per site.
BYTES_OF_A_SITE = 32
# To find a box: voxels along an axis of the coarse hulls, refinements, and the largest number of enlargements.
COARSE, ROUNDS, GROWTHS = 32, 3, 4
# To find a box: the longer side of a silhouette in pixels.
LONGEST_SIDE = 256
# Rays that are parallel to about a degree do not intersect.
LARGEST_CONDITION = 1e4

# A map (h, w), and its camera at that size.
View = tuple[Tensor, CameraTensors]


class VisualHull(NamedTuple):
    """The voxels of a hull, and their support."""

    occupancy: Tensor  # (D, H, W) or (B, D, H, W) bool
    support: Tensor  # the same shape: mean or minimum of the silhouettes at a voxel


def visual_hull(
    masks: Tensor | Sequence[Tensor],
    cameras: Cameras,
    grid: VoxelGrid,
    *,
    rule: str = "mean",
    threshold: float | None = None,
    outside: str = "empty",
    memory: int = 1 << 28,
) -> VisualHull:
    """Carve a grid by silhouettes, in which the centres of voxels are sampled.

    Equation: with ``s_v(X)`` the silhouette of view v interpolated where X projects, "mean" keeps
    ``sum_v s_v / V > threshold`` (Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 4: 0.75),
    and "all" ``min_v s_v > threshold`` (Laurentini, "The visual hull concept for silhouette-based image understanding",
    PAMI 1994). No silhouette shows a concavity: the hull fills it, whatever the number of views.

    Convention:
        Integer pixel centres; cameras are resized to the masks.

    Args:
        masks: (V, h, w) or (B, V, h, w), or V of any sizes (h, w): bool, or numbers that are larger on the object: a
            soft silhouette, or a distance to its contour (see `lsmgeo.classical.signed_distance`) with its own
            threshold.
        cameras: V cameras, or (B, V).
        grid: any; it may have a batch of poses if masks have a batch.
        rule: "mean" or "all".
        threshold: voxels with more support are kept; by default 0.75 for "mean" and 0.5 for "all".
        outside: voxels outside an image are "empty", for objects that are completely in every image, or "unknown":
            then the view is not used for them, and voxels that no view sees are empty.
        memory: bound in bytes on the memory besides masks and results.

    Returns:
        `VisualHull`.

    Raises:
        OptionError: an unknown rule, a threshold that is not a number.
        ShapeError, DTypeError, CameraError, GridError: as `lsmgeo.functional.unproject`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.classical import visual_hull
        >>> views = orbit(torch.tensor([0.0, 90.0]), 0.0, 2.0, focal_length=32.0, height=16, width=16)
        >>> masks = torch.zeros(2, 16, 16, dtype=torch.bool)
        >>> masks[:, 4:12, 4:12] = True  # half the image: from -0.25 to 0.25 at the distance of the centre
        >>> visual_hull(masks, views, VoxelGrid(8)).occupancy.sum(dim=(0, 1))
        tensor([ 0,  0, 16, 16, 16, 16,  0,  0])
    """
    who = "visual_hull"
    check_choice(who, "rule", rule, RULES)
    check_choice(who, "outside", outside, ("empty", "unknown"))
    threshold = {"mean": 0.75, "all": 0.5}[rule] if threshold is None else threshold
    check_number(who, "threshold", threshold, "a number")
    check_whole(who, "memory", memory, 1)
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
    has_batch = isinstance(masks, Tensor) and masks.dim() == 4
    maps = _maps_of_views(who, masks)
    tensors = as_tensors(cameras, who)
    expected = (len(maps[0]), len(maps)) if has_batch else (len(maps),)
    if tensors.shape != expected:
        raise ShapeError(f"{who}: cameras must have the leading shape {expected}, as masks; got {tensors.shape}")
    with torch.no_grad():
        support = _support(maps, tensors, grid, rule, outside, memory)
    support = support if has_batch else support[0]
    return VisualHull(support > threshold, support)


def _support(
    maps: list[Tensor], cameras: CameraTensors, grid: VoxelGrid, rule: str, outside: str, memory: int
) -> Tensor:
    """The mean or minimum (B, D, H, W) of the silhouettes at the voxels."""
    scenes = len(maps[0])
    _, height, width = grid.shape  # type: ignore[misc]
    planes = max(1, memory // (BYTES_OF_A_SITE * scenes * height * width))
    # The value off every silhouette: 0, or the minimum of the masks if these are distances.
    nothing = min(0.0, *(float(values.min()) for values in maps))
    start = float("inf") if rule == "all" else 0.0
    elsewhere = nothing if outside == "empty" else start
    support = maps[0].new_full((scenes, *grid.shape), start)  # type: ignore[misc]
    count = torch.zeros(support.shape, dtype=torch.int16) if outside == "unknown" else None
    # View after view: a mask stays in the caches, and memory does not grow with the number of views.
    for view, values in enumerate(maps):
        camera = cameras.at((..., slice(view, view + 1)))
        for first, volume, visible in functional.unproject_slabs(
            values[:, None, None], camera, grid, planes, padding_mode="border"
        ):
            slab = support[:, first : first + planes]
            if count is not None:
                count[:, first : first + planes] += visible[:, 0]
            values_here = torch.where(visible[:, 0], volume[:, 0, 0], elsewhere)
            slab.copy_(torch.minimum(slab, values_here) if rule == "all" else slab + values_here)
    if rule == "mean":
        support /= len(maps) if count is None else count.clamp_min(1)
    if count is not None:
        support[count == 0] = nothing
    return support


def _maps_of_views(who: str, masks: Tensor | Sequence[Tensor]) -> list[Tensor]:
    """The masks (B, h, w) of every view as numbers."""
    if isinstance(masks, Tensor):
        if masks.dim() not in (3, 4) or 0 in masks.shape:
            raise ShapeError(f"{who}: masks must be (V, h, w) or (B, V, h, w); got {tuple(masks.shape)}")
        views = list(masks.unbind(1)) if masks.dim() == 4 else [mask[None] for mask in masks]
    elif isinstance(masks, Sequence) and masks and all(isinstance(mask, Tensor) for mask in masks):
        if not all(mask.dim() == 2 and mask.numel() for mask in masks):
            shapes = [tuple(mask.shape) for mask in masks]
            raise ShapeError(f"{who}: masks of single views must be (h, w); got {shapes}")
        views = [mask[None] for mask in masks]
    else:
        raise DTypeError(f"{who}: masks must be a tensor (V, h, w) or (B, V, h, w), or a list; got {describe(masks)}")
    numbers = [view.float() if view.dtype == torch.bool else view for view in views]
    for view in numbers:
        check_geometry(who, "masks", view, "(V, h, w) or (B, V, h, w), bool or")
        check_finite(who, "masks", view)
    return numbers


def hull_box(
    masks: Sequence[Tensor] | Tensor, cameras: Cameras, *, margin: float = 0.02
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """An axis-aligned box that contains the visual hull.

    A cube around the point nearest to the rays through the centres of the silhouettes is carved coarsely, with
    silhouettes widened by the size of a voxel so that nothing thin is lost; the box around the rest is carved again.
    If the hull of two views is unbounded, the box is cut off.

    Args:
        masks: (h, w) bool of every view, not empty; sizes may differ.
        cameras: V cameras.
        margin: by which the box is widened on each side, as a fraction of its longest side.

    Returns:
        Lower and upper corner, x, y, z.

    Raises:
        ShapeError, DTypeError: masks that are not bool (h, w), or not one for each camera.
        OptionError: a silhouette is empty, all are from one direction, nothing projects into all of them, or margin is
            negative.
    """
    who = "hull_box"
    tensors = as_tensors(cameras, who)
    check_number(who, "margin", margin, "a number, 0 at least", 0)
    if len(tensors.shape) != 1:
        raise ShapeError(f"{who}: cameras must have the leading shape (V,); got {tensors.shape}")
    if not isinstance(masks, (Tensor, Sequence)) or isinstance(masks, str):
        raise DTypeError(f"{who}: masks must be a bool tensor (V, h, w), or V of (h, w); got {describe(masks)}")
    if len(masks) == 0 or len(masks) != tensors.shape[0]:
        raise ShapeError(f"{who}: masks must be one for each of the {tensors.shape[0]} cameras; got {len(masks)}")
    for view, mask in enumerate(masks):
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.dim() != 2:
            raise DTypeError(f"{who}: masks[{view}] must be a bool tensor (h, w); got {describe(mask)}")
        if not bool(mask.any()):
            raise OptionError(f"{who}: the silhouette of view {view} is empty")
    views = [_reduced(mask, tensors.at(view)) for view, mask in enumerate(masks)]
    middle, radius = _bounding_ball(views)
    wide = [_with_rim(mask, camera) for mask, camera in views]
    lower, upper = middle - radius, middle + radius
    for _ in range(GROWTHS):
        found = _carved(wide, lower, upper)
        reaches = (found[0] <= lower).any() or (found[1] >= upper).any()
        if not reaches or len(masks) < 3:
            break
        lower, upper = middle - (middle - lower) * 1.5, middle + (upper - middle) * 1.5
    for _ in range(ROUNDS):
        lower, upper = found
        found = _carved(wide, lower, upper)
    extra = margin * float((found[1] - found[0]).max())
    low, high = (tuple(float(item) for item in corner) for corner in (found[0] - extra, found[1] + extra))
    return low, high  # type: ignore[return-value]


def default_grid(masks: Sequence[Tensor] | Tensor, cameras: Cameras, resolution: int = 128) -> VoxelGrid:
    """A grid of cubic voxels in the box around the visual hull, see `hull_box`.

    Args:
        masks: (h, w) bool of every view.
        cameras: V cameras.
        resolution: voxels along the longest side.
    """
    check_whole("default_grid", "resolution", resolution, 2, 4096)
    lower, upper = (np.array(corner) for corner in hull_box(masks, cameras))
    side = float((upper - lower).max()) / resolution
    counts = np.maximum(np.ceil((upper - lower) / side - 1e-6), 1).astype(int)
    center = (lower + upper) / 2
    width, height, depth = (int(count) for count in counts)
    low, high = center - counts * side / 2, center + counts * side / 2
    return VoxelGrid((depth, height, width), low.tolist(), high.tolist())


def _bounding_ball(views: Sequence[View]) -> tuple[np.ndarray, float]:
    """An estimate of the position (3,) and the radius of the object."""
    left, right, spans = np.zeros((3, 3)), np.zeros(3), []
    for mask, camera in views:
        origin, directions = (value.double().numpy() for value in rays(camera, tuple(mask.shape)))  # type: ignore[arg-type]
        on = directions[mask.cpu().numpy()]
        axis = on.mean(0) / np.linalg.norm(on.mean(0))
        across = np.eye(3) - np.outer(axis, axis)
        left, right = left + across, right + across @ origin
        cosine = (on @ axis).min().clip(0.1, 1.0)
        spans.append((origin, np.sqrt(1 - cosine**2) / cosine))
    if len(views) < 2 or not np.linalg.cond(left) < LARGEST_CONDITION:
        raise OptionError("hull_box: silhouettes from one direction do not bound the hull along it; give a grid")
    middle = np.linalg.solve(left, right)
    radius = max(tangent * np.linalg.norm(middle - origin) for origin, tangent in spans)
    return middle, float(1.5 * radius)


def _reduced(mask: Tensor, camera: CameraTensors) -> View:
    """A silhouette at the resolution of coarse voxels; a pixel that the object touches is on it."""
    height, width = fitted(mask.shape, LONGEST_SIDE)
    small = adaptive_max_pool2d(mask[None].to(torch.float32), (height, width))[0] > 0
    return small, resize(camera, height, width)


def _with_rim(mask: Tensor, camera: CameraTensors) -> View:
    """Distance to the contour of a silhouette, padded by half its size, and its camera."""
    rim = max(mask.shape) // 2
    height, width = (side + 2 * rim for side in mask.shape)
    return signed_distance(pad(mask, (rim,) * 4)), crop(camera, -rim, -rim, height, width)


def _carved(views: Sequence[View], lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box around the voxels of a coarse grid that may intersect the hull."""
    grid = VoxelGrid(COARSE, lower.tolist(), upper.tolist())
    half = 0.5 * float(np.linalg.norm((upper - lower) / COARSE))
    keep = torch.ones(grid.shape, dtype=torch.bool)
    for distance, camera in views:
        volume, visible = functional.unproject(
            distance[None, None, None], camera.at(None), grid, padding_mode="border", augment="depth"
        )
        depth = volume[0, 0, 1].double().clamp_min(1e-9)
        # A ball of radius r at depth z projects to a disc with a radius of about f r / (z - r) pixels.
        reach = float(camera.intrinsics[:2, :2].abs().max()) * half / (depth - half).clamp_min(0.25 * half)
        keep &= (volume[0, 0, 0] > -1.5 * reach - 1) & visible[0, 0]
    if not bool(keep.any()):
        raise OptionError("hull_box: nothing projects into all silhouettes: they do not fit the cameras")
    index = keep.nonzero().numpy()
    step = (upper - lower) / COARSE
    return lower + index.min(0)[::-1] * step, lower + (index.max(0)[::-1] + 1) * step
