"""Shared by the networks: convolutions by exact strides, instance norm, the base classes of models."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv3d, conv_transpose2d, conv_transpose3d, group_norm, pad

from lsmgeo._checks import check_flag
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.outputs import VoxelResult

__all__ = [
    "Block",
    "Convolution",
    "InstanceNorm",
    "Model",
    "VoxelModel",
    "evaluation_mode",
    "interleave",
    "shift_principal_point",
]


class Convolution(nn.Module):
    """A convolution, or a transposed one, whose output is the input's size divided, or multiplied, by the stride.

    The padding is ``kernel_size - stride`` in all, an odd pixel after the image. Where that is even, as for every even
    kernel of stride 2, a map covers the same area before and after; where it is odd (3 x 3 of stride 2), maps shift by
    half a pixel, as those of the released network do (TensorFlow's "SAME").

    Args:
        dims: 2 or 3.
        in_channels: of the input.
        out_channels: of the output.
        kernel_size: at least the stride.
        stride: must divide the input's sides, unless transposed.
        transposed: whether to multiply by the stride.
        groups: as in ``torch.nn.Conv2d``.
        bias: whether to add a learned bias.

    Example:
        >>> import torch
        >>> from lsmgeo.models.blocks import Convolution
        >>> down, up = Convolution(2, 3, 4, 5, stride=2), Convolution(2, 4, 3, 3, stride=2, transposed=True)
        >>> tuple(down(torch.rand(1, 3, 12, 16)).shape), tuple(up(down(torch.rand(1, 3, 12, 16))).shape)
        ((1, 4, 6, 8), (1, 3, 12, 16))
    """

    def __init__(
        self,
        dims: int,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        *,
        stride: int = 1,
        transposed: bool = False,
        groups: int = 1,
        bias: bool = True,
    ) -> None:
        super().__init__()
        self.dims, self.stride, self.transposed, self.groups = dims, stride, transposed, groups
        self.before, self.odd = divmod(kernel_size - stride, 2)
        channels = (in_channels, out_channels // groups) if transposed else (out_channels, in_channels // groups)
        self.weight = nn.Parameter(torch.empty(*channels, *(kernel_size,) * dims))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.xavier_uniform_(self.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Convolve (N, C, H, W) or (N, C, D, H, W)."""
        if self.transposed:
            transpose: Callable[..., Tensor] = conv_transpose2d if self.dims == 2 else conv_transpose3d
            y = transpose(x, self.weight, self.bias, self.stride, self.before, 0, self.groups)
            for axis in range(-self.dims, 0) if self.odd else ():
                y = y.narrow(axis, 0, y.shape[axis] - 1)
            return y
        if self.odd:
            x = pad(x, (self.before, self.before + 1) * self.dims)
        padding = 0 if self.odd else self.before
        convolve: Callable[..., Tensor] = conv2d if self.dims == 2 else conv3d
        return convolve(x, self.weight, self.bias, self.stride, padding, 1, self.groups)

    def extra_repr(self) -> str:
        """The arguments."""
        kernel = "x".join(map(str, self.weight.shape[2:]))
        first, second = self.weight.shape[:2]
        channels = (first, second * self.groups) if self.transposed else (second * self.groups, first)
        text = f"{channels[0]} -> {channels[1]}, {kernel}, stride={self.stride}"
        return text + ", transposed" * self.transposed + f", groups={self.groups}" * (self.groups > 1)


class InstanceNorm(nn.Module):
    """Normalisation of each channel of each sample over its pixels, with a learned shift and an optional scale.

    Args:
        channels: of the input.
        scale: whether to learn a scale too.

    Example:
        >>> import torch
        >>> from lsmgeo.models.blocks import InstanceNorm
        >>> InstanceNorm(1)(torch.tensor([0.0, 2.0, 4.0, 6.0]).reshape(1, 1, 2, 2)).flatten()
        tensor([-1.3416, -0.4472, 0.4472, 1.3416], grad_fn=<ViewBackward0>)
    """

    def __init__(self, channels: int, *, scale: bool = True) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels)) if scale else None
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (N, C, ...)."""
        # One group per channel. On a CPU, channels-last memory costs nine times as much as this copy.
        return group_norm(x.contiguous(), x.shape[1], self.weight, self.bias)


class Block(nn.Module):
    """Pre-activation: ReLU, `Convolution`, `InstanceNorm`.

    Args:
        dims: 2 or 3.
        in_channels: of the input.
        out_channels: of the output.
        kernel_size: of the convolution.
        norm: "scale" learns scale and shift, "shift" only the shift; with "none" the convolution has a bias.
        activate: whether it begins with the ReLU; the first block of a network does not.
        stride: see `Convolution`.
        transposed: see `Convolution`.

    Example:
        >>> import torch
        >>> from lsmgeo.models.blocks import Block
        >>> tuple(Block(3, 2, 5, 4, norm="scale", stride=2)(torch.rand(1, 2, 8, 8, 8)).shape)
        (1, 5, 4, 4, 4)
    """

    def __init__(
        self,
        dims: int,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        *,
        norm: str,
        activate: bool = True,
        stride: int = 1,
        transposed: bool = False,
    ) -> None:
        super().__init__()
        self.activate = activate
        self.convolution = Convolution(
            dims, in_channels, out_channels, kernel_size, stride=stride, transposed=transposed, bias=norm == "none"
        )
        self.norm = nn.Identity() if norm == "none" else InstanceNorm(out_channels, scale=norm == "scale")

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, C, ...) to (N, C', ...)."""
        return self.norm(self.convolution(x.relu() if self.activate else x))


