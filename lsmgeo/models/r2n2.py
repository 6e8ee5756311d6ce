"""3D-R2N2, the baseline without geometry: a residual network for images, a recurrence over views, a decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod, sqrt
from typing import Any, Literal

import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from lsmgeo._checks import check_devices, check_float, check_mask
from lsmgeo.cameras.camera_checks import check_views
from lsmgeo.cameras.tensors import Cameras, as_tensors
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.blocks import VoxelModel, interleave
from lsmgeo.models.outputs import VoxelOutput, views_used
from lsmgeo.models.settings import check_settings, replace_settings

__all__ = ["R2N2", "R2N2Settings"]


@dataclass(frozen=True)
class R2N2Settings:
    """The settings of an `R2N2`. The defaults are the original's.

    Attributes:
        pose: whether the network reads the cameras' rotations too.
        image_size: side of the square images in pixels.
        channels: of the image encoder's blocks; each ends in max pooling over 2 x 2 pixels.
        shortcuts: past the two convolutions of each block: "none", "convolution" (1x1), "identity".
        features: length of an image's vector.
        pose_features: length of a rotation's vector.
        coarse: voxels along a side of the recurrence's grid.
        hidden: its channels.
        decoder: channels of the blocks after it; all but the last double the grid.
        upsample: voxels of the occupancy along a side of one of the last block's: a cheap way to a finer output.
    """

    pose: bool = False
    image_size: int = 224
    channels: tuple[int, ...] = (96, 128, 256, 256, 256, 256)
    shortcuts: tuple[Literal["none", "convolution", "identity"], ...] = (
        *("none", "convolution", "convolution", "none", "convolution", "identity"),
    )
    features: int = 1024
    pose_features: int = 128
    coarse: int = 4
    hidden: int = 128
    decoder: tuple[int, ...] = (128, 128, 64, 32)
    upsample: int = 1

    @property
    def resolution(self) -> int:
        """Voxels along a side of the output."""
        return (self.coarse << (len(self.decoder) - 1)) * self.upsample

    def __post_init__(self) -> None:
        who = type(self).__name__
        check_settings(who, self, features=(1, 1 << 16), pose_features=(1, 1 << 16), coarse=(1, 64), upsample=(1, 4))
        if len(self.decoder) < 2:
            raise OptionError(f"{who}: decoder must be at least two integers; got {self.decoder}")
        if len(self.shortcuts) != len(self.channels):
            raise OptionError(f"{who}: shortcuts must be one for each of channels; got {self.shortcuts}")
        for before, after, shortcut in zip((3, *self.channels), self.channels, self.shortcuts, strict=False):
            if shortcut == "identity" and before != after:
                raise OptionError(
                    f"{who}: shortcuts must not be 'identity' where channels change; got {self.shortcuts}"
                )


PAPER = R2N2Settings()


class _ImageBlock(nn.Module):
    """Two convolutions, a shortcut past both, and max pooling over 2 x 2 pixels that starts one pixel outside."""

    def __init__(self, before: int, channels: int, kernel_size: int, shortcut: str) -> None:
        super().__init__()
        self.first = nn.Conv2d(before, channels, kernel_size, padding=kernel_size // 2)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.shortcut = nn.Conv2d(before, channels, 1) if shortcut == "convolution" else None
        self.is_residual = shortcut == "identity"
        self.pool = nn.MaxPool2d(2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = leaky_relu(self.second(leaky_relu(self.first(x))))
        if self.shortcut is not None:
            y = y + self.shortcut(x)
        return self.pool(y + x if self.is_residual else y)


class _GridBlock(nn.Module):
    """Unpooling (values at even voxels, 0 between), two convolutions and a shortcut.

    Unpooling and the first convolution are one transposed convolution, at an eighth of the work.
    """

    def __init__(self, before: int, channels: int) -> None:
        super().__init__()
        self.first = nn.ConvTranspose3d(before, channels, 3, stride=2, padding=1, output_padding=1)
        self.second = nn.Conv3d(channels, channels, 3, padding=1)
        self.shortcut = (
            None if before == channels else nn.ConvTranspose3d(before, channels, 1, stride=2, output_padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        y = leaky_relu(self.second(leaky_relu(self.first(x))))
        if self.shortcut is not None:
            return y + self.shortcut(x)
        wide = y.clone()
        wide[..., ::2, ::2, ::2] += x
        return wide


class _LastBlock(nn.Module):
    """A convolution, the sum of two convolutions of its output, and a convolution to two classes."""

    def __init__(self, before: int, channels: int, upsample: int) -> None:
        super().__init__()
        self.upsample = upsample
        self.first = nn.Conv3d(before, channels, 3, padding=1)
        self.second = nn.Conv3d(channels, channels, 3, padding=1)
        self.shortcut = nn.Conv3d(channels, channels, 3, padding=1)
        self.classes = nn.Conv3d(channels, 2 * upsample**3, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        y = leaky_relu(self.first(x))
        empty, solid = self.classes(leaky_relu(self.second(y)) + self.shortcut(y)).chunk(2, 1)
        # The softmax of two classes is the sigmoid of their difference.
        return interleave(solid - empty, self.upsample)[:, 0]


class _Recurrence(nn.Module):
    """A gated recurrent unit whose state is a grid; a fully connected layer maps its input, a vector, onto the grid.

    Equation: u = sigmoid(W_u x + U_u * h), r = sigmoid(W_r x + U_r * h), c = tanh(W_c x + U_c * (r h)),
    h' = u h + (1 - u) c.
    """

    def __init__(self, features: int, hidden: int, coarse: int) -> None:
        super().__init__()
        self.shape = (3 * hidden, coarse, coarse, coarse)
        self.read = nn.Linear(features, prod(self.shape), bias=False)
        self.gates = nn.Conv3d(hidden, 2 * hidden, 3, padding=1)
        self.candidate = nn.Conv3d(hidden, hidden, 3, padding=1)
        self.apply(_initialise)
        # The weights of the gates are one tensor, but initialised as three.
        for weights in (*self.read.weight.chunk(3), *self.gates.weight.chunk(2)):
            nn.init.xavier_normal_(weights, sqrt(2))

    def forward(self, x: Tensor, view_mask: Tensor) -> Tensor:
        """States after every view, (B, V, hidden, coarse, coarse, coarse), of features (B, V, features)."""
        read = self.read(x).unflatten(-1, self.shape)
        hidden = self.candidate.in_channels
        state, states = torch.zeros_like(read[:, 0, :hidden]), []
        for view in range(x.shape[1]):
            to_gates, to_candidate = read[:, view].split((2 * hidden, hidden), 1)
            update, reset = (to_gates + self.gates(state)).sigmoid().chunk(2, 1)
            candidate = (to_candidate + self.candidate(reset * state)).tanh()
            after = update * state + (1 - update) * candidate
            state = torch.where(view_mask[:, view, None, None, None, None], after, state)
            states.append(state)
        return torch.stack(states, 1)


class R2N2(VoxelModel):
    """The residual-GRU network of 3D-R2N2, with or without the cameras' rotation.

    Each image becomes a vector; a recurrence on a coarse grid reads the vectors in order; a decoder turns its state
    into occupancy. No geometry: without `pose` cameras are not read at all, and with it the rotation's quaternion goes
    through two fully connected layers and is appended to the image's vector.

    Source: Choy et al., "3D-R2N2: A Unified Approach for Single and Multi-view 3D Object Reconstruction", 2016, section
    3, layer by layer as released; with pose: Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017,
    section 4. The original takes images of 127 pixels; Kar et al. trained it on theirs, of 224.

    Convention:
        The quaternion is that of the world-to-camera rotation. Of its two signs the one with z >= 0 is taken: the real
        part of an upright, level camera is 0, so its sign would depend on rounding.

    Args:
        settings: `R2N2Settings`, whose fields are also keywords; `lsmgeo.models.create` has presets.

    Shape:
        - images: (B, V, 3, H, W) in [0, 1], with H = W = `image_size`; cameras: B*V, view fastest; view_mask: (B, V).
        - logits: (B, S, D, H, W), after S of the views.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.models import R2N2
        >>> model = R2N2(
        ...     image_size=16, channels=(4, 4), shortcuts=("none", "identity"), features=8, hidden=4, decoder=(4, 2)
        ... )
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=30.0, height=16, width=16)
        >>> model(torch.rand(1, 3, 3, 16, 16), cameras).logits.shape
        torch.Size([1, 3, 8, 8, 8])
    """

    prefers_channels_last = True

    def __init__(self, settings: R2N2Settings = PAPER, **changes: Any) -> None:
        super().__init__()
        settings = replace_settings(settings, changes)
        self.settings = settings
        self.name = "r2n2-pose" if settings.pose else "r2n2"
        self.image_size = settings.image_size
        self.resolution = settings.resolution
        self.grid = VoxelGrid(self.resolution)
        before, side, blocks = 3, settings.image_size, []
        for number, (channels, shortcut) in enumerate(zip(settings.channels, settings.shortcuts, strict=True)):
            blocks.append(_ImageBlock(before, channels, 3 if number else 7, shortcut))
            before, side = channels, side // 2 + 1
        self.encoder = nn.Sequential(*blocks).apply(_initialise)
        self.vector = nn.Linear(before * side**2, settings.features).apply(_initialise)
        self.rotation, read = None, settings.features
        if settings.pose:
            layers = nn.Linear(4, settings.pose_features), nn.Linear(settings.pose_features, settings.pose_features)
            self.rotation = nn.Sequential(layers[0], nn.LeakyReLU(), layers[1], nn.LeakyReLU()).apply(_initialise)
            read += settings.pose_features
        self.recurrence = _Recurrence(read, settings.hidden, settings.coarse)
        widths = (settings.hidden, *settings.decoder)
        grids = [_GridBlock(*pair) for pair in pairwise(widths[:-1])]
        last = _LastBlock(widths[-2], widths[-1], settings.upsample)
        self.decoder = nn.Sequential(*grids, last).apply(_initialise)

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        steps: str | Sequence[int] | None = None,
    ) -> VoxelOutput:
        """Occupancy after every view, or after some.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras, read only with `pose`.
            view_mask: (B, V) bool; views where it is False are not read, and the prediction before them is repeated.
            steps: after which views: None for all, "last", or their indices.

        Returns:
            `VoxelOutput` with logits (B, S, D, H, W).

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        mask = self._check(images, view_mask)
        views = tuple(mask.shape)
        after = views_used(self.name, steps, views[1])
        images = torch.where(mask[..., None, None, None], images, 0.0)
        vectors = leaky_relu(self.vector(self.encoder(images.flatten(0, 1)).flatten(1))).unflatten(0, views)
        if self.rotation is not None:
            rotations = self.rotation(self._quaternions(cameras, mask, images))
            vectors = torch.cat((vectors, rotations.to(vectors.dtype)), -1)
        states = self.recurrence(vectors, mask)[:, after]
        return VoxelOutput(self.decoder(states.flatten(0, 1)).unflatten(0, states.shape[:2]))

    def extra_repr(self) -> str:
        """The settings."""
        return repr(self.settings)

    def _check(self, images: Tensor, view_mask: Tensor | None) -> Tensor:
        """Check images and mask; returns the mask, by default all True."""
        expected = f"(B, V, 3, {self.image_size}, {self.image_size}), the model's image size"
        check_float(self.name, "images", images, expected, 5)
        if tuple(images.shape[2:]) != (3, self.image_size, self.image_size) or images.shape[1] < 1:
            raise ShapeError(f"{self.name}: images must be {expected}; got {tuple(images.shape)}")
        views = tuple(images.shape[:2])
        if view_mask is None:
            return torch.ones(views, dtype=torch.bool, device=images.device)
        check_mask(self.name, "view_mask", view_mask, views, "(B, V)")
        check_devices(self.name, images=images, view_mask=view_mask)
        return view_mask

    def _quaternions(self, cameras: Cameras, mask: Tensor, images: Tensor) -> Tensor:
        """(B, V, 4) as w, x, y, z; of masked views, whose cameras are not read, the identity."""
        views = (mask.shape[0], mask.shape[1])
        tensors = check_views(self.name, as_tensors(cameras, self.name), views, mask, images=images)
        R = tensors.cam_from_world[..., :3, :3]
        R = torch.where(mask[..., None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
        quaternions = rotation_matrix_to_quaternion(R)
        return torch.where(quaternions[..., 3:] < 0, -quaternions, quaternions).to(images.dtype)


def _initialise(module: nn.Module) -> None:
    """As in the original: normal weights of variance 4 / (inputs + outputs), biases of 0.1."""
    if not isinstance(module, (nn.Linear, nn.Conv2d, nn.Conv3d, nn.ConvTranspose3d)):
        return
    nn.init.xavier_normal_(module.weight, sqrt(2))
    if module.bias is not None:
        nn.init.constant_(module.bias, 0.1)
