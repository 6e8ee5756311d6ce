"""Multilinear and nearest sampling of arrays with integer centres, in any number of axes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

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
    values = np.zeros((array.shape[0], len(index)))
    for cells, weight, exists in taps(index, array.shape[1:], mode, padding_mode):
        values[:, exists] += weight * array[(slice(None), *cells)]
    return values


def scatter(values: Array, index: Array, sizes: tuple[int, ...], mode: str, padding_mode: str) -> Array:
    """The transpose of `sample`: values (C, N) added to an array (C, *sizes)."""
    array = np.zeros((values.shape[0], *sizes))
    for cells, weight, exists in taps(index, sizes, mode, padding_mode):
        np.add.at(array, (slice(None), *cells), weight * values[:, exists])
    return array


def taps(
    index: Array, sizes: tuple[int, ...], mode: str, padding_mode: str
) -> Iterator[tuple[tuple[npt.NDArray[np.int64], ...], Array, npt.NDArray[np.bool_]]]:
    """The cells that samples read, one of each sample at a time: indices, weights, and which samples they are of."""
    index = index[:, ::-1]  # array axis order
    last = np.array(sizes, dtype=np.float64) - 1.0
    if padding_mode == "border":
        index = np.clip(index, 0.0, last)
    if mode == "nearest":
        found = [(np.floor(index + 0.5), np.ones(len(index)))]
    else:
        base = np.floor(index)
        fraction = index - base
        found = []
        for corner in itertools.product((0, 1), repeat=len(sizes)):
            weight = np.prod(np.where(np.array(corner) == 1, fraction, 1.0 - fraction), axis=1)
            found.append((base + np.array(corner), weight))
    for cell, weight in found:
        exists = np.all((cell >= 0) & (cell <= last), axis=1) & (weight > 0)
        yield tuple(cell[exists].astype(np.int64).T), weight[exists], exists
