"""What every model has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from lsmgeo._checks import check_flag
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.outputs import VoxelResult

__all__ = ["Model", "VoxelModel", "evaluating"]


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
        about: the notes of the file that it was loaded from.
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
    """Base class of those that give occupancy."""

    output = "voxels"

    def run(
        self, images: Tensor, cameras: Cameras, view_mask: Tensor | None = None, *, by_view: bool = True
    ) -> VoxelResult:
        """Probabilities of occupancy, in evaluation mode and without gradients.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras.
            view_mask: (B, V) bool.
            by_view: whether to tell what is known after every view too, at V times the work of the last networks.

        Returns:
            `VoxelResult`, float32.

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        check_flag(self.name, "by_view", by_view)
        with evaluating(self):
            logits = self(images, cameras, view_mask, steps=None if by_view else "last").logits
            occupancy = logits.float().sigmoid()
        return VoxelResult(occupancy[:, -1], occupancy if by_view else None)


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Evaluation mode and no gradients inside; the mode before, after."""
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        model.train(was_training)
