"""From cameras and grids to the sites that a kernel visits, with all checks of the operators' tensors.

The matrices are composed in float64, only here. Nothing below this module knows cameras or grids.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor

from lsmgeo._checks import check_devices, check_float, check_geometry, describe, moved
from lsmgeo._linalg import affine_inverse, multiply
from lsmgeo.cameras.camera_checks import check_views, views_per_scene
from lsmgeo.cameras.matrices import CameraMatrices, camera_matrices
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, leading_shape
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import DTypeError, GridError, OptionError, ShapeError
from lsmgeo.grids import DEPTHS, FrustumGrid, Lattice, VoxelGrid, check_depths, check_pixel_depths, map_size
from lsmgeo.kernels.request import Options, Sites

__all__ = [
    "Cameras",
    "Grid",
    "check_features",
    "check_points",
    "direction_matrix",
    "image_matrices",
    "image_sites",
    "splat_sites",
    "sweep_sites",
    "volume_from_points",
]

Grid = VoxelGrid | FrustumGrid


def check_features(
    who: str, features: Tensor, count: int | None = None, expected: str = "(B, V, C, h, w)"
) -> tuple[int, int]:
    """Require features of this shape, with B*V = `count` if given; return (B, V)."""
    check_float(who, "features", features, expected)
    rank = expected.count(",") + 1
    if features.dim() != rank or (count is not None and features.shape[0] * features.shape[1] != count):
        # Only here, for the error: under a trace, a number that is formatted becomes a constant of the graph.
        views = "" if count is None else f" with B*V = {count} cameras"
        product = "" if features.dim() != rank else f", that is {features.shape[0] * features.shape[1]}"
        raise ShapeError(f"{who}: features must be {expected}{views}; got {tuple(features.shape)}{product}")
    B, V, _, *sizes = features.shape
    if V < 1 or any(size < 1 for size in sizes):
        axes = ", ".join(expected.strip("()").split(", ")[3:-1])
        raise ShapeError(f"{who}: features must be {expected}, V, {axes} and w at least 1; got {tuple(features.shape)}")
    return B, V


def check_points(who: str, name: str, source: Tensor, points: Tensor) -> None:
    """Require points (B, N, 3), finite where values may be read, B and the device those of `source`, called `name`."""
    check_geometry(who, "points", points, "(B, N, 3)", rank=3)
    if points.shape[0] != source.shape[0] or points.shape[2] != 3:
        raise ShapeError(f"{who}: points must be (B, N, 3) with B = {source.shape[0]}; got {tuple(points.shape)}")
    check_devices(who, **{name: source}, points=points)
    if can_inspect(points) and not bool(points.isfinite().all()):
        raise GridError(f"{who}: points must be finite")


def image_matrices(who: str, features: Tensor, cameras: Cameras, view_mask: Tensor | None) -> CameraMatrices:
    """The cameras (B, V) of a feature map, checked, K resized to it."""
    tensors = as_tensors(cameras, who)
    views = check_features(who, features, prod(leading_shape(tensors)))
    tensors = check_views(who, tensors, views, view_mask, features=features)
    return camera_matrices(tensors, (features.shape[3], features.shape[4]), view_mask)


def _lattice(who: str, grid: Grid, source: Tensor) -> Lattice:
    if not isinstance(grid, (VoxelGrid, FrustumGrid)):
        raise DTypeError(f"{who}: grid must be a VoxelGrid or a FrustumGrid; got {describe(grid)}")
    if not isinstance(source, Tensor):
        return grid.lattice()
    lattice = grid.lattice(source.device)
    T, z = lattice.world_from_lattice, lattice.z
    for scenes in [tensor.shape[0] for tensor, shared in ((T, 2), (z, 1)) if tensor.dim() > shared]:
        if scenes != source.shape[0]:
            raise ShapeError(
                f"{who}: grid must have one pose and one row of depths, or as many as scenes, B = {source.shape[0]}; "
                f"got {scenes}"
            )
    return lattice


def direction_matrix(matrices: CameraMatrices, T: Tensor, frame: str) -> Tensor:
    """G, (B, V, 3, 4), whose ``G q`` points from the camera centre to the site."""
    if frame == "camera":
        extrinsics = torch.cat((matrices.rotation, matrices.translation[..., None]), -1)
        return multiply(extrinsics, T)
    return T[..., :3, :] - matrices.center[..., None] * T[..., 3:, :]


def image_sites(
    who: str,
    features: Tensor,
    cameras: Cameras,
    grid: Grid,
    view_mask: Tensor | None,
    options: Options,
    reference: Tensor | None = None,
) -> Sites:
    """The checked sites of a grid in the views' images."""
    lattice = _lattice(who, grid, features)
    matrices = image_matrices(who, features, cameras, view_mask)
    _check_reference(who, reference, features, grid, options)
    T, x, y, z, projective = lattice
    T = T if T.dim() == 2 else T[:, None]  # (B, 1, 4, 4): shared by the views
    if z.dim() == 5:  # depths of pixels
        if view_mask is not None:  # those that only masked views would read are not read
            z = torch.where(view_mask.any(1)[:, None, None, None, None], z, 1.0)
        check_pixel_depths(who, z[:, 0])
    direction = direction_matrix(matrices, T, options.direction) if options.direction else None
    return Sites(multiply(matrices.projection(), T), direction, x, y, z, projective, view_mask)


