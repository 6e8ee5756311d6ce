"""Reductions of a swept volume along its rays, from planes to maps.

A swept volume is (..., P, h, w) or (..., C, P, h, w), as returned by ``plane_sweep_project(..., flatten=False)``.
`composite` needs the planes in ascending depth, and `project_reduce` planes that all pixels share; `expected_depth` and
`max_along_rays` take depths of each pixel in any order.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lsmgeo import kernels
from lsmgeo._checks import (
    LARGEST_COUNT,
    check_broadcast,
    check_devices,
    check_flag,
    check_float,
    check_whole,
    describe,
    moved,
)
from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo._sites import Cameras, sweep_sites
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import DTypeError, GridError, OptionError, ShapeError
from lsmgeo.functional import Projected
from lsmgeo.functional.image_sampling import Names
from lsmgeo.grids import VoxelGrid, check_constant_depths, check_map_size
from lsmgeo.kernels.request import Options
from lsmgeo.kernels.view_statistics import first_maximum
from lsmgeo.layers import SamplingLayer

__all__ = ["Composited", "ProjectReduce", "composite", "expected_depth", "max_along_rays", "project_reduce"]


def _check_planes(who: str, name: str, planes: Tensor) -> None:
    check_float(who, name, planes, "(..., P, h, w)")
    if planes.dim() < 3 or planes.shape[-3] < 1:
        raise ShapeError(f"{who}: {name} must be (..., P, h, w) with P at least 1; got {tuple(planes.shape)}")


def _check_visible(who: str, visible: Tensor | None, planes: Tensor) -> None:
    if visible is None:
        return
    if not isinstance(visible, Tensor) or visible.dtype != torch.bool:
        raise DTypeError(
            f"{who}: visible must be a bool tensor that broadcasts to {tuple(planes.shape)}; got {describe(visible)}"
        )
    if check_broadcast(who, visible=visible.shape, planes=planes.shape) != tuple(planes.shape):
        raise ShapeError(f"{who}: visible must broadcast to {tuple(planes.shape)}; got {tuple(visible.shape)}")
    check_devices(who, planes=planes, visible=visible)


def _along_rays(who: str, depths: Tensor, planes: Tensor, ordered: bool = False) -> Tensor:
    """Depths (..., P) or (..., P, h, w) as (..., P, 1 or h, 1 or w) against planes (..., P, h, w), to compute with."""
    check_float(who, "depths", depths, "(P,), (..., P) or (..., P, h, w)")
    shape = tuple(planes.shape[-3:])
    per_pixel = depths.dim() == planes.dim() and tuple(depths.shape[-3:]) == shape
    if not per_pixel and (depths.dim() < 1 or depths.shape[-1] != shape[0]):
        raise ShapeError(
            f"{who}: depths must be (..., P) with P = {shape[0]}, or of each pixel (..., P, h, w) with as many axes as "
            f"the planes, {planes.dim()}, and (P, h, w) = {shape}; got {tuple(depths.shape)}"
        )
    check_devices(who, planes=planes, depths=depths)
    depths = depths if per_pixel else depths[..., None, None]
    check_broadcast(who, depths=depths.shape[:-3], planes=planes.shape[:-3])
    if can_inspect(depths):
        if not bool(depths.isfinite().all()):
            raise GridError(f"{who}: depths must be finite; got a NaN or an infinity")
        if ordered and not bool((depths.diff(dim=-3) > 0).all()):
            raise GridError(f"{who}: depths must ascend along each ray, from front to back; got others")
    return depths.to(computing_dtype(planes))


def expected_depth(scores: Tensor, depths: Tensor, visible: Tensor | None = None) -> Tensor:
    """Mean depth under the softmax of scores along each ray (soft-argmax).

    Equation: ``sum_k softmax(scores)_k depth_k`` (Kendall et al., "End-to-End Learning of Geometry and Context for Deep
    Stereo Regression", 2017, section 3.4).

    Args:
        scores: (..., P, h, w); larger is more likely.
        depths: (P,) or (..., P), world units, or of each pixel (..., P, h, w) with as many axes as the scores; in any
            order.
        visible: bool, broadcasts to the scores; samples where it is False have no weight.

    Returns:
        (..., h, w) depths; 0 on rays with no visible sample. Differentiable in scores and depths.

    Raises:
        ShapeError, DTypeError, DeviceError, GridError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import rays
        >>> scores = torch.tensor([0.0, 0.0, 0.0]).reshape(3, 1, 1)
        >>> rays.expected_depth(scores, torch.tensor([1.0, 2.0, 4.5]))
        tensor([[2.5000]])
    """
    who = "expected_depth"
    _check_planes(who, "scores", scores)
    _check_visible(who, visible, scores)
    planes = _along_rays(who, depths, scores)
    computing = scores.to(planes.dtype)
    if visible is None:
        return saturating_cast((computing.softmax(-3) * planes).sum(-3), scores.dtype)
    seen = visible.expand(scores.shape)
    any_seen = seen.any(-3, keepdim=True)
    # Rays with no visible sample get equal weights, which are then dropped: a softmax over no samples is NaN.
    hidden = torch.where(any_seen, -torch.inf, 0.0).to(planes.dtype)
    weights = torch.where(seen, computing, hidden).softmax(-3)
    return saturating_cast(torch.where(any_seen.squeeze(-3), (weights * planes).sum(-3), 0.0), scores.dtype)


def max_along_rays(maps: Tensor, visible: Tensor | None = None) -> Tensor:
    """Largest value along each ray, as in maximum intensity projection.

    Args:
        maps: (..., P, h, w), channels before the planes if there are any.
        visible: bool, broadcasts to the maps (put an axis of 1 in the place of channels).

    Returns:
        (..., h, w); 0 on rays with no visible sample. The gradient goes to the first plane that attains it.

    Raises:
        ShapeError, DTypeError, DeviceError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import rays
        >>> rays.max_along_rays(torch.tensor([1.0, 3.0, 2.0]).reshape(3, 1, 1))
        tensor([[3.]])
    """
    who = "max_along_rays"
    _check_planes(who, "maps", maps)
    _check_visible(who, visible, maps)
    if visible is None:
        first = maps.detach().max(-3, keepdim=True).indices
        return maps.gather(-3, first).squeeze(-3)
    seen = visible.expand(maps.shape)
    first = first_maximum(maps, seen, -3)
    return torch.where(seen.any(-3), maps.gather(-3, first).squeeze(-3), 0.0)


class Composited(NamedTuple):
    """Composited values and depth, the transmittance behind the last plane, and the weight of each sample."""

    values: Tensor
    depth: Tensor
    transmittance: Tensor
    weights: Tensor


def composite(alpha: Tensor, values: Tensor, depths: Tensor, visible: Tensor | None = None) -> Composited:
    """Front-to-back compositing of planes along each ray.

    Equation: ``w_k = alpha_k prod_{j<k} (1 - alpha_j)``, ``values = sum_k w_k values_k`` (Porter and Duff, "Compositing
    Digital Images", 1984).

    Args:
        alpha: (..., P, h, w) opacities in [0, 1].
        values: (..., C, P, h, w).
        depths: (P,) or (..., P), world units, or of each pixel (..., P, h, w) with as many axes as alpha; ascending.
        visible: bool, broadcasts to alpha; samples where it is False are transparent.

    Returns:
        `Composited`: values (..., C, h, w), depth (..., h, w) as ``sum_k w_k depth_k`` (divide by ``1 - transmittance``
        for the mean), transmittance (..., h, w) and weights (..., P, h, w). Differentiable in all arguments.

    Raises:
        ShapeError, DTypeError, DeviceError, GridError: see `lsmgeo.errors`; the last where depths do not ascend.

    Example:
        >>> import torch
        >>> from lsmgeo import rays
        >>> alpha = torch.tensor([0.5, 1.0]).reshape(2, 1, 1)
        >>> seen = rays.composite(alpha, torch.tensor([8.0, 2.0]).reshape(1, 2, 1, 1), torch.tensor([1.0, 3.0]))
        >>> seen.values, seen.depth, seen.transmittance
        (tensor([[[5.]]]), tensor([[2.]]), tensor([[0.]]))
    """
    who = "composite"
    _check_planes(who, "alpha", alpha)
    _check_planes(who, "values", values)
    if values.shape[:-4] + values.shape[-3:] != alpha.shape:
        raise ShapeError(
            f"{who}: values must be (..., C, P, h, w) with alpha's {tuple(alpha.shape)}; got {tuple(values.shape)}"
        )
    if values.dtype != alpha.dtype:
        raise DTypeError(f"{who}: values must be of alpha's {alpha.dtype}; got {values.dtype}")
    check_devices(who, alpha=alpha, values=values)
    _check_visible(who, visible, alpha)
    planes = _along_rays(who, depths, alpha, ordered=True)
    output = alpha.dtype
    alpha, values = alpha.to(planes.dtype), values.to(planes.dtype)
    if visible is not None:
        seen = visible.expand(alpha.shape)
        alpha, values = torch.where(seen, alpha, 0.0), torch.where(seen[..., None, :, :, :], values, 0.0)
    through = (1.0 - alpha).cumprod(-3)
    before = torch.cat((torch.ones_like(through[..., :1, :, :]), through[..., :-1, :, :]), -3)
    weights = alpha * before
    seen_values, depth = (weights[..., None, :, :, :] * values).sum(-3), (weights * planes).sum(-3)
    return Composited(*(saturating_cast(x, output) for x in (seen_values, depth, through[..., -1, :, :], weights)))


def project_reduce(
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    size: tuple[int, int] | None = None,
    *,
    view_mask: Tensor | None = None,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    augment: Names = (),
    direction_frame: str = "world",
    near: float = 1e-6,
    backend: str = "auto",
) -> Projected:
    """Sweep a volume and map the C' P stacked channels linearly to O, without ever holding them.

    The linear map is computed in float32 (float64 for a float64 volume) under autocast too; on a GPU it follows
    ``torch.set_float32_matmul_precision``.

    Equation: ``conv2d(plane_sweep_project(volume, ...).maps, weight, bias)`` with a 1x1 kernel, summed over the planes
    (the learned ray pooling of Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017).

    Args:
        volume: (B, C, D, H, W).
        cameras: B*V cameras, view fastest.
        grid: the volume's `VoxelGrid`.
        depths: (P,), (B, P) or (B, V, P), ascending; not those of each pixel, as a weight belongs to a plane.
        weight: (O, C' P), or (O, C' P, 1, 1) as ``torch.nn.Conv2d`` has it; input channel ``c * P + k``.
        bias: (O,) or None.
        size: (h, w) of the maps.
        view_mask: as in `lsmgeo.functional.plane_sweep_project`, like all further options; maps of masked views hold
            the bias.
        mode: see there.
        padding_mode: see there.
        augment: see there.
        direction_frame: see there.
        near: see there.
        backend: see there.

    Returns:
        ``maps`` (B, V, O, h, w) and ``visible`` (B, V, P, h, w). Differentiable in every real argument.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, depth_planes, rays
        >>> from lsmgeo.cameras import orbit
        >>> camera = orbit(torch.tensor([[0.0]]), 0.0, 2.0, focal_length=8.0, height=3, width=3)
        >>> planes = depth_planes(1.75, 2.25, 3)
        >>> maps, _ = rays.project_reduce(torch.ones(1, 1, 4, 4, 4), camera, VoxelGrid(4), planes, torch.ones(2, 3))
        >>> maps[0, 0, :, 1, 1]
        tensor([3., 3.])
    """
    who = "project_reduce"
    options = kernels.check_options(who, "trilinear", backend, mode, padding_mode, augment, direction_frame, near=near)
    return _project_reduce(volume, cameras, grid, depths, weight, bias, size, view_mask, options)


def _project_reduce(
    volume: Tensor,
    cameras: Cameras,
    grid: VoxelGrid,
    depths: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    size: tuple[int, int] | None,
    view_mask: Tensor | None,
    options: Options,
) -> Projected:
    """`project_reduce` with options that are checked already."""
    who = "project_reduce"
    sites = sweep_sites(who, volume, cameras, grid, depths, size, view_mask, options, per_pixel=False)
    check_float(who, "weight", weight, "(O, C' P)")
    if weight.dim() == 4 and tuple(weight.shape[2:]) == (1, 1):
        weight = weight.flatten(1)
    planes = depths.shape[-1]
    channels = volume.shape[1] + options.appended()
    if weight.dim() != 2 or weight.shape[1] != channels * planes:
        raise ShapeError(
            f"{who}: weight must be (O, C' P) or (O, C' P, 1, 1) with C' P = {channels} * {planes}; "
            f"got {tuple(weight.shape)}"
        )
    if bias is not None:
        check_float(who, "bias", bias, "(O,)")
        if tuple(bias.shape) != (weight.shape[0],):
            raise ShapeError(f"{who}: bias must be (O,) = ({weight.shape[0]},); got {tuple(bias.shape)}")
    check_devices(who, volume=volume, weight=weight, bias=bias)
    stacked = weight.unflatten(1, (channels, planes))
    return Projected(*kernels.run("project_reduce", volume, sites, stacked, bias, options=options))


class ProjectReduce(SamplingLayer):
    """`project_reduce` with learned weights: a plane sweep and a 1x1 convolution over its C' P channels in one.

    Args:
        in_channels: C of the volumes.
        out_channels: O.
        grid: the `VoxelGrid` on which the volumes live.
        depths: (P,), (B, P) or (B, V, P), ascending; not those of each pixel, as a weight belongs to a plane.
        size: (h, w) of the maps; by default the cameras' image size.
        bias: whether to add a learned bias.
        mode: as in `lsmgeo.PlaneSweepProject`, like all further options.
        padding_mode: see there.
        augment: see there.
        direction_frame: see there.
        near: see there.
        backend: see there.

    Shape:
        - volume: (B, C, D, H, W); cameras: B*V, view fastest; view_mask: (B, V) bool.
        - maps: (B, V, O, h, w); visible: (B, V, P, h, w) bool.

    ``weight`` (O, C' P, 1, 1) and ``bias`` (O,) are named, shaped and initialised as those of ``torch.nn.Conv2d``.

    Example:
        >>> import torch
        >>> from lsmgeo import VoxelGrid, depth_planes
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.rays import ProjectReduce
        >>> reduce = ProjectReduce(5, 7, VoxelGrid(8), depth_planes(1.0, 3.0, 6), size=(12, 16))
        >>> cameras = orbit(torch.tensor([[0.0, 120.0]]), 20.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> maps, visible = reduce(torch.rand(1, 5, 8, 8, 8), cameras)
        >>> tuple(maps.shape)
        (1, 2, 7, 12, 16)
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        grid: VoxelGrid,
        depths: Tensor,
        size: tuple[int, int] | None = None,
        *,
        bias: bool = True,
        mode: str = "trilinear",
        padding_mode: str = "zeros",
        augment: Names = (),
        direction_frame: str = "world",
        near: float = 1e-6,
        backend: str = "auto",
    ) -> None:
        who = "ProjectReduce"
        super().__init__(
            who,
            "trilinear",
            mode=mode,
            padding_mode=padding_mode,
            augment=augment,
            direction_frame=direction_frame,
            near=near,
            backend=backend,
        )
        for name, value in (("in_channels", in_channels), ("out_channels", out_channels)):
            check_whole(who, name, value, 1)
        if not isinstance(grid, VoxelGrid):
            raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
        check_constant_depths(who, depths)
        check_map_size(who, depths, size)
        check_flag(who, "bias", bias)
        self.grid = grid
        self.depths = depths
        self.size = size
        channels = in_channels + self.options.appended()
        if channels * depths.shape[-1] * out_channels > LARGEST_COUNT:
            raise OptionError(
                f"{who}: in_channels times planes times out_channels must be 2^31 - 1 at most; "
                f"got {in_channels}, {depths.shape[-1]} and {out_channels}"
            )
        convolution = nn.Conv2d(channels * depths.shape[-1], out_channels, 1, bias=bias)
        self.weight = convolution.weight
        self.bias = convolution.bias

    def forward(
        self,
        volume: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        size: tuple[int, int] | None = None,
    ) -> Projected:
        """Sweep and reduce a volume (B, C, D, H, W); `size` takes precedence over the layer's."""
        device = volume.device if isinstance(volume, Tensor) else self.depths.device
        depths = moved("ProjectReduce", "depths", self.depths, device)
        size = self.size if size is None else size
        return _project_reduce(
            volume, cameras, self.grid, depths, self.weight, self.bias, size, view_mask, self.options
        )

    def extra_repr(self) -> str:
        """The arguments."""
        return (
            f"{self.weight.shape[1] // self.depths.shape[-1]} channels x {self.depths.shape[-1]} planes -> "
            f"{self.weight.shape[0]}, {self.grid}, size={self.size}, {self._options_repr()}"
        )
