"""Correlation costs plane by plane, with OpenCV's box filter in reused memory: fast, without derivatives.

`lsmgeo.classical.matching` computes the same with tensor operations, which allocate an array at every step; that takes
as long as the arithmetic.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

__all__ = ["INVALID_COST", "Correlation", "on_threads"]

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

# The mean cost of unrelated patches, and the cost of sites that no neighbour sees.
INVALID_COST = 1.0


def on_threads(task: Callable[[int], None], numbers: Iterable[int]) -> None:
    """Run a task for every number on as many threads as PyTorch uses; NumPy and OpenCV release Python's lock."""
    threads = torch.get_num_threads()
    if threads == 1:
        for number in numbers:
            task(number)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(task, numbers):
            pass


class Correlation:
    """``1 - cov(r, s) / sqrt((var r + noise^2) (var s + noise^2))`` over windows, for one reference r and many s.

    Args:
        reference: (h, w) float32 grey values, best with a mean of about 0.
        window: side of the windows in pixels, odd.
        noise: see `lsmgeo.classical.matching_costs`.
    """

    def __init__(self, reference: Tensor, window: int, noise: float):
        self.reference: Floats = np.ascontiguousarray(reference.numpy())
        self.window, self.noise = window, noise
        self.buffers = threading.local()
        height, width = self.reference.shape
        # OpenCV pads with zeros beyond the border.
        self.edges = [_edges(height, window), _edges(width, window)]
        self.mean, energy = np.empty_like(self.reference), np.empty_like(self.reference)
        self._average(self.reference, self.mean)
        self._average(self.reference**2, energy)
        spread = np.maximum(energy - self.mean**2, 0) + np.float32(noise**2)
        self.scale: Floats = -1 / np.sqrt(spread)

    def _buffer(self, arrays: int) -> Floats:
        """Memory (arrays, h, w) of the calling thread, uninitialised."""
        buffer = getattr(self.buffers, "values", None)
        if buffer is None or len(buffer) < arrays:
            buffer = self.buffers.values = np.empty((arrays, *self.reference.shape), np.float32)
        return buffer[:arrays]

    def _average(self, values: Floats, out: Floats) -> None:
        import cv2

        cv2.boxFilter(values, -1, (self.window, self.window), dst=out, borderType=cv2.BORDER_CONSTANT)
        rows, columns = self.edges
        for part, factors in rows:
            out[part] *= factors[:, None]
        for part, factors in columns:
            out[:, part] *= factors

    def _correlate(self, warped: Floats, out: Floats, buffer: Floats) -> None:
        """Write the costs minus 1."""
        import cv2

        mean, energy, product = buffer[:3]
        self._average(warped, mean)
        np.multiply(warped, warped, out=product)
        self._average(product, energy)
        np.multiply(mean, mean, out=product)
        cv2.addWeighted(energy, 1, product, -1, self.noise**2, dst=energy)
        # By rounding, a variance of 0 may be slightly negative.
        np.maximum(energy, np.float32(self.noise**2), out=energy)
        np.sqrt(energy, out=energy)
        np.multiply(warped, self.reference, out=out)
        self._average(out, product)
        np.multiply(mean, self.mean, out=mean)
        np.subtract(product, mean, out=product)
        np.multiply(product, self.scale, out=product)
        np.divide(product, energy, out=out)

    def aggregate(self, warped: Floats, visible: Mask, best: int, min_views: int, out: Floats, seen: Mask) -> None:
        """Write the mean cost (h, w) of the best neighbours, and where enough neighbours see a site, for one plane.

        ``warped`` and ``visible`` are (N, h, w), of all neighbours; ``out`` and ``seen`` (h, w) are written. ``best``
        and ``min_views``: see `lsmgeo.classical.aggregate_views`.
        """
        number = len(warped)
        buffer = self._buffer(number + 4)
        costs, spare = list(buffer[4:]), buffer[3]
        for neighbour in range(number):
            self._correlate(warped[neighbour], costs[neighbour], buffer)
        all_see = bool(visible.all())
        if not all_see:
            for cost, sees in zip(costs, visible, strict=True):
                np.copyto(cost, np.inf, where=~sees)
        # Partial bubble sort: the lowest `best` costs move to the front.
        for first in range(best):
            for place in range(number - 1, first, -1):
                np.minimum(costs[place - 1], costs[place], out=spare)
                if first < best - 1:
                    np.maximum(costs[place - 1], costs[place], out=costs[place])
                costs[place - 1], spare = spare, costs[place - 1]
        if not all_see:
            count = np.add.reduce(visible.view(np.uint8), axis=0, dtype=np.uint8 if number < 256 else np.int32)
            for place, cost in enumerate(costs[:best]):
                np.copyto(cost, 0, where=count <= place)
        total = costs[0]
        for cost in costs[1:best]:
            np.add(total, cost, out=total)
        if all_see:
            seen[:] = True
            np.multiply(total, np.float32(1 / best), out=out)
        else:
            np.greater_equal(count, min_views, out=seen)
            np.divide(total, np.clip(count, 1, best).astype(np.float32), out=out)
        np.add(out, 1, out=out)
        if not all_see:
            np.copyto(out, np.float32(INVALID_COST), where=~seen)


def _edges(length: int, window: int) -> list[tuple[slice, Floats]]:
    """The slices at both ends of a line where windows are cut off, and the factors that correct the means there."""
    radius = window // 2
    places = np.arange(length)
    count = np.minimum(places + radius, length - 1) - np.maximum(places - radius, 0) + 1
    factors = (window / count).astype(np.float32)
    parts = (slice(0, min(radius, length)), slice(max(radius, length - radius), length))
    return [(part, factors[part]) for part in parts if len(factors[part])]
