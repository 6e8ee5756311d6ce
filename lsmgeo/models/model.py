"""What every model has."""

from __future__ import annotations

from typing import Any

from torch import nn

from lsmgeo.grids import VoxelGrid

__all__ = ["Model"]


class Model(nn.Module):
    """Base class of the models.

    Attributes:
        name: by which `lsmgeo.models.create` knows it.
        settings: what it was built from, a frozen dataclass that JSON can hold.
        output: "voxels" or "depth".
        image_size: side in pixels of the square images that it is meant for.
        resolution: voxels along a side of its finest grid.
        grid: that grid.
        prefers_channels_last: whether it trains faster on CPUs with maps kept pixel by pixel in memory.
    """

    name: str
    settings: Any
    output: str
    image_size: int
    resolution: int
    grid: VoxelGrid
    prefers_channels_last = False
