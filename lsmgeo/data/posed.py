"""The one sample type of all readers: photographs with cameras, and the sparse points that came with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from lsmgeo._checks import describe
from lsmgeo.data.files import read_image
from lsmgeo.data.sample import Sample
from lsmgeo.errors import OptionError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Sequence
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

    def sample(self, views: Sequence[int] | None = None) -> Sample:
        """Read photographs as the sample that models are fed, named after their folder.

        Args:
            views: which, and in which order; None for all. They must be of one size: resize or crop others first
                (`lsmgeo.cameras.resize`, `lsmgeo.cameras.crop` do the cameras' part).

        Returns:
            Images and cameras (float64); no depth, mask, occupancy, mesh or category.

        Raises:
            OptionError: no view, or one that does not exist.
            ShapeError: two photographs of different sizes.
            DataError: a file is missing, damaged, or not of its camera's size.
        """
        chosen = list(range(len(self)) if views is None else views)
        whole = all(isinstance(view, int | np.integer) and not isinstance(view, bool) for view in chosen)
        if not chosen or not whole or not all(0 <= view < len(self) for view in chosen):
            raise OptionError(f"sample: views must be numbers from 0 to {len(self) - 1}; got {describe(views)}")
        # All sizes before the first photograph: they are large.
        sizes = {self.size(view): self.names[view] for view in chosen}
        if len(sizes) > 1:
            (first, name), (second, other) = list(sizes.items())[:2]
            raise ShapeError(
                "sample: photographs must be of one size; "
                f"{name!r} is {first[0]} x {first[1]} (height x width), {other!r} {second[0]} x {second[1]}"
            )
        images = torch.stack([self.load(view) for view in chosen])
        cameras = type(self.cameras)(*(torch.as_tensor(value)[chosen] for value in self.cameras))
        folder = self.paths[chosen[0]].parent
        name = folder.parent.name if folder.name == "images" else folder.name
        return Sample(images, cameras, None, None, None, None, None, name or self.source)
