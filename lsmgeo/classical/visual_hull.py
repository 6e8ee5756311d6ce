"""The largest solid that has given silhouettes."""

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
# Bytes that a slab takes for every site, at the worst moment.
BYTES_OF_A_SITE = 32
# Voxels along an axis of the coarse hulls from which a box is told, and how often it is told anew.
COARSE, ROUNDS, GROWTHS = 32, 3, 4
# Pixels of a silhouette's longer side from which a box is told.
LONGEST_SIDE = 256
# Rays that are parallel to about a degree meet nowhere.
LARGEST_CONDITION = 1e4

# A map (h, w) and its camera, of that size.
Picture = tuple[Tensor, CameraTensors]


class VisualHull(NamedTuple):
    """Which voxels a hull holds, and by how much."""

    occupancy: Tensor  # (D, H, W) or (B, D, H, W) bool
    support: Tensor  # the same shape: mean, or least, of what the silhouettes say of a voxel


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
    """Carve a grid by silhouettes: what a voxel's centre meets in every view decides whether it stays.

    Equation: with ``s_v(X)`` the silhouette of view v interpolated where X projects, "mean" keeps
    ``sum_v s_v / V > threshold`` (Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 4: 0.75),
    and "all" ``min_v s_v > threshold`` (Laurentini, "The visual hull concept for silhouette-based image understanding",
    PAMI 1994). No silhouette shows a concavity: the hull fills it, whatever the number of views.

    Convention:
        Integer pixel centres; masks of another size than the camera's image are resized for.

    Args:
        masks: (V, h, w) or (B, V, h, w), or V of any sizes (h, w): bool, or numbers that are larger on the object: a
            soft silhouette, or a distance to its outline (see `lsmgeo.classical.signed_distance`), with a threshold of
            its own.
        cameras: V cameras, or (B, V).
        grid: any; with one pose a scene where masks have a batch.
        rule: "mean" or "all".
        threshold: a voxel stays whose support is more than this; by default 0.75 for "mean" and 0.5 for "all".
        outside: what a view says of voxels that it does not see: "empty", that they are off the object, which is
            then wholly in every picture; or "unknown", nothing, and voxels that no view sees are empty.
        memory: bound in bytes on what carving holds beside masks and results.

    Returns:
        `VisualHull`.

    Raises:
        OptionError: an unknown rule, a threshold that is no number.
        ShapeError, DTypeError, CameraError, GridError: as `lsmgeo.functional.unproject`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.classical import visual_hull
        >>> views = orbit(torch.tensor([0.0, 90.0]), 0.0, 2.0, focal_length=32.0, height=16, width=16)
        >>> masks = torch.zeros(2, 16, 16, dtype=torch.bool)
        >>> masks[:, 4:12, 4:12] = True  # half the picture: from -0.25 to 0.25 at the distance of the middle
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
    leading = tensors.shape
    expected = (len(maps[0]), len(maps)) if has_batch else (len(maps),)
    if leading != expected:
        raise ShapeError(f"{who}: cameras must have the leading shape {expected}, as masks; got {leading}")
    with torch.no_grad():
        support = _support(maps, tensors, grid, rule, outside, memory)
    support = support if has_batch else support[0]
    return VisualHull(support > threshold, support)


def _support(
    maps: list[Tensor], cameras: CameraTensors, grid: VoxelGrid, rule: str, outside: str, memory: int
) -> Tensor:
    """The mean or least value (B, D, H, W) of the silhouettes at the voxels."""
    scenes = len(maps[0])
    _, height, width = grid.shape  # type: ignore[misc]
    planes = max(1, memory // (BYTES_OF_A_SITE * scenes * height * width))
    # The value off every silhouette: 0, or the least of the masks where these are distances.
    nothing = min(0.0, *(float(values.min()) for values in maps))
    start = float("inf") if rule == "all" else 0.0
    elsewhere = nothing if outside == "empty" else start
    support = maps[0].new_full((scenes, *grid.shape), start)  # type: ignore[misc]
    count = torch.zeros(support.shape, dtype=torch.int16) if outside == "unknown" else None
    # One view after another: its mask stays in the caches, and memory does not grow with the views.
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
    """(B, h, w) numbers of every view."""
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
    """A box along the world's axes that holds all that projects into every silhouette.

    A cube about the point nearest to the rays through the middles of the silhouettes, as large as these say, is carved
    coarsely, with silhouettes widened by the reach of a voxel so that nothing thin is lost; the box around what stays
    is carved again. Where two views leave the hull without an end, the box is cut off.

    Args:
        masks: (h, w) bool of every view, not empty; sizes may differ.
        cameras: V cameras.
        margin: by which the box is widened on each side, as a fraction of its longest side.

    Returns:
        Lower and upper corner as x, y, z.

    Raises:
        ShapeError, DTypeError: masks that are no bool (h, w), or not one for each camera.
        OptionError: a silhouette is empty, all are from one direction, nothing projects into all of them, or margin is
            negative.
    """
    who = "hull_box"
    tensors = as_tensors(cameras, who)
    check_number(who, "margin", margin, "a number, 0 at least", 0)
    leading = tensors.shape
    if len(leading) != 1:
        raise ShapeError(f"{who}: cameras must have the leading shape (V,); got {leading}")
    if not isinstance(masks, (Tensor, Sequence)) or isinstance(masks, str):
        raise DTypeError(f"{who}: masks must be a bool tensor (V, h, w), or V of (h, w); got {describe(masks)}")
    if len(masks) == 0 or len(masks) != leading[0]:
        raise ShapeError(f"{who}: masks must be one for each of the {leading[0]} cameras; got {len(masks)}")
    for view, mask in enumerate(masks):
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.dim() != 2:
            raise DTypeError(f"{who}: masks[{view}] must be a bool tensor (h, w); got {describe(mask)}")
        if not bool(mask.any()):
            raise OptionError(f"{who}: the silhouette of view {view} is empty")
    pictures = [_thinned(mask, tensors.at(view)) for view, mask in enumerate(masks)]
    middle, radius = _ball(pictures)
    wide = [_with_rim(mask, camera) for mask, camera in pictures]
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
    """A grid of cubic voxels around what projects into every silhouette: see `hull_box`.

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


