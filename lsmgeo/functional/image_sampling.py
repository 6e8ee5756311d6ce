"""Operators that sample images, as functions. All checks of their arguments live here and in `_sites`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo import kernels
from lsmgeo._checks import check_choices, check_devices, check_float, check_geometry, check_mask, check_whole
from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo._sites import Cameras, Grid, check_features, check_points, direction_matrix, image_matrices, image_sites
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import GridError, OptionError, ShapeError
from lsmgeo.kernels.request import STATISTICS, Options
from lsmgeo.kernels.view_statistics import view_statistics as _view_statistics

__all__ = [
    "Names",
    "Unprojected",
    "run_unproject",
    "sample_views",
    "unproject",
    "unproject_points",
    "unproject_slabs",
    "view_statistics",
]

Names = str | Sequence[str]


class Unprojected(NamedTuple):
    """Features at sites, and which view sees which site."""

    volume: Tensor
    visible: Tensor


def unproject(
    features: Tensor,
    cameras: Cameras,
    grid: Grid,
    *,
    view_mask: Tensor | None = None,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    direction_frame: str = "world",
    reduce: Names | None = None,
    near: float = 1e-6,
    reference: Tensor | None = None,
    groups: int = 1,
    memory_format: torch.memory_format | None = None,
    backend: str = "auto",
) -> Unprojected:
    """Lift image features to the sites of a grid: each site takes the feature where its ray meets the image.

    Equation: ``f(X) = F(x / z, y / z)`` with ``(x, y, z) = K (R X + t)``, K resized to the feature map, F interpolated
    (Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3).

    Convention:
        Integer pixel centres. A site is visible where its depth is more than `near` and its pixel lies in
        [-0.5, w - 0.5) x [-0.5, h - 0.5) of the feature map. Features are exactly 0 at sites not in front.

    Args:
        features: (B, V, C, h, w), float16, bfloat16, float32 or float64.
        cameras: B*V cameras, view fastest: a kornia ``PinholeCamera`` or ``PinholeCamerasList``, or `CameraTensors`.
        grid: `VoxelGrid`, or the `FrustumGrid` of a reference camera; its (D, H, W) sites.
        view_mask: (B, V) bool; views where it is False give zeros, and neither features nor camera are read.
        mode: "bilinear", or "nearest": the pixel that contains the sample.
        padding_mode: "zeros" (fades from the outermost centres to one pixel out; with `reduce`, prefer "border") or
            "border".
        augment: "depth" and "direction": append the camera depth, then the unit ray direction (x, y, z), also at
            invisible sites of views that are not masked.
        direction_frame: "world" or "camera".
        reduce: None, or "mean", "variance", "max" or several: statistics over the views that see a site, 0 where none
            does, without holding the volumes of all views.
        near: least depth of a visible site, world units.
        reference: (B, C, D or 1, H, W), of the features' dtype: answer with its correlation with the samples instead of
            these. At sites that are not in front it is not read, and the answer is 0.
        groups: number of groups of channels. With a reference the answer has one channel for each, the mean over its
            C / groups channels of reference times sample (group-wise correlation, Guo et al., 2019); 1 is the dot
            product over C.
        memory_format: ``torch.contiguous_format`` for a contiguous answer; by default its strides are what is fastest.
        backend: "auto", or the name of one (see `lsmgeo.kernels.explain`).

    Returns:
        ``volume`` (B, V, C', D, H, W), or (B, C'', D, H, W) with `reduce`; C' is C (with a reference: `groups`) plus 1
        for depth plus 3 for direction, C'' is C' for each statistic in the order requested; and ``visible``
        (B, V, D, H, W) bool. Differentiable in features, reference, K, R, t, the grid's pose, its camera and depths.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, functional
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.tensor([[0.0, 90.0]]), 0.0, 2.0, focal_length=8.0, height=4, width=4)
        >>> features = torch.arange(4.0).expand(1, 2, 1, 4, 4)  # each pixel holds its column
        >>> volume, visible = functional.unproject(features, cameras, VoxelGrid(2))
        >>> volume[0, 0, 0, 0, 0]
        tensor([2.3889, 2.6429])
    """
    who = "Unproject"
    choices = mode, padding_mode, augment, direction_frame, reduce, near
    options = kernels.check_options(who, "bilinear", backend, *choices, groups=groups, memory_format=memory_format)
    return run_unproject(features, cameras, grid, view_mask, reference, options)


def run_unproject(
    features: Tensor, cameras: Cameras, grid: Grid, view_mask: Tensor | None, reference: Tensor | None, options: Options
) -> Unprojected:
    """`unproject` with options that are checked already."""
    sites = image_sites("Unproject", features, cameras, grid, view_mask, options, reference)
    return Unprojected(*kernels.run("unproject", features, sites, reference, options=options))


def unproject_slabs(
    features: Tensor,
    cameras: Cameras,
    grid: Grid,
    planes: int,
    *,
    view_mask: Tensor | None = None,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    direction_frame: str = "world",
    reduce: Names | None = None,
    near: float = 1e-6,
    reference: Tensor | None = None,
    groups: int = 1,
    memory_format: torch.memory_format | None = None,
    backend: str = "auto",
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """`unproject` for grids too large for memory: slab by slab along the grid's first axis.

    Args:
        features: (B, V, C, h, w).
        cameras: B*V cameras.
        grid: the whole grid, (D, H, W).
        planes: planes of a slab; the last may have fewer.
        view_mask: as in `unproject`, like all further options.
        mode: see `unproject`.
        padding_mode: see `unproject`.
        augment: see `unproject`.
        direction_frame: see `unproject`.
        reduce: see `unproject`.
        near: see `unproject`.
        reference: see `unproject`; (B, C, D or 1, H, W) for the whole grid.
        groups: see `unproject`.
        memory_format: see `unproject`.
        backend: see `unproject`.

    Yields:
        ``(start, volume, visible)``: what `unproject` returns at planes start to start + planes, bit for bit.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: at the call, before the first slab.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, functional
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.tensor([[0.0, 90.0]]), 0.0, 2.0, focal_length=8.0, height=4, width=4)
        >>> features = torch.ones(1, 2, 1, 4, 4)
        >>> [tuple(volume.shape) for _, volume, _ in functional.unproject_slabs(features, cameras, VoxelGrid(5), 2)]
        [(1, 2, 1, 2, 5, 5), (1, 2, 1, 2, 5, 5), (1, 2, 1, 1, 5, 5)]
    """
    who = "unproject_slabs"
    check_whole(who, "planes", planes, 1)
    choices = mode, padding_mode, augment, direction_frame, reduce, near
    options = kernels.check_options(who, "bilinear", backend, *choices, groups=groups, memory_format=memory_format)
    sites = image_sites(who, features, cameras, grid, view_mask, options, reference)

    def slabs() -> Iterator[tuple[int, Tensor, Tensor]]:
        for start in range(0, sites.counts()[0], planes):
            part = sites.slab(start, start + planes)
            other = (
                reference if reference is None or reference.shape[2] == 1 else reference[:, :, start : start + planes]
            )
            yield start, *kernels.run("unproject", features, part, other, options=options)

    return slabs()


def unproject_points(
    features: Tensor,
    cameras: Cameras,
    points: Tensor,
    *,
    view_mask: Tensor | None = None,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    direction_frame: str = "world",
    reduce: Names | None = None,
    near: float = 1e-6,
    backend: str = "auto",
) -> Unprojected:
    """`unproject` at arbitrary points of the world: sparse voxels, surface samples, a point cloud.

    Args:
        features: (B, V, C, h, w).
        cameras: B*V cameras.
        points: (B, N, 3) as x, y, z in world units, float32 or float64.
        view_mask: as in `unproject`, like all further options.
        mode: see `unproject`.
        padding_mode: see `unproject`.
        augment: see `unproject`.
        direction_frame: see `unproject`.
        reduce: see `unproject`.
        near: see `unproject`.
        backend: see `unproject`.

    Returns:
        ``volume`` (B, V, C', N), or (B, C'', N) with `reduce`, and ``visible`` (B, V, N) bool. Differentiable in
        features, points, K, R and t.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import functional
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.tensor([[0.0]]), 0.0, 2.0, focal_length=8.0, height=5, width=5)
        >>> features = torch.arange(5.0).expand(1, 1, 1, 5, 5)
        >>> functional.unproject_points(features, cameras, torch.zeros(1, 1, 3)).volume
        tensor([[[[2.]]]])
    """
    who = "unproject_points"
    options = kernels.check_options(
        who, "bilinear", backend, mode, padding_mode, augment, direction_frame, reduce, near
    )
    matrices = image_matrices(who, features, cameras, view_mask)
    check_points(who, "features", features, points)
    direction = None
    if options.direction:
        world = torch.eye(4, dtype=torch.float64, device=features.device)
        direction = direction_matrix(matrices, world, options.direction)
    arguments = (matrices.projection(), direction, points, view_mask)
    return Unprojected(*kernels.run("unproject_points", features, *arguments, options=options))


def sample_views(
    features: Tensor,
    pixels: Tensor,
    depth: Tensor,
    valid: Tensor,
    *,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    reduce: Names | None = None,
    near: float = 1e-6,
    backend: str = "auto",
) -> Unprojected:
    """`unproject` at given pixels, for cameras that are not a matrix: fisheye, distorted, panoramic.

    Args:
        features: (B, V, C, h, w).
        pixels: (B, V, N, 2) as u, v in the feature map's own pixels, integer centres, float32 or float64.
        depth: (B, V, N) of the sites, of the pixels' dtype; what `near` is compared with.
        valid: (B, V, N) bool; where it is False nothing is read and all channels are 0.
        mode: "bilinear" or "nearest".
        padding_mode: "zeros" or "border".
        augment: "depth" to append the depth. (Ray directions need a camera matrix.)
        reduce: as in `unproject`.
        near: least depth of a visible site, world units.
        backend: as in `unproject`.

    Returns:
        ``volume`` (B, V, C', N), or (B, C'', N) with `reduce`, and ``visible`` (B, V, N) bool. Differentiable in
        features, pixels and depth.

    Raises:
        ShapeError, DTypeError, DeviceError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import functional
        >>> features = torch.arange(5.0).expand(1, 1, 1, 5, 5)
        >>> pixels = torch.tensor([[[[1.25, 2.0], [3.5, 0.0]]]])
        >>> functional.sample_views(features, pixels, torch.ones(1, 1, 2), torch.ones(1, 1, 2, dtype=torch.bool)).volume
        tensor([[[[1.2500, 3.5000]]]])
    """
    who = "sample_views"
    options = kernels.check_options(who, "bilinear", backend, mode, padding_mode, augment, reduce=reduce, near=near)
    if options.direction:
        raise OptionError(f"{who}: augment must be 'depth' or nothing, a direction needs a camera; got {augment!r}")
    views = check_features(who, features)
    check_geometry(who, "pixels", pixels, "(B, V, N, 2)", rank=4)
    if tuple(pixels.shape[:2]) != views or pixels.shape[3] != 2:
        raise ShapeError(f"{who}: pixels must be (B, V, N, 2) with (B, V) = {views}; got {tuple(pixels.shape)}")
    check_geometry(who, "depth", depth, "(B, V, N)", rank=3, dtypes=(pixels.dtype,))
    if depth.shape != pixels.shape[:3]:
        raise ShapeError(f"{who}: depth must be (B, V, N) = {tuple(pixels.shape[:3])}; got {tuple(depth.shape)}")
    check_mask(who, "valid", valid, tuple(pixels.shape[:3]), "(B, V, N)")
    check_devices(who, features=features, pixels=pixels, depth=depth, valid=valid)
    if can_inspect(pixels):
        finite = pixels.isfinite().all(-1) & depth.isfinite()
        if not bool((finite | ~valid).all()):
            raise GridError(f"{who}: pixels and depth must be finite where valid")
    return Unprojected(*kernels.run("sample_views", features, pixels, depth, valid, options=options))


def view_statistics(volume: Tensor, visible: Tensor, statistics: Names, view_mask: Tensor | None = None) -> Tensor:
    """Mean, population variance or maximum over the views that see a site; what `unproject` does with `reduce`.

    Args:
        volume: (B, V, C, ...) with any axes of sites.
        visible: (B, V, ...) bool.
        statistics: "mean", "variance" (mean of squares about the mean), "max" (its gradient goes to the first view that
            attains it), or several.
        view_mask: (B, V) bool; views where it is False do not count.

    Returns:
        (B, C'', ...): blocks of C channels in the order requested; 0 where no view sees the site.

    Raises:
        ShapeError, DTypeError, DeviceError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import functional
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> visible = torch.tensor([True, True, False]).reshape(1, 3, 1)
        >>> functional.view_statistics(volume, visible, ("mean", "variance", "max")).flatten()
        tensor([2., 1., 3.])
    """
    who = "view_statistics"
    names = check_choices(who, "statistics", statistics, STATISTICS)
    if not names:
        raise OptionError(f"{who}: statistics must name at least one; got {statistics!r}")
    check_float(who, "volume", volume, "(B, V, C, ...)")
    if volume.dim() < 3 or volume.shape[1] < 1:
        raise ShapeError(f"{who}: volume must be (B, V, C, ...) with V at least 1; got {tuple(volume.shape)}")
    check_mask(who, "visible", visible, (*volume.shape[:2], *volume.shape[3:]), "(B, V, ...)")
    if view_mask is not None:
        check_mask(who, "view_mask", view_mask, tuple(volume.shape[:2]), "(B, V)")
    check_devices(who, volume=volume, visible=visible, view_mask=view_mask)
    if view_mask is not None:
        visible = visible & view_mask.reshape(*view_mask.shape, *(1,) * (visible.dim() - 2))
    return saturating_cast(_view_statistics(volume.to(computing_dtype(volume)), visible, names), volume.dtype)
