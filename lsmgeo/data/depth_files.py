"""Depth that comes beside a photograph, as camera z in world units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.files import read_bytes
from lsmgeo.data.images import DEPTH, MAX_PIXELS, decode_png, image_size
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["DepthFile", "DepthPng"]


class DepthFile(ABC):
    """Something that reads the depth of one photograph."""

    path: Path

    @abstractmethod
    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z in world units, 0 where there is none.

        Args:
            size: the (height, width) that it must have.

        Raises:
            DataError: the file is missing, damaged, or of another size.
        """


@dataclass(frozen=True)
class DepthPng(DepthFile):
    """A 16-bit PNG that counts steps of depth.

    Attributes:
        path: the file.
        step: world units of one step.
        empty: values that mean that there is no depth.
        any_size: whether a map of the photograph's shape but with more or fewer pixels is taken, its nearest pixels
            without any mixing: pixel i of N has the value of the map's pixel floor((i + 0.5) n / N).
    """

    path: Path
    step: float
    empty: tuple[int, ...] = (0,)
    any_size: bool = False

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z, 0 where there is none."""
        stored = self._alike(size) if self.any_size else size
        steps = decode_png(read_bytes(self.path, 4096 + 4 * MAX_PIXELS), stored, DEPTH, self.path)
        if stored != size:
            # Whole numbers: exactly the rule, whatever the sizes.
            rows, columns = ((2 * np.arange(n) + 1) * m // (2 * n) for n, m in zip(size, stored, strict=True))
            steps = steps[rows[:, None], columns]
        depth = np.where(np.isin(steps, self.empty), 0.0, steps * self.step).astype(np.float32)
        if not np.isfinite(depth).all():
            raise DataError(self.path, f"has depth beyond what float32 holds at a step of {self.step:g}")
        return depth

    def _alike(self, size: tuple[int, int]) -> tuple[int, int]:
        """The size that the file states, if its sides have the ratio of ``size`` up to one pixel of it."""
        height, width = image_size(self.path)
        if abs(height - width * size[0] / size[1]) > 1:
            raise DataError(
                self.path,
                f"is {width} x {height} pixels (width x height), not of the shape of its photograph, "
                f"{size[1]} x {size[0]}",
            )
        return height, width
