"""Depth maps of many views fused into one signed distance."""

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

# Voxels on each side of a surface that hear of it by default.
TRUNCATION = 3.0
# Numbers alive for every voxel of a slab at the worst moment (measured).
LIVE = 42


class Tsdf(NamedTuple):
    """A truncated signed distance on a grid: positive outside, negative inside, 0 on the surface."""

    distance: Tensor  # (D, H, W) world units, in [-truncation, truncation]; 0 where the weight is
    weight: Tensor  # (D, H, W) sum of the weights of the views, 0 where none saw
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

    Equation: ``D(X) = sum_v w_v clip(d_v) / sum_v w_v``, where ``d_v`` is the distance along view v's ray from X on to
    the surface that its depth map shows there: positive in front of it, clipped to the truncation; voxels further
    behind than the truncation learn nothing. A view's weight is the cosine between its ray and the surface's normal,
    times ``(1 + d / truncation)^2`` behind the surface, so that the two sides of a thin thing disturb each other
    little. (Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996,
    sections 3 and 5.)

    Between pixels inverse depth is interpolated, which is exact on planes; next to a bend by more than the truncation,
    as at a jump, and next to pixels without depth, the nearest pixel's is taken. Cracks are closed first: a pixel
    without depth between opposite neighbours whose depths differ by less than the truncation takes their mean.

    Convention:
        Depth is camera z, 0 where there is none: such pixels say nothing, unless they are `background`. Integer pixel
        centres; a depth map of another size than the camera's image is resized for.

    Args:
        depths: (V, h, w), or any iterable of V maps (h, w) of any sizes, read one at a time; float32 or float64.
        cameras: V cameras.
        grid: where to fuse; of one scene, any shape and pose.
        truncation: world units; by default 3 times the longest side of a voxel. Noise of depth should stay below it,
            and what is seen only at a grazing angle needs more: behind it, rays cross few voxels before the truncation.
        colours: (V, 3, h, w) RGB in [0, 1], or an iterable of V, of the depth maps' sizes and dtype.
        background: (V, h, w) bool, or an iterable of V: pixels of which it is known that their rays hit nothing. All
            that they cross is outside. Their rim, one pixel wide, is left out.
        memory: bound in bytes on what fusing holds beside the results and one view's maps.

    Returns:
        `Tsdf` of the depths' dtype. Not differentiable.

    Raises:
        ShapeError, DTypeError: maps that are none, of other sizes than the depth maps, or not V of them.
        OptionError: depths that are negative or not finite, colours that are not finite, no positive truncation.
        GridError: a grid with one pose a scene.

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
    _check_grid(who, grid)
    tensors = as_tensors(cameras, who)
    if tensors.intrinsics.dim() != 3 or not len(tensors.intrinsics):
        raise ShapeError(f"{who}: cameras must have the leading shape (V,), V at least 1; got {tensors.shape}")
    views = len(tensors.intrinsics)
    truncation = TRUNCATION * voxel_side(grid) if truncation is None else truncation
    check_positive(who, "truncation", truncation)
    check_whole(who, "memory", memory, 1)
    columns = [
        _each(who, name, value, views)
        for name, value in (
            ("depths", depths),
            ("colours", colours),
            ("background", background),
        )
    ]
    sums: _Sums | None = None
    with torch.no_grad():
        for view, given in enumerate(zip(*columns, strict=True)):
            maps = _checked(who, view, *given)
            if sums is None:
                sums = _Sums(grid, maps.depth, coloured=colours is not None)
            elif maps.depth.dtype != sums.distance.dtype:
                raise DTypeError(f"{who}: depths must be of one dtype; got {sums.distance.dtype}, {maps.depth.dtype}")
            _fuse_view(sums, maps, tensors.at(view), grid, truncation, memory)
    assert sums is not None  # cameras are at least one
    return sums.finish()


def voxel_side(grid: VoxelGrid) -> float:
    """The longest side of a grid's voxels, world units."""
    return float(grid.world_from_lattice[..., :3, :3].norm(dim=-2).max())


