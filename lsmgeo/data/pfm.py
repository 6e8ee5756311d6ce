"""Portable float maps: one channel of 32-bit floats with a header of three lines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lsmgeo.data.files import MAX_NUMBER_LENGTH, read_bytes
from lsmgeo.errors import DataError

__all__ = ["read_pfm"]

MAX_HEADER_BYTES = 256
HEADER = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,%d})[ \t]*\r?\n" % MAX_NUMBER_LENGTH)


def read_pfm(path: str | Path, size: tuple[int, int]) -> np.ndarray:
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
    path = Path(path)
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
