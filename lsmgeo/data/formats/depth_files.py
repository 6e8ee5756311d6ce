"""Depth that comes beside an image, as camera z in world units, and portable float maps."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.images import DEPTH, MAX_PIXELS, decode_png, image_size
from lsmgeo.data.read_files import MAX_NUMBER_LENGTH, read_bytes
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["DepthFile", "DepthPng", "read_pfm"]

MAX_HEADER_BYTES = 256
HEADER = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,%d})[ \t]*\r?\n" % MAX_NUMBER_LENGTH)


class DepthFile(ABC):
    """Something that reads the depth of one image."""

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
        any_size: whether a map of the image's shape but with more or fewer pixels is taken, its nearest pixels
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
                f"is {width} x {height} pixels (width x height), not of the shape of its image, {size[1]} x {size[0]}",
            )
        return height, width


def read_pfm(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Read a one-channel portable float map of known size.

    The header is ``Pf``, width and height, and a scale whose *sign* tells the order of bytes: negative means little
    endian. Its magnitude is not applied: Middlebury writes 1/255 or 1 there, and its disparities are pixels as they
    stand. Rows are stored from the bottom up. (Paul Debevec's format; http://www.pauldebevec.com/Research/HDR/PFM.)

    Args:
        path: the file.
        size: the (height, width) that it must have.

    Returns:
        (H, W) float32, the top row first; values that are not finite stay.

    Raises:
        DataError: the file is missing, no such map, of another size, or longer or shorter than its size needs.
    """
    height, width = size
    content = read_bytes(path, MAX_HEADER_BYTES + 4 * height * width)
    header = HEADER.match(content[:MAX_HEADER_BYTES])
    if header is None:
        raise DataError(path, "is not a portable float map (Pf, width and height, scale)")
    if header[1] == b"PF":
        raise DataError(path, "is a portable float map of three channels; expected one")
    if (int(header[3]), int(header[2])) != (height, width):
        reason = f"is {int(header[2])} x {int(header[3])} pixels (width x height); expected {width} x {height}"
        raise DataError(path, reason)
    try:
        scale = float(header[4])
    except ValueError:
        scale = np.nan
    if not (np.isfinite(scale) and scale != 0):
        raise DataError(path, "has a scale that is no number, or zero")
    if len(content) != header.end() + 4 * height * width:
        raise DataError(path, f"holds more or less data than {width} x {height} pixels need")
    values = np.frombuffer(content, "<f4" if scale < 0 else ">f4", offset=header.end())
    return values.reshape(height, width)[::-1].astype(np.float32)