class _Maps(NamedTuple):
    """What is known of one view's pixels, (h, w) each, colours (3, h, w)."""

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
    planes = _slab_planes(grid, smooth, memory)
    views, augment = camera.at(None), ("depth", "direction")
    interpolated = functional.unproject_slabs(
        smooth, views, grid, planes, padding_mode="border", augment=augment, direction_frame="camera"
    )
    taken = functional.unproject_slabs(nearest, views, grid, planes, mode="nearest", padding_mode="border")
    first = 0
    for (_, between, visible), (_, exact, _) in zip(interpolated, taken, strict=True):
        count = visible.numel()
        seen = visible.flatten() & (exact[0, 0, 1] > 0).flatten()
        at = seen.nonzero()[:, 0]  # of most views most voxels learn nothing
        inverse, roughness, z, along = (between[0, 0, row].flatten().index_select(0, at) for row in (0, 1, 2, 5))
        pixel, weight = (row.flatten().index_select(0, at) for row in exact[0, 0])
        is_rough = roughness > 0
        inverse = torch.where(is_rough, pixel, inverse)
        # Where a ray hits nothing, inverse depth is 0 and the surface infinitely far.
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
    """Add what a view's picture shows at voxels ``at``, counted through the grid, times their shares of it."""
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
    """What is interpolated: inverse depth and roughness; and what is not: inverse depth and weight, 0 if unknown."""
    depth = maps.depth
    has_depth = depth > 0
    inverse = _without_cracks(torch.where(has_depth, 1 / torch.where(has_depth, depth, 1), 0), truncation)
    inner = None
    if maps.background is not None:
        # The largest of the negative is the least: a rim of one pixel is no background.
        inner = -max_pool2d(-maps.background[None, None].to(depth.dtype), 3, 1, 1)[0, 0] > 0
        inverse = torch.where(inner, 0, inverse)
    rough, weight = _is_rough(inverse, truncation), _cosine(inverse, camera)
    if inner is not None:
        weight = torch.where(inner, 1, weight)
    smooth = torch.stack((inverse, rough.to(depth.dtype)))
    nearest = torch.stack((inverse, weight))
    return smooth[None, None], nearest[None, None]


def _without_cracks(inverse: Tensor, truncation: float) -> Tensor:
    """Inverse depth (h, w) in which a pixel that has none takes the mean of opposite neighbours that agree."""
    height, width = inverse.shape
    wide = pad(inverse, (1, 1, 1, 1))
    total, count = torch.zeros_like(inverse), torch.zeros_like(inverse)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        first = wide[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        second = wide[1 - down : 1 - down + height, 1 - right : 1 - right + width]
        # |1 / first - 1 / second| < truncation; false where one has no depth.
        agrees = (first - second).abs() < truncation * first * second
        total += torch.where(agrees, (first + second) / 2, 0)
        count += agrees
    return torch.where((inverse == 0) & (count > 0), total / count.clamp_min(1), inverse)


def _is_rough(inverse: Tensor, truncation: float) -> Tensor:
    """Whether depth bends by more than the truncation at a pixel, or a neighbour has none, (h, w) bool.

    Second differences of inverse depth are 0 on every plane, however steep, and large on both sides of a jump.
    """
    rough = -max_pool2d(-inverse[None, None], 3, 1, 1)[0, 0] <= 0
    for axis in (0, 1):
        bend = pad(inverse.diff(2, axis), (1, 1, 0, 0) if axis else (0, 0, 1, 1))[: len(inverse), : inverse.shape[1]]
        rough |= bend.abs() > truncation * inverse.square()
    return rough


def _cosine(inverse: Tensor, camera: CameraTensors) -> Tensor:
    """Cosine between ray and surface normal, (h, w); 0 where there is no depth, 1 where no neighbour has any.

    The plane ``n . X = 1`` of the camera's frame has the inverse depth ``n . K^-1 p``, linear in the pixel p, so its
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
    """Change to the next pixel along an axis: the smaller of the two one-sided ones, which crosses no jump."""
    step = inverse.diff(dim=axis)
    found = inverse > 0
    valid = found.narrow(axis, 0, step.shape[axis]) & found.narrow(axis, 1, step.shape[axis])
    step = torch.where(valid, step, torch.inf)
    missing = torch.full_like(inverse.narrow(axis, 0, 1), torch.inf)
    after, before = torch.cat((step, missing), axis), torch.cat((missing, step), axis)
    slope = torch.where(after.abs() <= before.abs(), after, before)
    return torch.where(slope.isfinite(), slope, 0)


def _slab_planes(grid: VoxelGrid, features: Tensor, memory: int) -> int:
    _, height, width = grid.shape  # type: ignore[misc]
    return max(1, memory // (LIVE * features.element_size() * height * width))


def _check_grid(who: str, grid: Any) -> None:
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
    if grid.world_from_lattice.dim() != 2:
        raise GridError(f"{who}: grid must be of one scene; got {grid}")


def _each(who: str, name: str, value: Tensor | Iterable[Tensor] | None, views: int) -> Iterator[Tensor | None]:
    """The maps of the views one after another; None for each where there are none."""
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
            raise ShapeError(
                f"{who}: colours[{view}] must be {(3, *size)}, of its depth map; got {tuple(colours.shape)}"
            )
        check_finite(who, f"colours[{view}]", colours)
    if background is not None:
        check_mask(who, f"background[{view}]", background, size, "(h, w)")
    return _Maps(depth, colours, background)
