"""Reads MATLAB files for `mat_files`, as a script in a process that they may crash; imports nothing of this package.

Standard input holds the files, each after its length in four bytes. Standard output gets one line of JSON a file:
``{"arrays": {name: {"shape": ..., "values": [...]} or {"shape": ..., "bits": ...}}}`` or ``{"error": ...}``.
"""

from __future__ import annotations

import base64
import io
import json
import struct
import sys
from typing import Any

NAMES = ("K", "extrinsic", "Volume")
# Up to so many numbers an array goes as numbers; beyond, it must be zeros and ones, and goes as bits.
MOST_NUMBERS = 64
MOST_BITS = 1 << 21


def _described(array: Any, numpy: Any) -> dict[str, Any]:
    if not isinstance(array, numpy.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("is no array of numbers")
    shape = list(array.shape)
    if array.size <= MOST_NUMBERS:
        return {"shape": shape, "values": [float(value) for value in array.ravel()]}
    if array.size > MOST_BITS or not ((array == 0) | (array == 1)).all():
        raise ValueError("is no array of zeros and ones, or too large")
    bits = numpy.packbits(array.astype(bool).ravel())
    return {"shape": shape, "bits": base64.b64encode(bits.tobytes()).decode()}


def _read(content: bytes) -> dict[str, Any]:
    import numpy
    import scipy.io

    arrays = scipy.io.loadmat(io.BytesIO(content), variable_names=NAMES)
    found = {}
    for name in NAMES:
        if name in arrays:
            try:
                found[name] = _described(arrays[name], numpy)
            except ValueError as error:
                raise ValueError(f"{name} {error}") from error
    return found


def main() -> None:
    """Answer for every file on standard input."""
    while header := sys.stdin.buffer.read(4):
        (length,) = struct.unpack("<I", header)
        content = sys.stdin.buffer.read(length)
        try:
            answer: dict[str, Any] = {"arrays": _read(content)}
        except ImportError:
            raise
        except MemoryError:
            answer = {"error": "needs too much memory to be read"}
        # Damaged files make the parser raise nearly everything.
        except Exception as error:
            answer = {"error": f"is no MATLAB file that can be used ({error})"}
        print(json.dumps(answer))


if __name__ == "__main__":
    main()
