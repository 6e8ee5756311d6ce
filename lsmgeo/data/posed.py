"""The one sample type of all readers: photographs with cameras, and the sparse points that came with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from lsmgeo.data.files import read_image

if TYPE_CHECKING:
    from pathlib import Path

    from lsmgeo.cameras import CameraTensors

__all__ = ["Observations", "PosedImages", "SparsePoints"]


class Observations(NamedTuple):
    """Where one photograph sees sparse points.

    Convention:
        Pixels are integer-centred: (0, 0) is the centre of the top-left pixel.
    """

    points: np.ndarray  # (M,) int64, rows of SparsePoints.positions
    pixels: np.ndarray  # (M, 2) float64, x then y


class SparsePoints(NamedTuple):
    """Sparse points of a reconstruction, and who observes them."""

    positions: np.ndarray  # (N, 3) float64, world
    colours: np.ndarray  # (N, 3) uint8, RGB
    observations: tuple[Observations, ...]  # one per photograph


@dataclass(frozen=True, eq=False)
class PosedImages:
    """V photographs with known cameras.

    Convention:
        Cameras are world-to-camera, OpenCV axes, integer pixel centres, float64, whatever the source's convention.

    Attributes:
        names: the names that the source gives to the photographs.
        paths: their files, all inside the scene's folder.
        cameras: :class:`lsmgeo.cameras.CameraTensors` with leading shape (V,).
        points: sparse points where the source has them.
        source: "middlebury" or "colmap".
    """

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    cameras: CameraTensors
    points: SparsePoints | None
    source: str

    def __len__(self) -> int:
        return len(self.names)

    def camera(self, view: int) -> CameraTensors:
        """The camera of one view, leading shape ()."""
        return type(self.cameras)(*(torch.as_tensor(value)[view] for value in self.cameras))

    def size(self, view: int) -> tuple[int, int]:
        """(height, width) of one photograph in pixels."""
        height, width = (int(torch.as_tensor(size)[view]) for size in self.cameras[2:])
        return height, width

    def load(self, view: int) -> torch.Tensor:
        """Read one photograph.

        Returns:
            (3, H, W) float32 in [0, 1], RGB.

        Raises:
            DataError: the file is missing, damaged, or not of its camera's size.
        """
        pixels = read_image(self.paths[view], self.size(view))
        # In place: a photograph of many megapixels is not held twice as floats.
        return torch.from_numpy(pixels).permute(2, 0, 1).to(torch.float32).div_(255)