def _check_reference(who: str, reference: Tensor | None, features: Tensor, grid: Grid, options: Options) -> None:
    groups, channels = options.groups, features.shape[2]
    if reference is None:
        if groups > 1:
            raise OptionError(f"{who}: groups must be 1 without a reference; got {groups}")
        return
    expected = "(B, C, D or 1, H, W)"
    check_float(who, "reference", reference, expected, rank=5)
    if reference.dtype != features.dtype:
        raise DTypeError(f"{who}: reference must be of the features' {features.dtype}; got {reference.dtype}")
    check_devices(who, features=features, reference=reference)
    depth, height, width = grid.shape  # type: ignore[misc]
    shape = (features.shape[0], channels, reference.shape[2], height, width)
    if tuple(reference.shape) != shape or reference.shape[2] not in (1, depth):
        raise ShapeError(
            f"{who}: reference must be {expected} with (B, C) = {(features.shape[0], channels)} and the grid's "
            f"(D, H, W) = {grid.shape}; got {tuple(reference.shape)}"
        )
    if channels % groups:
        raise OptionError(f"{who}: groups must divide the C = {channels} channels; got {groups}")


def sweep_sites(
    who: str,
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    size: tuple[int, int] | None,
    view_mask: Tensor | None,
    options: Options,
    per_pixel: bool = True,
) -> Sites:
    """The checked sites of the views' frustums in a volume; depths may be those of each pixel if `per_pixel`."""
    check_float(who, "volume", volume, "(B, C, D, H, W)", rank=5)
    _check_voxel_grid(who, grid)
    _check_on_grid(who, volume, grid)
    tensors = as_tensors(cameras, who)
    views = views_per_scene(who, tensors, volume.shape[0], "volume's")
    axes = (1, 2, 3, 5) if per_pixel else (1, 2, 3)
    return _frustum_sites(who, {"volume": volume}, tensors, views, grid, depths, axes, size, view_mask, options)


def splat_sites(
    who: str,
    features: Tensor,
    weights: Tensor | None,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    view_mask: Tensor | None,
    options: Options,
) -> Sites:
    """The checked sites in a volume of features (B, V, C, h, w) with weights, or (B, V, C, P, h, w) without."""
    tensors = as_tensors(cameras, who)
    count = prod(leading_shape(tensors))
    if weights is None:
        if isinstance(features, Tensor) and features.dim() == 5:
            expected = "(B, V, C, P, h, w), or (B, V, C, h, w) with weights= (B, V, P, h, w)"
            raise ShapeError(f"{who}: features must be {expected}; got {tuple(features.shape)} without weights")
        views = check_features(who, features, count, "(B, V, C, P, h, w)")
    else:
        views = check_features(who, features, count)
        check_float(who, "weights", weights, "(B, V, P, h, w)", rank=5)
        if weights.dtype != features.dtype:
            raise DTypeError(f"{who}: weights must be of the features' {features.dtype}; got {weights.dtype}")
    _check_voxel_grid(who, grid)
    height, width = features.shape[-2:]
    if isinstance(depths, Tensor) and depths.dim() == 5 and tuple(depths.shape[-2:]) != (height, width):
        size = f"the features' (h, w) = {(height, width)}"
        raise ShapeError(f"{who}: depths must be {DEPTHS[5]} with {size}; got {tuple(depths.shape)}")
    given = {"features": features} if weights is None else {"features": features, "weights": weights}
    sites = _frustum_sites(who, given, tensors, views, grid, depths, (1, 2, 3, 5), (height, width), view_mask, options)
    planes = (*views, sites.counts()[0], height, width)
    if weights is not None and tuple(weights.shape) != planes:
        raise ShapeError(f"{who}: weights must be (B, V, P, h, w) = {planes}; got {tuple(weights.shape)}")
    if weights is None and features.shape[3] != planes[2]:
        raise ShapeError(
            f"{who}: features must be (B, V, C, P, h, w) with the depths' P = {planes[2]}; got {tuple(features.shape)}"
        )
    return sites


