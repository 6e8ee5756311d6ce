"""The fusion of depth maps of many views into one signed distance."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from lsmgeo import functional
from lsmgeo._checks import check_finite, check_geometry, check_mask, check_positive, check_whole, describe
from lsmgeo._sites import Cameras
from lsmgeo.cameras import CameraTensors, as_tensors, resize, unproject_depth
from lsmgeo.errors import DTypeError, GridError, OptionError, ShapeError
from lsmgeo.grids import VoxelGrid

__all__ = ["Tsdf", "fuse_depth", "voxel_side"]

# The default truncation in voxels.
TRUNCATION = 3.0
# The largest count of numbers in memory per voxel of a slab (measured).
LIVE = 42


class Tsdf(NamedTuple):
    """A truncated signed distance on a grid: positive outside, negative inside, 0 on the surface."""

    distance: Tensor  # (D, H, W) world units, in [-truncation, truncation]; 0 where the weight is 0
    weight: Tensor  # (D, H, W) sum of the weights of the views, 0 where nothing was observed
    colours: Tensor | None  # (3, D, H, W) RGB in [0, 1], 0 where no surface is near


def fuse_depth(
    depths: Tensor | Iterable[Tensor],
    cameras: Cameras,
    grid: VoxelGrid,
    *,
    truncation: float | None = None,
    colours: Tensor | Iterable[Tensor] | None = None,
    background: Tensor | Iterable[Tensor] | None = None,
    memory: int = 1 << 28,
) -> Tsdf:
    """Fuse depth maps into one signed distance, view after view.

    Equation: ``D(X) = sum_v w_v clip(d_v) / sum_v w_v``, where ``d_v`` is the distance along the ray of view v from X
    to the surface of its depth map: positive in front of it, clipped to the truncation; voxels further behind than the
    truncation are not updated. The weight of a view is the cosine between its ray and the surface normal, times
    ``(1 + d / truncation)^2`` behind the surface, so that the two sides of a thin object interfere little.
    (Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996, sections 3
    and 5.)

    Between pixels inverse depth is interpolated, which is exact on planes; where depth bends by more than the
    truncation, as at a jump, and next to pixels without depth, that of the nearest pixel is used. Gaps of one pixel are
    filled first: a pixel without depth takes the mean of opposite neighbours that differ by less than the truncation.

    Convention:
        Depth is camera z, 0 where there is none: such pixels are not used, unless they are `background`. Integer pixel
        centres; cameras are resized to the depth maps.

    Args:
        depths: (V, h, w), or any iterable of V maps (h, w) of any sizes, read one at a time; float32 or float64.
        cameras: V cameras.
        grid: of the result; one scene, any shape and pose.
        truncation: world units; by default 3 times the longest side of a voxel. It should be above the noise of depth,
            and larger for surfaces that are seen only at grazing angles, behind which rays cross few voxels.
        colours: (V, 3, h, w) RGB in [0, 1], or an iterable of V, of the sizes and dtype of the depth maps.
        background: (V, h, w) bool, or an iterable of V: pixels whose rays hit nothing, so that all voxels on them are
            outside. The outermost pixels of each region are not used.
        memory: bound in bytes on the memory besides the results and the maps of one view.

    Returns:
        `Tsdf` of the dtype of the depth maps. Not differentiable.

    Raises:
        ShapeError, DTypeError: invalid maps, of other sizes than the depth maps, or not V of them.
        OptionError: depths that are negative or not finite, colours that are not finite, truncation not positive.
        GridError: a grid with a batch of poses.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.classical import fuse_depth
        >>> view = orbit(torch.zeros(1), 0.0, 2.0, focal_length=40.0, height=32, width=32)
        >>> wall = torch.full((1, 32, 32), 2.0)
        >>> fuse_depth(wall, view, VoxelGrid(4), truncation=0.5).distance[1, 2]
        tensor([-0.3760, -0.1254,  0.1256,  0.3772])
    """
    who = "fuse_depth"
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
    if grid.world_from_lattice.dim() != 2:
        raise GridError(f"{who}: grid must be of one scene; got {grid}")
    tensors = as_tensors(cameras, who)
    if len(tensors.shape) != 1 or not tensors.shape[0]:
        raise ShapeError(f"{who}: cameras must have the leading shape (V,), V at least 1; got {tensors.shape}")
    truncation = TRUNCATION * voxel_side(grid) if truncation is None else truncation
    check_positive(who, "truncation", truncation)
    check_whole(who, "memory", memory, 1)
    named = {"depths": depths, "colours": colours, "background": background}
    columns = [_each(who, name, value, tensors.shape[0]) for name, value in named.items()]
    sums: _Sums | None = None
    with torch.no_grad():
        for view, given in enumerate(zip(*columns, strict=True)):
            maps = _checked(who, view, *given)
            if sums is None:
                sums = _Sums(grid, maps.depth, coloured=colours is not None)
            elif maps.depth.dtype != sums.distance.dtype:
                raise DTypeError(f"{who}: depths must be of one dtype; got {sums.distance.dtype}, {maps.depth.dtype}")
            _fuse_view(sums, maps, tensors.at(view), grid, truncation, memory)
    assert sums is not None  # V is at least 1
    return sums.finish()


def voxel_side(grid: VoxelGrid) -> float:
    """The longest side of the voxels of a grid, world units."""
    return float(grid.world_from_lattice[..., :3, :3].norm(dim=-2).max())


class _Maps(NamedTuple):
    """The maps of one view: (h, w) each, colours (3, h, w)."""

    depth: Tensor
    colours: Tensor | None
    background: Tensor | None


class _Sums:
    """Running sums over the views."""

    def __init__(self, grid: VoxelGrid, like: Tensor, *, coloured: bool) -> None:
        self.distance = like.new_zeros(grid.shape)
        self.weight = torch.zeros_like(self.distance)
        self.colours = like.new_zeros((3, *grid.shape)) if coloured else None  # type: ignore[misc]
        self.near = torch.zeros_like(self.distance) if coloured else None

    def finish(self) -> Tsdf:
        # Plane by plane, so that no second volume is held.
        for plane, weight in enumerate(self.weight):
            self.distance[plane] /= torch.where(weight > 0, weight, 1)
        if self.colours is not None and self.near is not None:
            for plane, near in enumerate(self.near):
                self.colours[:, plane] /= torch.where(near > 0, near, 1)
        return Tsdf(self.distance, self.weight, self.colours)


def _fuse_view(
    sums: _Sums, maps: _Maps, camera: CameraTensors, grid: VoxelGrid, truncation: float, memory: int
) -> None:
    height, width = maps.depth.shape
    camera = resize(camera, height, width)
    smooth, nearest = _feature_maps(maps, camera, truncation)
    planes = max(1, memory // (LIVE * smooth.element_size() * grid.shape[1] * grid.shape[2]))  # type: ignore[index]
    views, augment = camera.at(None), ("depth", "direction")
    interpolated = functional.unproject_slabs(
        smooth, views, grid, planes, padding_mode="border", augment=augment, direction_frame="camera"
    )
    taken = functional.unproject_slabs(nearest, views, grid, planes, mode="nearest", padding_mode="border")
    first = 0
    for (_, between, visible), (_, exact, _) in zip(interpolated, taken, strict=True):
        count = visible.numel()
        seen = visible.flatten() & (exact[0, 0, 1] > 0).flatten()
        at = seen.nonzero()[:, 0]  # most views update few voxels
        inverse, roughness, z, along = (between[0, 0, row].flatten().index_select(0, at) for row in (0, 1, 2, 5))
        pixel, weight = (row.flatten().index_select(0, at) for row in exact[0, 0])
        is_rough = roughness > 0
        inverse = torch.where(is_rough, pixel, inverse)
        # Where a ray hits nothing, inverse depth is 0 and the distance infinite.
        distance = (1 / inverse - z) / along
        near = distance > -truncation
        at, distance, weight = at[near] + first, distance[near], weight[near]
        weight = weight * (1 + distance / truncation).clamp(0, 1).square()
        sums.distance.view(-1)[at] += weight * distance.clamp_max(truncation)
        sums.weight.view(-1)[at] += weight
        if maps.colours is not None:
            close = distance < truncation
            share = weight[close] * (1 - distance[close].abs() / truncation)
            _add_colours(sums, maps.colours, views, grid, at[close], share, is_rough[near][close])
        first += count


def _add_colours(
    sums: _Sums, colours: Tensor, views: CameraTensors, grid: VoxelGrid, at: Tensor, share: Tensor, is_rough: Tensor
) -> None:
    """Add the colours of an image at the voxels with flat indices ``at``, times their weights ``share``."""
    assert sums.colours is not None
    assert sums.near is not None
    _, height, width = grid.shape  # type: ignore[misc]
    T = grid.world_from_lattice.to(at.device)
    index = torch.stack((at % width, at // width % height, at // (width * height)), -1).to(T.dtype)
    points = index @ T[:3, :3].T + T[:3, 3]
    for mode, some in (("bilinear", ~is_rough), ("nearest", is_rough)):
        seen = functional.unproject_points(
            colours[None, None], views, points[some][None], mode=mode, padding_mode="border"
        ).volume[0, 0]
        sums.colours.view(3, -1)[:, at[some]] += seen * share[some]
    sums.near.view(-1)[at] += share


def _feature_maps(maps: _Maps, camera: CameraTensors, truncation: float) -> tuple[Tensor, Tensor]:
    """The maps to interpolate: inverse depth and roughness; and not to: inverse depth and weight, 0 if unknown."""
    depth = maps.depth
    has_depth = depth > 0
    inverse = _without_cracks(torch.where(has_depth, 1 / torch.where(has_depth, depth, 1), 0), truncation)
    inner = None
    if maps.background is not None:
        # A minimum filter: the outermost pixels are left out.
        inner = -max_pool2d(-maps.background[None, None].to(depth.dtype), 3, 1, 1)[0, 0] > 0
        inverse = torch.where(inner, 0, inverse)
    rough, weight = _is_rough(inverse, truncation), _cosine(inverse, camera)
    if inner is not None:
        weight = torch.where(inner, 1, weight)
    smooth = torch.stack((inverse, rough.to(depth.dtype)))
    nearest = torch.stack((inverse, weight))
    return smooth[None, None], nearest[None, None]


def _without_cracks(inverse: Tensor, truncation: float) -> Tensor:
    """Inverse depth (h, w) in which a pixel without any takes the mean of opposite neighbours that agree."""
    height, width = inverse.shape
    wide = pad(inverse, (1, 1, 1, 1))
    total, count = torch.zeros_like(inverse), torch.zeros_like(inverse)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        first = wide[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        second = wide[1 - down : 1 - down + height, 1 - right : 1 - right + width]
        # |1 / first - 1 / second| < truncation; false if one has no depth.
        agrees = (first - second).abs() < truncation * first * second
        total += torch.where(agrees, (first + second) / 2, 0)
        count += agrees
    return torch.where((inverse == 0) & (count > 0), total / count.clamp_min(1), inverse)


def _is_rough(inverse: Tensor, truncation: float) -> Tensor:
    """Whether depth bends by more than the truncation at a pixel, or a neighbour has no depth, (h, w) bool.

    Second differences of inverse depth are 0 on every plane, however steep, and large on both sides of a jump.
    """
    rough = -max_pool2d(-inverse[None, None], 3, 1, 1)[0, 0] <= 0
    for axis in (0, 1):
        bend = pad(inverse.diff(2, axis), (1, 1, 0, 0) if axis else (0, 0, 1, 1))[: len(inverse), : inverse.shape[1]]
        rough |= bend.abs() > truncation * inverse.square()
    return rough


def _cosine(inverse: Tensor, camera: CameraTensors) -> Tensor:
    """Cosine between ray and surface normal, (h, w); 0 where there is no depth, 1 where no neighbour has any.

    The plane ``n . X = 1`` in the camera frame has the inverse depth ``n . K^-1 p``, linear in the pixel p, so its
    gradient gives n, and the cosine is ``1 / (|n| |X|)``.
    """
    height, width = inverse.shape
    K = camera.intrinsics.to(inverse)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    u, v = u.to(inverse), v.to(inverse)
    du, dv = _slope(inverse, 1), _slope(inverse, 0)
    normal = torch.stack((du, dv, inverse - du * u - dv * v), -1) @ K
    at_origin = camera._replace(cam_from_world=torch.eye(4).to(camera.cam_from_world)).at(None)
    length = unproject_depth(at_origin, torch.ones_like(inverse)[None, None])[0, 0].norm(dim=-1)
    found = inverse > 0
    return torch.where(found, (inverse / (normal.norm(dim=-1) * length).clamp_min(1e-30)).clamp(0, 1), 0)


def _slope(inverse: Tensor, axis: int) -> Tensor:
    """The smaller of the two one-sided differences along an axis, which crosses no jump."""
    step = inverse.diff(dim=axis)
    found = inverse > 0
    valid = found.narrow(axis, 0, step.shape[axis]) & found.narrow(axis, 1, step.shape[axis])
    step = torch.where(valid, step, torch.inf)
    missing = torch.full_like(inverse.narrow(axis, 0, 1), torch.inf)
    after, before = torch.cat((step, missing), axis), torch.cat((missing, step), axis)
    slope = torch.where(after.abs() <= before.abs(), after, before)
    return torch.where(slope.isfinite(), slope, 0)


def _each(who: str, name: str, value: Tensor | Iterable[Tensor] | None, views: int) -> Iterator[Tensor | None]:
    """The maps of the views one after another; None for every view without maps."""
    if value is None:
        yield from (None,) * views
        return
    count = 0
    for count, item in enumerate(value, 1):
        if count > views:
            break
        yield item
    if count != views:
        raise ShapeError(f"{who}: {name} must hold one map for each of the {views} cameras; got {count}")


def _checked(who: str, view: int, depth: Any, colours: Any, background: Any) -> _Maps:
    check_geometry(who, f"depths[{view}]", depth, "(h, w)", rank=2)
    size = tuple(depth.shape)
    if not bool((depth.isfinite() & (depth >= 0)).all()):
        raise OptionError(f"{who}: depths[{view}] must be finite and not negative, 0 where there is none")
    if colours is not None:
        check_geometry(who, f"colours[{view}]", colours, "(3, h, w)", rank=3, dtypes=(depth.dtype,))
        if tuple(colours.shape) != (3, *size):
            raise ShapeError(f"{who}: colours[{view}] must be {(3, *size)}; got {tuple(colours.shape)}")
        check_finite(who, f"colours[{view}]", colours)
    if background is not None:
        check_mask(who, f"background[{view}]", background, size, "(h, w)")
    return _Maps(depth, colours, background)
