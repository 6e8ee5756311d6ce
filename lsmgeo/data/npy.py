"""Arrays in NumPy's ``.npy`` form from outside: the header is read and compared with the file before any data."""

from __future__ import annotations

import io
import math
import warnings
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.files import read_bytes
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read_npy"]

MOST_SIDES = 8


def read_npy(path: Path, limit: int) -> np.ndarray:
    """Read an array of float32 or float64 from a file of at most ``limit`` bytes.

    Returns:
        float64, of the shape that the file states.

    Raises:
        DataError: the file is missing, too large, no such array, of another type, or not as long as its header says.
    """
    content = read_bytes(path, limit)
    stream = io.BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            version = np.lib.format.read_magic(stream)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
            if version == (2, 0):
                read_header = np.lib.format.read_array_header_2_0
            if read_header is None:
                raise DataError(path, f"is of version {version} of .npy; expected 1.0 or 2.0")
            shape, by_columns, dtype = read_header(stream)
    except DataError:
        raise
    # numpy's parser of headers evaluates a literal, which raises SyntaxError, ValueError, MemoryError and others.
    except Exception as error:
        raise DataError(path, f"is not a .npy array ({str(error)[:120]})") from error
    if dtype.kind != "f" or dtype.itemsize not in (4, 8):
        raise DataError(path, f"must hold float32 or float64; got {str(dtype)[:80]}")
    held = len(content) - stream.tell()
    # Each side first: a product, and a message with it, would hold numbers of any length.
    if len(shape) > MOST_SIDES or not all(0 <= side <= len(content) for side in shape):
        raise DataError(path, f"states more sides, or longer ones, than its {len(content)} bytes can hold")
    number = math.prod(shape)
    if number * dtype.itemsize != held:
        raise DataError(path, f"states an array of {shape} and holds {held} bytes of it")
    values = np.frombuffer(content, dtype, number, stream.tell())
    return values.reshape(shape, order="F" if by_columns else "C").astype(np.float64)