def _ball(pictures: Sequence[Picture]) -> tuple[np.ndarray, float]:
    """About where, and how large, the object is: a point (3,) and a radius."""
    left, right, spans = np.zeros((3, 3)), np.zeros(3), []
    for mask, camera in pictures:
        origin, directions = (value.double().numpy() for value in rays(camera, tuple(mask.shape)))  # type: ignore[arg-type]
        on = directions[mask.cpu().numpy()]
        axis = on.mean(0) / np.linalg.norm(on.mean(0))
        across = np.eye(3) - np.outer(axis, axis)
        left, right = left + across, right + across @ origin
        cosine = (on @ axis).min().clip(0.1, 1.0)
        spans.append((origin, np.sqrt(1 - cosine**2) / cosine))
    if len(pictures) < 2 or not np.linalg.cond(left) < LARGEST_CONDITION:
        raise OptionError("hull_box: silhouettes from one direction bound nothing along it; give a grid of your own")
    middle = np.linalg.solve(left, right)
    radius = max(tangent * np.linalg.norm(middle - origin) for origin, tangent in spans)
    return middle, float(1.5 * radius)


def _thinned(mask: Tensor, camera: CameraTensors) -> Picture:
    """A silhouette of no more pixels than coarse voxels need; one that the object touches stays on it."""
    height, width = fitted(mask.shape, LONGEST_SIDE)
    small = adaptive_max_pool2d(mask[None].to(torch.float32), (height, width))[0] > 0
    return small, resize(camera, height, width)


def _with_rim(mask: Tensor, camera: CameraTensors) -> Picture:
    """Distance to the outline in a picture that reaches further than the silhouette's own, and its camera."""
    rim = max(mask.shape) // 2
    height, width = (side + 2 * rim for side in mask.shape)
    return signed_distance(pad(mask, (rim,) * 4)), crop(camera, -rim, -rim, height, width)


def _carved(pictures: Sequence[Picture], lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box around those voxels of a coarse grid that may reach into the hull."""
    grid = VoxelGrid(COARSE, lower.tolist(), upper.tolist())
    half = 0.5 * float(np.linalg.norm((upper - lower) / COARSE))
    keep = torch.ones(grid.shape, dtype=torch.bool)
    for distance, camera in pictures:
        volume, visible = functional.unproject(
            distance[None, None, None], camera.at(None), grid, padding_mode="border", augment="depth"
        )
        depth = volume[0, 0, 1].double().clamp_min(1e-9)
        # A ball of radius r at depth z projects into one of about f r / (z - r) pixels.
        reach = float(camera.intrinsics[:2, :2].abs().max()) * half / (depth - half).clamp_min(0.25 * half)
        keep &= (volume[0, 0, 0] > -1.5 * reach - 1) & visible[0, 0]
    if not bool(keep.any()):
        raise OptionError(
            "hull_box: nothing projects into all silhouettes: they and the cameras do not belong together"
        )
    index = keep.nonzero().numpy()
    step = (upper - lower) / COARSE
    return lower + index.min(0)[::-1] * step, lower + (index.max(0)[::-1] + 1) * step
