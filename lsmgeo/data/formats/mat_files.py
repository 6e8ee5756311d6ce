"""Parses MATLAB files for `format_lsm` in an isolated process; imports nothing of this package."""

from __future__ import annotations

import io

import numpy as np

__all__ = ["parse_mat"]

NAMES = ("K", "extrinsic", "Volume")
MAX_SIDE = 128
# Arrays with more elements must be zeros and ones.
MOST_NUMBERS = 64


def parse_mat(content: bytes) -> dict[str, np.ndarray]:
    """K, extrinsic and Volume of a MATLAB file (up to version 7.2), if it has them: float64, or bool if large."""
    import scipy.io

    try:
        arrays = scipy.io.loadmat(io.BytesIO(content), variable_names=NAMES)
    except (ImportError, MemoryError):
        raise
    # On damaged files the parser raises many kinds of errors.
    except Exception as error:
        raise ValueError(f"is not a valid MATLAB file ({error})") from error
    found = {}
    for name in NAMES:
        if (array := arrays.get(name)) is None:
            continue
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"{name} is not an array of numbers")
        if max(array.shape, default=0) > MAX_SIDE or array.ndim > 3:
            raise ValueError(f"{name} is too large")
        if array.size <= MOST_NUMBERS:
            found[name] = array.astype(np.float64)
        elif ((array == 0) | (array == 1)).all():
            found[name] = array.astype(bool)
        else:
            raise ValueError(f"{name} is not an array of zeros and ones")
    return found