def interleave(parts: Tensor, factor: int) -> Tensor:
    """Channels (N, factor^3, D, H, W), z slowest, as voxels of a finer grid (N, 1, factor D, factor H, factor W)."""
    x = parts.unflatten(1, (factor, factor, factor))  # (N, z, y, x, D, H, W)
    x = x.permute(0, 4, 1, 5, 2, 6, 3)
    return x.flatten(5, 6).flatten(3, 4).flatten(1, 2)[:, None]


class Model(nn.Module):
    """Base class of the models.

    Attributes:
        name: its name in `lsmgeo.models.create`.
        settings: what it is built from, a frozen dataclass that JSON can hold.
        output: "voxels" or "depth".
        image_size: side in pixels of the square images that it is made for.
        resolution: voxels along a side of its finest grid.
        grid: that grid.
        prefers_channels_last: whether it trains faster on CPUs with channels-last maps.
        about: the notes of the file that it was loaded from, if any.
    """

    name: str
    settings: Any
    output: str
    image_size: int
    resolution: int
    grid: VoxelGrid
    prefers_channels_last = False
    about: Mapping[str, Any] = MappingProxyType({})


class VoxelModel(Model):
    """Base class of the models that give occupancy."""

    output = "voxels"

    def run(
        self, images: Tensor, cameras: Cameras, view_mask: Tensor | None = None, *, by_view: bool = True
    ) -> VoxelResult:
        """Probabilities of occupancy, in evaluation mode and without gradients.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras.
            view_mask: (B, V) bool.
            by_view: whether to predict after every view too, at V times the work of the last networks.

        Returns:
            `VoxelResult`, float32.

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        check_flag(self.name, "by_view", by_view)
        with evaluation_mode(self):
            logits = self(images, cameras, view_mask, steps=None if by_view else "last").logits
            occupancy = logits.float().sigmoid()
        return VoxelResult(occupancy[:, -1], occupancy if by_view else None)


@contextmanager
def evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Evaluation mode without gradients; the mode from before is restored."""
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        model.train(was_training)


def shift_principal_point(who: str, cameras: Cameras, pixels: float) -> CameraTensors:
    """Cameras with principal points shifted by a number of pixels, to the right and down."""
    tensors = as_tensors(cameras, who)
    offset = torch.zeros_like(tensors.intrinsics)
    offset[..., :2, 2] = pixels
    return tensors._replace(intrinsics=tensors.intrinsics + offset)
