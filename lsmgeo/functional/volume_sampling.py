"""Operators that sample volumes, as functions. All checks of their arguments live here and in `_sites`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo import kernels
from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo._sites import Cameras, Grid, splat_sites, sweep_sites, volume_from_points
from lsmgeo.functional.image_sampling import Names
from lsmgeo.grids import VoxelGrid
from lsmgeo.kernels.lattice_geometry import volume_index
from lsmgeo.kernels.reference import sample_cells
from lsmgeo.kernels.request import Options

__all__ = [
    "Projected",
    "Sampled",
    "plane_sweep_project",
    "run_plane_sweep_project",
    "run_splat",
    "sample_volume",
    "splat",
]


class Projected(NamedTuple):
    """Swept volumes, and which sample lies in the volume."""

    maps: Tensor
    visible: Tensor


class Sampled(NamedTuple):
    """Values of a volume at points, and which points lie in it."""

    values: Tensor
    visible: Tensor


def plane_sweep_project(
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    size: tuple[int, int] | None = None,
    *,
    view_mask: Tensor | None = None,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    direction_frame: str = "world",
    flatten: bool = True,
    near: float = 1e-6,
    memory_format: torch.memory_format | None = None,
    backend: str = "auto",
) -> Projected:
    """Read a volume along the rays of cameras, at planes of constant depth.

    Equation: ``m(u, v, k) = G(A^-1 X)`` with ``X = R^T (depth[k] K^-1 (u, v, 1) - t)``, A the grid's world from index,
    G the volume interpolated (Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3).

    Convention:
        Integer pixel centres, K resized to `size`. A sample is visible where its index lies in [-0.5, n - 0.5) on each
        axis of the volume and its plane is beyond `near`.

    Args:
        volume: (B, C, D, H, W), float16, bfloat16, float32 or float64.
        cameras: B*V cameras, view fastest: a kornia ``PinholeCamera`` or ``PinholeCamerasList``, or `CameraTensors`.
        grid: the `VoxelGrid` on which the volume lives.
        depths: (P,), (B, P) or (B, V, P) camera z in world units, positive, strictly ascending, float32 or float64; or,
            for each pixel, (B, V, P, h, w), positive and finite, in any order.
        size: (h, w) of the maps; by default the cameras' image size, which all must then share, or that
            of depths of each pixel.
        view_mask: (B, V) bool; views where it is False give zeros and are unread.
        mode: "trilinear", or "nearest": the voxel that contains the sample.
        padding_mode: "zeros" or "border".
        augment: "depth" and "direction": append the plane's depth, then the unit ray direction.
        direction_frame: "world" or "camera".
        flatten: whether channels and planes share an axis, index ``c * P + k``.
        near: least depth of a visible plane, world units.
        memory_format: ``torch.contiguous_format`` for contiguous maps; by default their strides are what is fastest.
        backend: "auto", or the name of one.

    Returns:
        ``maps`` (B, V, C' P, h, w), or (B, V, C', P, h, w) where `flatten` is False, and ``visible`` (B, V, P, h, w).
        Differentiable in the volume, K, R, t, the depths and the grid's pose.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, depth_planes, functional
        >>> from lsmgeo.cameras import orbit
        >>> camera = orbit(torch.tensor([[0.0]]), 0.0, 2.0, focal_length=8.0, height=3, width=3)
        >>> grid = VoxelGrid(4)
        >>> volume = grid.centers()[..., 0][None, None]  # each voxel holds its x
        >>> maps, _ = functional.plane_sweep_project(volume, camera, grid, depth_planes(1.75, 2.25, 3))
        >>> maps[0, 0, :, 1, 1]  # the camera looks along -x from x = 2
        tensor([ 0.2500,  0.0000, -0.2500])
    """
    choices = mode, padding_mode, augment, direction_frame
    options = kernels.check_options(
        "PlaneSweepProject", "trilinear", backend, *choices, near=near, flatten=flatten, memory_format=memory_format
    )
    return run_plane_sweep_project(volume, cameras, grid, depths, size, view_mask, options)


def run_plane_sweep_project(
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    size: tuple[int, int] | None,
    view_mask: Tensor | None,
    options: Options,
) -> Projected:
    """`plane_sweep_project` with options that are checked already."""
    sites = sweep_sites("PlaneSweepProject", volume, cameras, grid, depths, size, view_mask, options)
    maps, visible = kernels.run("plane_sweep_project", volume, sites, options=options)
    return Projected(maps.flatten(2, 3) if options.flatten else maps, visible)


def splat(
    features: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    *,
    weights: Tensor | None = None,
    view_mask: Tensor | None = None,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    near: float = 1e-6,
    backend: str = "auto",
) -> Tensor:
    """Add features along the rays of cameras to a volume: the adjoint of `plane_sweep_project`.

    Equation: ``<plane_sweep_project(x), y> = <x, splat(y)>`` for every volume x and features y. Each feature is added
    to the voxels that `plane_sweep_project` would interpolate between at its pixel and depth, with the same weights.
    With depth probabilities as `weights` it is the lift and splat of Philion and Fidler, "Lift, Splat, Shoot", 2020.

    Convention:
        Integer pixel centres; K is resized to the feature map. Samples fade from the outermost voxel centres to one
        voxel out; those further out, on planes at or behind `near`, and of masked views add nothing.

    Args:
        features: (B, V, C, h, w) with `weights`, or (B, V, C, P, h, w) without.
        cameras: B*V cameras, view fastest: a kornia ``PinholeCamera`` or ``PinholeCamerasList``, or `CameraTensors`.
        grid: the `VoxelGrid` of the volume.
        depths: (P,), (B, P) or (B, V, P) camera z in world units, positive, strictly ascending, float32 or float64; or,
            for each pixel, (B, V, P, h, w), positive and finite, in any order.
        weights: (B, V, P, h, w), of the features' dtype: how much of each feature is added at each depth. Their product
            with the features is never held.
        view_mask: (B, V) bool; views where it is False add nothing and are unread.
        mode: "trilinear", or "nearest": all to the voxel that contains the sample.
        padding_mode: "zeros", or "border": samples outside the volume are added to its outermost voxels.
        near: least depth of a plane, world units.
        backend: "auto", or the name of one.

    Returns:
        (B, C, D, H, W), of the features' dtype: the sum over views, planes and pixels, taken in float32 or float64.
        Differentiable in features, weights, K, R, t, the depths and the grid's pose.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, functional
        >>> from lsmgeo.cameras import orbit
        >>> camera = orbit(torch.tensor([[0.0]]), 0.0, 2.0, focal_length=8.0, height=1, width=1)
        >>> features = torch.full((1, 1, 1, 1, 1), 8.0)
        >>> weights = torch.tensor([0.25, 0.75]).reshape(1, 1, 2, 1, 1)
        >>> depths = torch.tensor([1.75, 2.25])  # the camera looks along -x from x = 2
        >>> grid = VoxelGrid((1, 1, 2))
        >>> functional.splat(features, camera, grid, depths, weights=weights, mode="nearest").flatten()
        tensor([6., 2.])
    """
    options = kernels.check_options("Splat", "trilinear", backend, mode, padding_mode, near=near)
    return run_splat(features, cameras, grid, depths, weights, view_mask, options)


def run_splat(
    features: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    weights: Tensor | None,
    view_mask: Tensor | None,
    options: Options,
) -> Tensor:
    """`splat` with options that are checked already."""
    sites = splat_sites("Splat", features, weights, cameras, grid, depths, view_mask, options)
    volume = kernels.run("splat", features, sites, weights, grid.shape, options=options)
    return saturating_cast(volume, features.dtype)


def sample_volume(
    volume: Tensor,
    grid: Grid,
    points: Tensor,
    *,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    near: float = 1e-6,
) -> Sampled:
    """Read a volume at points of the world: samples along rays, surface points, a layered image from another view.

    Equation: ``f(X) = G(i)`` with G the volume interpolated and i the index of X: on a `VoxelGrid` ``i = A^-1 X``, A
    its world from index; on a `FrustumGrid` the pixel ``(x / z, y / z)`` and the plane of depth z, ``(x, y, z) =
    K (R X + t)``. Between planes k and k + 1 at depths a and b, the plane is ``k + (1/a - 1/z) / (1/a - 1/b)``, linear
    in 1/z as a homography's pixels are; before the first plane and behind the last, the end intervals are extrapolated.

    Convention:
        Voxel centres, pixel centres and planes at integers. A point is visible where its index lies in
        [-0.5, n - 0.5) on each axis, and on a frustum beyond `near`; at or behind `near` the values are exactly 0,
        whatever `padding_mode`. A frustum of one plane has the same values at all depths: its index along z is 0.

    Args:
        volume: (B, C, D, H, W), float16, bfloat16, float32 or float64.
        grid: the `VoxelGrid` or `FrustumGrid` on which the volume lives; depths of a frustum are (P,) or (B, P).
        points: (B, N, 3) as x, y, z in world units, float32 or float64.
        mode: "trilinear", or "nearest": the voxel that contains the point.
        padding_mode: "zeros" (fades from the outermost centres to one voxel out) or "border".
        near: least depth of a visible point of a frustum, world units; a `VoxelGrid` has no depth.

    Returns:
        ``values`` (B, C, N), of the volume's dtype, and ``visible`` (B, N) bool. Differentiable in the volume, the
        points, the grid's pose, its camera and depths.

    Raises:
        ShapeError, DTypeError, DeviceError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, functional
        >>> grid = VoxelGrid(4)
        >>> volume = grid.centers()[..., 0][None, None]  # each voxel holds its x
        >>> points = torch.tensor([[[0.25, 0.0, 0.0], [-0.3, 0.1, 0.2], [0.0, 0.0, 0.7]]])
        >>> functional.sample_volume(volume, grid, points)
        Sampled(values=tensor([[[ 0.2500, -0.3000,  0.0000]]]), visible=tensor([[ True,  True, False]]))
    """
    who = "sample_volume"
    options = Options.checked(who, "trilinear", mode, padding_mode, near=near)
    matrix, planes = volume_from_points(who, volume, grid, points)
    dtype = computing_dtype(volume)
    index, front = volume_index(matrix, planes, points, options, dtype)
    index, front = [axis[..., None, None] for axis in index], front[..., None, None]  # (B, 1, N, 1, 1)
    values, visible = sample_cells(volume.to(dtype)[:, None], index, front, options)
    return Sampled(saturating_cast(values[:, 0].flatten(2), volume.dtype), visible.flatten(1))
