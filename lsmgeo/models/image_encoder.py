"""The image encoder: a UNet from an image to a map of features."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lsmgeo.models.blocks import Block
from lsmgeo.models.settings import MachineSettings

__all__ = ["Encoded", "ImageEncoder"]


class Encoded(NamedTuple):
    """Features (N, F, h, w), and the maps on the way down, finest first, at strides 2, 4, ..."""

    features: Tensor
    maps: tuple[Tensor, ...]


class ImageEncoder(nn.Module):
    """Images to features by convolutions down, transposed convolutions up, and skips between maps of one size.

    Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3, with the widths of their release.
    Of 224 pixels at stride 2: 32 @ 112, 64 @ 56, 128 @ 28, 256 @ 14; up 128 @ 28, 64 @ 56, 32 @ 112; features 32 @ 112.

    Args:
        settings: of the machine.

    Example:
        >>> import torch
        >>> from lsmgeo.models.settings import VoxelSettings
        >>> encoder = ImageEncoder(VoxelSettings(encoder_channels=(4, 8), feature_channels=6))
        >>> features, maps = encoder(torch.rand(1, 3, 16, 24))
        >>> tuple(features.shape), [tuple(item.shape) for item in maps]
        ((1, 6, 8, 12), [(1, 4, 8, 12), (1, 8, 4, 6)])
    """

    def __init__(self, settings: MachineSettings) -> None:
        super().__init__()
        is_release = settings.variant == "release"
        # Even kernels of stride 2 keep a map where its image is; the paper does not tell its kernels.
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
