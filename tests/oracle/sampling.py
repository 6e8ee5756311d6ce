"""Multilinear and nearest sampling of arrays with integer centres, in any number of axes."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def is_inside(index: Array, sizes: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Whether the cell that holds ``index`` (N, A), in x, y(, z) order, exists: [-0.5, n - 0.5) on each axis."""
    counts = np.array(sizes[::-1], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return np.all((index >= -0.5) & (index < counts - 0.5), axis=-1)


def sample(array: Array, index: Array, mode: str = "linear", padding_mode: str = "zeros") -> Array:
    """Values (C, N) of ``array`` (C, *sizes) at finite ``index`` (N, A), in x, y(, z) order.

    "zeros": what lies outside the array counts as 0. "border": the index is clamped to the outermost centres.
    """
    sizes = array.shape[1:]
    index = index[:, ::-1]  # array axis order
    last = np.array(sizes, dtype=np.float64) - 1.0
    if padding_mode == "border":
        index = np.clip(index, 0.0, last)
    values = np.zeros((array.shape[0], len(index)))
    if mode == "nearest":
        taps = [(np.floor(index + 0.5), np.ones(len(index)))]
    else:
        base = np.floor(index)
        fraction = index - base
        taps = []
        for corner in itertools.product((0, 1), repeat=len(sizes)):
            weight = np.prod(np.where(np.array(corner) == 1, fraction, 1.0 - fraction), axis=1)
            taps.append((base + np.array(corner), weight))
    for cell, weight in taps:
        exists = np.all((cell >= 0) & (cell <= last), axis=1) & (weight > 0)
        cells = tuple(cell[exists].astype(np.int64).T)
        values[:, exists] += weight[exists] * array[(slice(None), *cells)]
    return values
