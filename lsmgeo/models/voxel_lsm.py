"""V-LSM, a multi-view stereo network from images and cameras to occupancy: the whole network, and D-LSM's first half.

``images -> ImageEncoder -> Unproject -> fusion of the views -> GridUNet`` is `LSMTrunk`; `VoxelLSM` adds one layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lsmgeo._checks import check_devices, check_float, check_mask, describe
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.functional import Unprojected
from lsmgeo.fusion import ConvGRU3d, ConvLSTM3d, Max, Mean, Variance
from lsmgeo.grids import VoxelGrid
from lsmgeo.layers import Unproject
from lsmgeo.models.blocks import Block, Model, VoxelModel, interleave, shift_principal_point
from lsmgeo.models.outputs import VoxelOutput, views_used
from lsmgeo.models.settings import TrunkSettings, VoxelSettings, replace_settings

__all__ = ["Encoded", "GridUNet", "ImageEncoder", "LSMTrunk", "TrunkOutput", "VoxelLSM"]

PAPER = VoxelSettings()
RECURRENCES = {"gru": ConvGRU3d, "lstm": ConvLSTM3d}
STATISTICS = {"mean": Mean, "variance": Variance, "max": Max}


class Encoded(NamedTuple):
    """Features (N, F, h, w), and the maps on the way down, finest first, at strides 2, 4, ..."""

    features: Tensor
    maps: tuple[Tensor, ...]


class ImageEncoder(nn.Module):
    """A 2D UNet from images to features: strided convolutions, transposed convolutions, skips between maps of one size.

    Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3, with the widths of their release.
    At 224 pixels, stride 2: 32 @ 112, 64 @ 56, 128 @ 28, 256 @ 14; up 128 @ 28, 64 @ 56, 32 @ 112; features 32 @ 112.

    Args:
        settings: of the network.

    Example:
        >>> import torch
        >>> from lsmgeo.models.settings import VoxelSettings
        >>> encoder = ImageEncoder(VoxelSettings(encoder_channels=(4, 8), feature_channels=6))
        >>> features, maps = encoder(torch.rand(1, 3, 16, 24))
        >>> tuple(features.shape), [tuple(item.shape) for item in maps]
        ((1, 6, 8, 12), [(1, 4, 8, 12), (1, 8, 4, 6)])
    """

    def __init__(self, settings: TrunkSettings) -> None:
        super().__init__()
        is_release = settings.variant == "release"
        # Even kernels of stride 2 keep a map aligned with its image; the paper does not give its kernels.
        first, kernel, norm = (5, 3, "shift") if is_release else (6, 4, "scale")
        channels = settings.encoder_channels
        self.down = nn.ModuleList([Block(2, 3, channels[0], first, norm=norm, activate=False, stride=2)])
        self.down.extend(Block(2, before, after, kernel, norm=norm, stride=2) for before, after in pairwise(channels))
        self.up = nn.ModuleList()
        before = channels[-1]
        for level in range(len(channels) - 2, settings.feature_stride.bit_length() - 3, -1):
            self.up.append(Block(2, before, channels[level], kernel, norm=norm, stride=2, transposed=True))
            before = 2 * channels[level]
        self.out = Block(2, before, settings.feature_channels, 5, norm="none", transposed=is_release)

    def forward(self, images: Tensor) -> Encoded:
        """Encode images (N, 3, H, W), H and W divisible by 2 to the number of levels."""
        x = images
        maps: list[Tensor] = []
        for block in self.down:
            x = block(x)
            maps.append(x)
        for level, block in zip(range(len(maps) - 2, -1, -1), self.up, strict=False):
            x = torch.cat((block(x), maps[level]), 1)
        return Encoded(self.out(x), tuple(maps))


class GridUNet(nn.Module):
    """A 3D UNet from the fused grid to a grid of features: strided convolutions, transposed convolutions, skips.

    Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3, with the widths of their release.
    On 32^3: 32 @ 16, 64 @ 8, 128 @ 4; up 64 @ 8, 32 @ 16, 32 @ 32. The output, of `out_channels`, is not yet activated.

    Args:
        settings: of the network.

    Example:
        >>> import torch
        >>> from lsmgeo.models.settings import VoxelSettings
        >>> network = GridUNet(VoxelSettings(grid_size=8, hidden_channels=3, grid_channels=(4, 5), output_channels=6))
        >>> tuple(network(torch.rand(1, 3, 8, 8, 8)).shape)
        (1, 6, 8, 8, 8)
    """

    def __init__(self, settings: TrunkSettings) -> None:
        super().__init__()
        self.skip = settings.grid_skip
        self.out_channels = settings.output_channels + (settings.fused_channels if settings.grid_skip else 0)
        norm = "shift" if settings.variant == "release" else "scale"
        channels = (settings.fused_channels, *settings.grid_channels)
        self.down = nn.ModuleList(
            Block(3, before, after, 4, norm=norm, activate=level > 0, stride=2)
            for level, (before, after) in enumerate(pairwise(channels))
        )
        # Widths on the way up, the last at the grid's own size, where there is no skip.
        after = (*reversed(settings.grid_channels[:-1]), settings.output_channels)
        before = (channels[-1], *(2 * width for width in after[:-1]))
        pairs = list(zip(before, after, strict=True))
        self.up = nn.ModuleList(
            Block(3, first, second, 4, norm=norm, stride=2, transposed=True) for first, second in pairs
        )

    def forward(self, grid: Tensor) -> Tensor:
        """Map the fused grid (N, C, D, H, W) to features (N, C', D, H, W)."""
        x = grid
        maps: list[Tensor] = []
        for block in self.down:
            x = block(x)
            maps.append(x)
        maps.pop()
        for block in self.up:
            x = block(x)
            if maps:
                x = torch.cat((x, maps.pop()), 1)
        return torch.cat((x, grid), 1) if self.skip else x


class TrunkOutput(NamedTuple):
    """Grids (B, S, C, D, H, W) after S of the views, and the image encoder's early maps (B, V, C, h, w)."""

    grids: Tensor
    maps: tuple[Tensor, ...]


class LSMTrunk(Model):
    """What V-LSM and D-LSM share: image encoder, unprojection, fusion of the views and grid network.

    Args:
        settings: of the network.
        encoder: an image encoder in place of `ImageEncoder`, see `VoxelLSM`.

    Raises:
        OptionError: `encoder` is not a module.
    """

    def __init__(self, settings: TrunkSettings, encoder: nn.Module | None = None) -> None:
        super().__init__()
        is_release = settings.variant == "release"
        self.image_size = settings.image_size
        # The release places pixel j of a map at j times its stride, which shifts the image by this many pixels.
        self.lift_offset = (settings.feature_stride - 1) / 2 if settings.pixel_rules == "release" else 0.0
        self.resolution = settings.grid_size
        self.grid = VoxelGrid(settings.grid_size)
        if not isinstance(encoder, (nn.Module, type(None))):
            raise OptionError(f"{self.name}: encoder must be a module or None; got {describe(encoder)}")
        self.image_encoder = ImageEncoder(settings) if encoder is None else encoder
        self.image_stride = settings.image_stride if encoder is None else 1
        self.feature_channels = settings.feature_channels
        # "zeros" distinguishes what lies outside an image from what looks like its border; the release does not.
        padding_mode = "border" if is_release else "zeros"
        self.unproject = Unproject(
            self.grid, padding_mode=padding_mode, augment="depth" if is_release else ("depth", "direction")
        )
        self.lift = settings.lift
        self.unproject_finely: Unproject | None = None
        if settings.lift > 1:
            self.unproject_finely = Unproject(VoxelGrid(settings.grid_size * settings.lift), padding_mode=padding_mode)
        self.fusion: nn.Module
        if settings.fusion in RECURRENCES:
            self.fusion = RECURRENCES[settings.fusion](
                settings.volume_channels,
                settings.hidden_channels,
                kernel_size=settings.input_kernel,
                state_kernel_size=settings.state_kernel,
                eps=1e-12 if is_release else 1e-5,
            )
        else:
            self.fusion = STATISTICS[settings.fusion]()
        self.grid_network = GridUNet(settings)

    def encode(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None,
        steps: str | Sequence[int] | None,
    ) -> TrunkOutput:
        """Images to grids of features; the arguments are those of `forward`."""
        after = views_used(self.name, steps, self._check(images, view_mask))
        if view_mask is not None:
            images = torch.where(view_mask[:, :, None, None, None], images, 0.0)
        views = tuple(images.shape[:2])
        features, maps = self._features(images.flatten(0, 1))
        volume, visible = self._unproject(features.unflatten(0, views), cameras, view_mask)
        fused = self._fuse(volume, visible, view_mask, after)  # (B, S, C, D, H, W)
        grids = self.grid_network(fused.flatten(0, 1)).unflatten(0, fused.shape[:2])
        return TrunkOutput(grids, tuple(item.unflatten(0, views) for item in maps))

    def _features(self, images: Tensor) -> Encoded:
        """Features of images (N, 3, H, W); early maps come only from `ImageEncoder`."""
        encoded = self.image_encoder(images)
        if isinstance(encoded, Encoded):
            return encoded
        expected = f"features ({len(images)}, {self.feature_channels}, h, w), C as in feature_channels"
        check_float(self.name, "encoder", encoded, expected, 4)
        if tuple(encoded.shape[:2]) != (len(images), self.feature_channels):
            raise ShapeError(f"{self.name}: encoder must give {expected}; got {tuple(encoded.shape)}")
        return Encoded(encoded, ())

    def _fuse(self, volume: Tensor, visible: Tensor, view_mask: Tensor | None, after: list[int]) -> Tensor:
        """The fused grids (B, S, C', D, H, W) after some of the views."""
        states = getattr(self.fusion, "states", None)
        if states is not None:  # of a recurrence
            return states(volume, visible, view_mask)[:, after]
        mask = torch.ones_like(visible[:, :, 0, 0, 0]) if view_mask is None else view_mask
        return torch.stack([self.fusion(volume[:, :n], visible[:, :n], mask[:, :n]) for n in (i + 1 for i in after)], 1)

    def _unproject(self, features: Tensor, cameras: Cameras, view_mask: Tensor | None) -> Unprojected:
        """Volumes (B, V, C, D, H, W) and visibility of the views: samples by sub-voxel, depth and direction."""
        if self.lift_offset:
            cameras = shift_principal_point(self.name, cameras, self.lift_offset)
        if self.unproject_finely is None:
            return self.unproject(features, cameras, view_mask)
        samples = self.unproject_finely(features, cameras, view_mask).volume
        cells = samples.unflatten(5, (-1, self.lift)).unflatten(4, (-1, self.lift)).unflatten(3, (-1, self.lift))
        folded = cells.permute(0, 1, 2, 4, 6, 8, 3, 5, 7).flatten(2, 5)  # (B, V, C * lift^3, D, H, W)
        geometry, visible = self.unproject(features[:, :, :0], cameras, view_mask)
        return Unprojected(torch.cat((folded, geometry), 2), visible)

    def _check(self, images: Tensor, view_mask: Tensor | None) -> int:
        """Check images and mask; the number of views."""
        stride = self.image_stride
        sides = f"H and W multiples of {stride}, at least {2 * stride}" if stride > 1 else "H and W at least 2"
        expected = f"(B, V, 3, H, W), V at least 1, {sides}"
        check_float(self.name, "images", images, expected, 5)
        _, V, channels, height, width = images.shape
        if V < 1 or channels != 3 or height % stride or width % stride or min(height, width) < 2 * stride:
            raise ShapeError(f"{self.name}: images must be {expected}; got {tuple(images.shape)}")
        if view_mask is not None:
            check_mask(self.name, "view_mask", view_mask, tuple(images.shape[:2]), "(B, V)")
            check_devices(self.name, images=images, view_mask=view_mask)
        return V


class VoxelLSM(LSMTrunk, VoxelModel):
    """The Voxel Learnt Stereo Machine: any number of images with cameras to occupancy of the cube [-0.5, 0.5]^3.

    A 2D UNet, the same for each image, computes features; they are unprojected into the grid, with depth and ray
    direction as further channels; a recurrence of 3D convolutions fuses the views one after the other; a 3D UNet and a
    last layer turn its state into occupancy, after each view or after the last.

    Source: Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3. Where the paper is silent
    (widths, kernels) the authors' release is followed, except for strided kernels in 2D, which are even, so that a map
    covers what its image covers. The variant "release" has the release's layers one by one (2,730,113 parameters):
    odd strided kernels padded as in TensorFlow, instance norm without scale, no ray directions, features outside an
    image taken from its border. Its pixel and voxel rules, which are half a pixel or voxel off, are not copied: the
    geometry is this library's in both variants, unless ``pixel_rules="release"`` asks for them.

    Args:
        settings: `VoxelSettings`, whose fields are also keywords; `lsmgeo.models.create` has presets.
        encoder: your own image encoder: a module from images (N, 3, H, W) to features (N, C, h, w) that cover the
            image, with C = ``feature_channels``. Images may then be of any size. `write_weights` refuses such a model,
            since `load` could not build it: save its ``state_dict``.

    Shape:
        - images: (B, V, 3, H, W) in [0, 1]; cameras: B*V, view fastest; view_mask: (B, V).
        - logits: (B, S, D, H, W), after S of the views.

    Raises:
        OptionError: an unknown setting, or an impossible value.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.models import create
        >>> model = create("voxel-lsm", preset="tiny")
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=60.0, height=32, width=32)
        >>> tuple(model(torch.rand(1, 3, 3, 32, 32), cameras).logits.shape)
        (1, 3, 16, 16, 16)
        >>> tuple(model.run(torch.rand(1, 3, 3, 32, 32), cameras).occupancy.shape)
        (1, 16, 16, 16)
    """

    name = "voxel-lsm"

    def __init__(self, settings: VoxelSettings = PAPER, *, encoder: nn.Module | None = None, **changes: Any) -> None:
        settings = replace_settings(settings, changes)
        super().__init__(settings, encoder)
        self.settings = settings
        is_release = settings.variant == "release"
        # One channel: the softmax of two classes is the sigmoid of their difference.
        parts = settings.upsample**3
        self.out = Block(
            3, self.grid_network.out_channels, parts, 4 if is_release else 3, norm="none", transposed=is_release
        )
        self.resolution = settings.grid_size * settings.upsample
        self.grid = VoxelGrid(self.resolution)

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
            cameras: B*V cameras.
            view_mask: (B, V) bool; views where it is False are not read, and the prediction before them is repeated.
            steps: after which views: None for all, "last", or their indices.

        Returns:
            `VoxelOutput` with logits (B, S, D, H, W).

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        grids, _ = self.encode(images, cameras, view_mask, steps)
        logits = self.out(grids.flatten(0, 1))
        if self.settings.upsample > 1:
            logits = interleave(logits, self.settings.upsample)
        return VoxelOutput(logits.squeeze(1).unflatten(0, grids.shape[:2]))
