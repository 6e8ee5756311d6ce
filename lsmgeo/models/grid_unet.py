"""The grid network: a 3D UNet that reasons about shape on the fused grid."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from lsmgeo.models.blocks import Block
from lsmgeo.models.settings import MachineSettings

__all__ = ["GridUNet"]


class GridUNet(nn.Module):
    """The fused grid to a grid of features, by convolutions down, transposed convolutions up, and skips.

    Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3, with the widths of their release.
    On 32^3: 32 @ 16, 64 @ 8, 128 @ 4; up 64 @ 8, 32 @ 16, 32 @ 32. The output, of `out_channels`, is not yet activated.

    Args:
        settings: of the machine.

    Example:
        >>> import torch
        >>> from lsmgeo.models.settings import VoxelSettings
        >>> network = GridUNet(VoxelSettings(grid_size=8, hidden_channels=3, grid_channels=(4, 5), output_channels=6))
        >>> tuple(network(torch.rand(1, 3, 8, 8, 8)).shape)
        (1, 6, 8, 8, 8)
    """

    def __init__(self, settings: MachineSettings) -> None:
        super().__init__()
        self.skip = settings.grid_skip
        self.out_channels = settings.output_channels + (settings.hidden_channels if settings.grid_skip else 0)
        norm = "shift" if settings.variant == "release" else "scale"
        channels = (settings.hidden_channels, *settings.grid_channels)
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
        """Map the state of the fusion (N, C, D, H, W) to features."""
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
