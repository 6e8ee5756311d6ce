"""From cameras and grids to the sites that a kernel visits, with all checks of the operators' tensors.

The matrices are composed in float64, only here. Nothing below this module knows cameras or grids.
"""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor

from lsmgeo._checks import check_devices, check_float, describe
from lsmgeo._linalg import affine_inverse, multiply
from lsmgeo.cameras.camera_checks import check_views, image_size, views_per_scene
from lsmgeo.cameras.matrices import CameraMatrices, camera_matrices
from lsmgeo.cameras.tensors import Cameras, as_tensors, leading_shape
from lsmgeo.errors import DTypeError, ShapeError
from lsmgeo.grids import FrustumGrid, Lattice, VoxelGrid, check_depths
from lsmgeo.kernels.request import Options, Sites

__all__ = ["Cameras", "Grid", "check_features", "direction_matrix", "image_matrices", "image_sites", "sweep_sites"]

Grid = VoxelGrid | FrustumGrid


def check_features(who: str, features: Tensor, count: int | None = None) -> tuple[int, int]:
    """Require (B, V, C, h, w), with B*V = `count` if given; return (B, V)."""
    expected = "(B, V, C, h, w)"
    check_float(who, "features", features, expected)
    if features.dim() != 5 or (count is not None and features.shape[0] * features.shape[1] != count):
        # Only here, for the error: under a trace, a number that is formatted becomes a constant of the graph.
        views = "" if count is None else f" with B*V = {count} cameras"
        product = "" if features.dim() != 5 else f", that is {features.shape[0] * features.shape[1]}"
        raise ShapeError(f"{who}: features must be {expected}{views}; got {tuple(features.shape)}{product}")
    B, V, _, h, w = features.shape
    if V < 1 or h < 1 or w < 1:
        raise ShapeError(f"{who}: features must be {expected}, V, h and w at least 1; got {tuple(features.shape)}")
    return B, V


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
    for scenes in (*T.shape[:-2], *z.shape[:-1]):
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
) -> Sites:
    """The checked sites of a grid in the views' images."""
    lattice = _lattice(who, grid, features)
    matrices = image_matrices(who, features, cameras, view_mask)
    T, x, y, z, projective = lattice
    T = T if T.dim() == 2 else T[:, None]  # (B, 1, 4, 4): shared by the views
    direction = direction_matrix(matrices, T, options.direction) if options.direction else None
    return Sites(multiply(matrices.projection(), T), direction, x, y, z, projective, view_mask)


def sweep_sites(
    who: str,
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    size: tuple[int, int] | None,
    view_mask: Tensor | None,
    options: Options,
) -> Sites:
    """The checked sites of the views' frustums in a volume."""
    check_float(who, "volume", volume, "(B, C, D, H, W)", rank=5)
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
    if tuple(volume.shape[2:]) != grid.shape:
        raise ShapeError(
            f"{who}: volume must be (B, C, D, H, W) with the grid's (D, H, W) = {grid.shape}; got {tuple(volume.shape)}"
        )
    tensors = as_tensors(cameras, who)
    views = views_per_scene(who, tensors, volume.shape[0], "volume's")
    lattice = _lattice(who, grid, volume)
    tensors = check_views(who, tensors, views, view_mask, volume=volume)
    check_depths(who, depths, "(P,), (B, P) or (B, V, P)", view_mask)
    if depths.dim() > 1 and tuple(depths.shape[:-1]) != views[: depths.dim() - 1]:
        raise ShapeError(
            f"{who}: depths must be (P,), (B, P) or (B, V, P) with (B, V) = {views}; got {tuple(depths.shape)}"
        )
    check_devices(who, volume=volume, depths=depths)
    size = image_size(who, tensors, size)
    matrices = camera_matrices(tensors, size, view_mask)
    frustum = matrices.world_from_frustum()
    inverse = affine_inverse(lattice.world_from_lattice)[..., :3, :]
    matrix = multiply(inverse if inverse.dim() == 2 else inverse[:, None], frustum)
    direction = direction_matrix(matrices, frustum, options.direction) if options.direction else None
    x, y = (torch.arange(n, dtype=torch.float64, device=volume.device) for n in (size[1], size[0]))
    if view_mask is not None and depths.dim() == 3:
        depths = torch.where(view_mask[..., None], depths, 1.0)
    return Sites(matrix, direction, x, y, 1.0 / depths.double(), True, view_mask)
