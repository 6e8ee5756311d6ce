"""Operators that sample volumes, as functions. All checks of their arguments live here and in `_sites`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo import kernels
from lsmgeo._sites import Cameras, sweep_sites
from lsmgeo.functional.image_sampling import Names
from lsmgeo.grids import VoxelGrid
from lsmgeo.kernels.request import Options

__all__ = ["Projected", "plane_sweep_project", "run_plane_sweep_project"]


class Projected(NamedTuple):
    """Swept volumes, and which sample lies in the volume."""

    maps: Tensor
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