def volume_from_points(who: str, volume: Tensor, grid: Grid, points: Tensor) -> tuple[Tensor, Tensor | None]:
    """A matrix (B, 1, 3, 4) that maps checked points (X, 1) to a volume on a grid, and depths.

    To the index on a `VoxelGrid`, with no depths; to the homogeneous pixel, whose third coordinate is the depth, on a
    `FrustumGrid`, with the depths of its planes, (P,) or (B, P) in float64.
    """
    check_float(who, "volume", volume, "(B, C, D, H, W)", rank=5)
    lattice = _lattice(who, grid, volume)
    _check_on_grid(who, volume, grid)
    check_points(who, "volume", volume, points)
    depths = None
    if isinstance(grid, VoxelGrid):
        rows = affine_inverse(lattice.world_from_lattice)[..., :3, :]
    else:
        if grid.depths.dim() == 4:
            raise ShapeError(
                f"{who}: grid must have depths (P,) or (B, P), not of each pixel; got {tuple(grid.depths.shape)}"
            )
        inverse = moved(who, "grid", grid.lattice_from_world, volume.device)
        rows = torch.cat((inverse[..., :2, :], inverse[..., 3:, :]), -2)
        depths = moved(who, "grid", grid.depths, volume.device).double()
    return rows.expand(volume.shape[0], 3, 4)[:, None], depths


def _check_on_grid(who: str, volume: Tensor, grid: Grid) -> None:
    if tuple(volume.shape[2:]) != grid.shape:
        raise ShapeError(
            f"{who}: volume must be (B, C, D, H, W) with the grid's (D, H, W) = {grid.shape}; got {tuple(volume.shape)}"
        )


def _check_voxel_grid(who: str, grid: VoxelGrid) -> None:
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")


def _frustum_sites(
    who: str,
    given: dict[str, Tensor],
    tensors: CameraTensors,
    views: tuple[int, int],
    grid: VoxelGrid,
    depths: Tensor,
    axes: Sequence[int],
    size: tuple[int, int] | None,
    view_mask: Tensor | None,
    options: Options,
) -> Sites:
    """The sites of the views' frustums in a volume; on the device of the `given` tensors, the first (B, ...)."""
    source = next(iter(given.values()))
    lattice = _lattice(who, grid, source)
    tensors = check_views(who, tensors, views, view_mask, **given)
    check_depths(who, depths, axes, view_mask)
    if depths.dim() > 1 and tuple(depths.shape[: min(depths.dim() - 1, 2)]) != views[: depths.dim() - 1]:
        raise ShapeError(
            f"{who}: depths must be {DEPTHS[depths.dim()]} with (B, V) = {views}; got {tuple(depths.shape)}"
        )
    check_devices(who, **given, depths=depths)
    size = map_size(who, tensors, depths, size)
    matrices = camera_matrices(tensors, size, view_mask)
    frustum = matrices.world_from_frustum()
    inverse = affine_inverse(lattice.world_from_lattice)[..., :3, :]
    matrix = multiply(inverse if inverse.dim() == 2 else inverse[:, None], frustum)
    direction = direction_matrix(matrices, frustum, options.direction) if options.direction else None
    x, y = (torch.arange(n, dtype=torch.float64, device=source.device) for n in (size[1], size[0]))
    if view_mask is not None and depths.dim() > 2:  # those of masked views are not read
        depths = torch.where(view_mask.reshape(*views, *(1,) * (depths.dim() - 2)), depths, 1.0)
    check_pixel_depths(who, depths)
    z = depths if depths.dim() == 5 else 1.0 / depths.double()
    return Sites(matrix, direction, x, y, z, True, view_mask)
