"""Depth files of images, read as camera z in world units, and portable float maps."""

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
    """The depth of one image, read when needed."""

    path: Path

    @abstractmethod
    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z in world units, 0 for no depth.

        Args:
            size: the expected (height, width).

        Raises:
            DataError: the file is missing, damaged, or of another size.
        """


@dataclass(frozen=True)
class DepthPng(DepthFile):
    """A 16-bit PNG of depth in steps.

    Attributes:
        path: the file.
        step: world units of one step.
        empty: values that mean no depth.
        any_size: whether the map may have another resolution of the same aspect ratio. It is then resized without
            interpolation: pixel i of N has the value of pixel floor((i + 0.5) n / N) of the map.
    """

    path: Path
    step: float
    empty: tuple[int, ...] = (0,)
    any_size: bool = False

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z, 0 for no depth."""
        stored = self._stored_size(size) if self.any_size else size
        steps = decode_png(read_bytes(self.path, 4096 + 4 * MAX_PIXELS), stored, DEPTH, self.path)
        if stored != size:
            # In integers, so that the rule holds exactly.
            rows, columns = ((2 * np.arange(n) + 1) * m // (2 * n) for n, m in zip(size, stored, strict=True))
            steps = steps[rows[:, None], columns]
        depth = np.where(np.isin(steps, self.empty), 0.0, steps * self.step).astype(np.float32)
        if not np.isfinite(depth).all():
            raise DataError(self.path, f"has depth beyond float32 with a step of {self.step:g}")
        return depth

    def _stored_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """The size in the file, if its aspect ratio is that of ``size`` to within a pixel."""
        height, width = image_size(self.path)
        if abs(height - width * size[0] / size[1]) > 1:
            reason = f"is {width} x {height} pixels (width x height), its image {size[1]} x {size[0]}: another shape"
            raise DataError(self.path, reason)
        return height, width


def read_pfm(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Read a one-channel portable float map of known size.

    The header is ``Pf``, width and height, and a scale whose *sign* is the byte order: negative means little endian.
    Its magnitude is ignored: Middlebury writes 1/255 or 1, and its disparities are stored in pixels. Rows are stored
    from the bottom up. (Paul Debevec's format; http://www.pauldebevec.com/Research/HDR/PFM.)

    Args:
        path: the file.
        size: the expected (height, width).

    Returns:
        (H, W) float32, the top row first; values that are not finite are kept.

    Raises:
        DataError: the file is missing, not such a map, of another size, or its length does not match its size.
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
        raise DataError(path, "has a scale that is zero or not a number")
    if len(content) != header.end() + 4 * height * width:
        raise DataError(path, f"holds more or less data than {width} x {height} pixels need")
    values = np.frombuffer(content, "<f4" if scale < 0 else ">f4", offset=header.end())
    return values.reshape(height, width)[::-1].astype(np.float32)
