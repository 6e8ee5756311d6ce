"""Depth that comes beside a photograph, as camera z in world units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.files import MAX_PIXELS, read_bytes
from lsmgeo.data.png import DEPTH, decode_png
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["DepthFile", "DepthPng"]


class DepthFile:
    """Something that reads the depth of one photograph."""

    path: Path

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z in world units, 0 where there is none.

        Args:
            size: the (height, width) that it must have.

        Raises:
            DataError: the file is missing, damaged, or of another size.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class DepthPng(DepthFile):
    """A 16-bit PNG that counts steps of depth.

    Attributes:
        path: the file.
        step: world units of one step.
        empty: values that mean that there is no depth.
    """

    path: Path
    step: float
    empty: tuple[int, ...] = (0,)

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z, 0 where there is none."""
        steps = decode_png(read_bytes(self.path, 4096 + 4 * MAX_PIXELS), size, DEPTH, self.path, extras=True)
        depth = np.where(np.isin(steps, self.empty), 0.0, steps * self.step).astype(np.float32)
        if not np.isfinite(depth).all():
            raise DataError(self.path, f"has depth beyond what float32 holds at a step of {self.step:g}")
        return depth
