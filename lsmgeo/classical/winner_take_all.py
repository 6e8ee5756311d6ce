"""The lowest and second-lowest local minimum of a cost along every ray, from slabs of planes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lsmgeo.classical.correlation import on_threads

__all__ = ["WinnerTakeAll"]

# Minima that are closer are one: the second is noise around the first.
SAME_PLANES = 2.5

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


class WinnerTakeAll:
    """Running winners of a sweep: memory does not grow with the number of planes.

    A local minimum is placed between planes by the parabola through it and its neighbours in inverse depth, in which
    samples move evenly, so that planes may have any spacing.

    Args:
        depths: (P,) of the planes, ascending.
        size: (h, w).
        invalid_cost: the cost of a site that no neighbour sees; only lower costs can win.
        apart: planes within which minima are one.
    """

    def __init__(self, depths: Tensor, size: tuple[int, int], invalid_cost: float, apart: float = SAME_PLANES):
        self.inverse = (1 / depths.detach().cpu().double()).numpy()
        self.apart = max(apart, SAME_PLANES)
        self.count = 0
        self.before: tuple[Floats, Mask] = (np.empty((0, *size), np.float32), np.empty((0, *size), np.bool_))
        self.best: Floats = np.full(size, invalid_cost, np.float32)
        self.second: Floats = np.full(size, invalid_cost, np.float32)
        self.place: Floats = np.full(size, -1, np.float32)

    def push(self, costs: Tensor, seen: Tensor) -> None:
        """Add the costs (d, h, w) of the next planes, and where enough neighbours see them."""
        planes = np.concatenate((self.before[0], costs.numpy(force=True)))
        sees = np.concatenate((self.before[1], seen.numpy(force=True)))
        first = self.count - len(self.before[0])
        height = len(self.best)
        bands = min(torch.get_num_threads(), height)

        def band(number: int) -> None:
            rows = slice(number * height // bands, (number + 1) * height // bands)
            for middle in range(1, len(planes) - 1):
                self._visit(
                    first + middle, planes[middle - 1 : middle + 2, rows], sees[middle - 1 : middle + 2, rows], rows
                )

        on_threads(band, range(bands))
        self.count += len(costs)
        self.before = (planes[-2:].copy(), sees[-2:].copy())

    def _visit(self, index: int, costs: Floats, seen: Mask, rows: slice) -> None:
        """Add the minima of one plane, between its neighbours (3, h, w), in some rows."""
        best, second, place = (values[rows].reshape(-1) for values in (self.best, self.second, self.place))
        previous, middle, following = costs.reshape(3, -1)
        is_minimum = middle < second
        is_minimum &= middle <= previous
        is_minimum &= middle < following
        is_minimum &= seen[1].reshape(-1)
        # Few pixels have such a minimum here; the rest is done only for these.
        at = np.flatnonzero(is_minimum)
        cost, lowest, winner = middle[at], best[at], place[at]
        # Beside a site that no neighbour sees there is no parabola.
        has_sides = (seen[0] & seen[2]).reshape(-1)[at]
        found = index + np.where(has_sides, self._offset(index, previous[at], cost, following[at]), 0)
        elsewhere = (found - winner > self.apart) | (winner < 0)
        better = cost < lowest
        # A better minimum beside the old one replaces it; elsewhere it demotes the old one.
        second[at] = np.where(elsewhere, np.where(better, lowest, cost), second[at])
        best[at] = np.where(better, cost, lowest)
        place[at] = np.where(better, found, winner)

    def _offset(self, index: int, before: Floats, cost: Floats, after: Floats) -> Floats:
        """The vertex of the parabola through three planes, in planes from the middle one, in [-0.5, 0.5]."""
        first, middle, last = self.inverse[index - 1 : index + 2]
        step, next_step = first - middle, middle - last
        # Halfway between two planes its derivative is their slope; it is 0 at the vertex.
        slope, next_slope = (cost - before) / step, (after - cost) / next_step
        vertex = -0.5 * (slope * next_step + next_slope * step) / np.maximum(next_slope - slope, 1e-30)
        return np.where(vertex > 0, vertex / next_step, vertex / step).astype(np.float32)

    def depth(self) -> Tensor:
        """Depth of the winners (h, w) float32, linear in inverse depth between planes; 0 where none won."""
        inverse = np.interp(self.place, np.arange(len(self.inverse)), self.inverse)
        return torch.from_numpy(np.where(self.place >= 0, 1 / inverse, 0).astype(np.float32))

    def uniqueness(self) -> Tensor:
        """By how much the second-lowest minimum at another depth is above the lowest, in [0, 1], (h, w)."""
        return torch.from_numpy(((self.second - self.best) / np.maximum(self.second, 1e-3)).clip(0, 1))
