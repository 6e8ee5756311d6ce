"""Where the lines of a lattice cross triangles: the exact part of voxelisation.

In lattice coordinates voxel centres are at integers, x, y, z in [0, n). A line runs through centres in one of 13
directions; a shear of the other two coordinates makes it parallel to an axis, and keeps centres at integers.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

__all__ = ["LINES", "Crossings", "Line", "cells_touched", "crossing_counts", "crossings", "line_extent"]

# The largest number of (triangle, row) or (triangle, column) pairs in memory at once.
CHUNK = 1 << 19
# With a smaller part of its normal along an axis, a surface cannot skip a voxel along another axis.
SLOPE = 0.25

Shape = tuple[int, int, int]


class Line(NamedTuple):
    """A family of parallel lines through the voxel centres.

    Attributes:
        axis: the coordinate (0 x, 1 y, 2 z) that increases by one from centre to centre.
        slopes: the change of the two other coordinates, in ascending order, at each step: -1, 0 or 1.
    """

    axis: int
    slopes: tuple[int, int]

    @property
    def others(self) -> tuple[int, int]:
        """The two coordinates that distinguish the lines of the family, before the shear."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second


# The three axes, the six diagonals of the faces and the four of the cube, each in one of its two directions.
LINES = (
    Line(0, (0, 0)), Line(1, (0, 0)), Line(2, (0, 0)),
    Line(0, (1, 0)), Line(0, (-1, 0)), Line(0, (0, 1)), Line(0, (0, -1)), Line(1, (0, 1)), Line(1, (0, -1)),
    Line(0, (1, 1)), Line(0, (1, -1)), Line(0, (-1, 1)), Line(0, (-1, -1)),
)  # fmt: skip


class Crossings(NamedTuple):
    """Where lines cross triangles, in no particular order.

    Attributes:
        column: (K,) the line's first coordinate after the shear.
        row: (K,) the line's second coordinate after the shear.
        place: (K,) float64 position along the line.
        sign: (K,) int8, the side of the triangle that the line meets, +1 or -1; 0 for a triangle seen edge-on.
        face: (K,) the triangle.
    """

    column: np.ndarray
    row: np.ndarray
    place: np.ndarray
    sign: np.ndarray
    face: np.ndarray


def sheared(points: np.ndarray, line: Line) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates in which the lines are parallel to an axis: (column coordinate, row coordinate, along)."""
    along = points[..., line.axis]
    first, second = (points[..., axis] - slope * along for axis, slope in zip(line.others, line.slopes, strict=True))
    return first, second, along


def line_extent(shape: Shape, line: Line, index: int) -> tuple[int, int]:
    """The half-open range of a sheared coordinate in which lines pass through centres."""
    slope, size, length = line.slopes[index], shape[line.others[index]], shape[line.axis]
    return min(0, -slope * (length - 1)), size + max(0, -slope * (length - 1))


def crossings(triangles: np.ndarray, shape: Shape, line: Line) -> Iterator[Crossings]:
    """Cross every line of a family with every triangle.

    A line meets a triangle if, seen along the line, an odd number of its edges pass on its right. Edges are evaluated
    from their end points in a fixed order, so of the two triangles at an edge exactly one meets a line through it: a
    line crosses a closed mesh an even number of times, also through vertices and along edges.

    Args:
        triangles: (F, 3, 3) float64 corners in lattice coordinates, x, y, z.
        shape: number of voxels in x, y, z.
        line: the family.

    Yields:
        Crossings of some triangles at a time; memory is bounded by `CHUNK`.
    """
    u, v, along = sheared(triangles, line)  # (F, 3) each
    (column_low, column_high), (row_low, row_high) = (line_extent(shape, line, index) for index in (0, 1))
    bottom = np.maximum(np.ceil(v.min(1)), row_low)
    top = np.minimum(np.ceil(v.max(1)), row_high)  # half-open: a row at the highest vertex is not crossed
    rows = np.maximum(top - bottom, 0).astype(np.int64)
    rows[(u.max(1) < column_low) | (u.min(1) > column_high)] = 0
    normal = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (v[:, 1] - v[:, 0]) * (u[:, 2] - u[:, 0])
    for begin, end in _chunks(rows):
        face, step = _expand(rows[begin:end])
        face += begin
        row = bottom[face] + step
        left, right = _interval(u[face], v[face], row)
        first = np.maximum(np.ceil(left), column_low)
        count = np.maximum(np.minimum(np.ceil(right), column_high) - first, 0).astype(np.int64)
        for start, stop in _chunks(count):
            pair, offset = _expand(count[start:stop])
            pair += start
            column = first[pair] + offset
            f, r = face[pair], row[pair]
            place = _place(u[f], v[f], along[f], normal[f], column, r)
            sign = np.sign(normal[f]).astype(np.int8)
            yield Crossings(column.astype(np.int64), r.astype(np.int64), place, sign, f)


def crossing_counts(triangles: np.ndarray, shape: Shape, line: Line, *, signed: bool) -> np.ndarray:
    """The number (or sum of signs) of the crossings of each line between each centre and the previous one.

    Returns:
        (length + 1, columns, rows) int32; the last entry is for crossings behind all centres. A crossing exactly at a
        centre counts as in front of it.
    """
    (column_low, columns), (row_low, rows), length = _size(shape, line)
    counts = np.zeros((length + 1) * columns * rows, np.int32)
    for found in crossings(triangles, shape, line):
        step = np.clip(np.ceil(found.place), 0, length).astype(np.int64)
        index = (step * columns + (found.column - column_low)) * rows + (found.row - row_low)
        np.add.at(counts, index, found.sign.astype(np.int32) if signed else np.int32(1))
    return counts.reshape(length + 1, columns, rows)


def cells_touched(triangles: np.ndarray, shape: Shape, finer: int = 4) -> np.ndarray:
    """The voxels that a surface passes through, along the axes of a lattice ``finer`` times as fine.

    Returns:
        (W, H, D) uint8, 0 without a surface; else the sum of 1, 2 and 4 for the axes x, y and z along which a normal of
        the surface has at least `SLOPE` of its largest component.
    """
    touched = np.zeros(shape, np.uint8)
    fine = (triangles + 0.5) * finer - 0.5
    fine_shape = (shape[0] * finer, shape[1] * finer, shape[2] * finer)
    normal = np.abs(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    axes = ((normal >= SLOPE * normal.max(1, keepdims=True)) @ np.array([1, 2, 4])).astype(np.uint8)
    for line in LINES[:3]:
        first, second = line.others
        cells = np.moveaxis(touched, (first, second, line.axis), (0, 1, 2))
        for found in crossings(fine, fine_shape, line):
            step = np.floor(found.place + 0.5)
            within = (step >= 0) & (step < fine_shape[line.axis])
            index = tuple(place[within].astype(np.int64) // finer for place in (found.column, found.row, step))
            np.bitwise_or.at(cells, index, axes[found.face[within]])
    return touched


def _size(shape: Shape, line: Line) -> tuple[tuple[int, int], tuple[int, int], int]:
    """(lowest column, columns), (lowest row, rows) and centres along a line."""
    extents = [line_extent(shape, line, index) for index in (0, 1)]
    (column_low, column_high), (row_low, row_high) = extents
    return (column_low, column_high - column_low), (row_low, row_high - row_low), shape[line.axis]


def _interval(u: np.ndarray, v: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The range of u in which a row is inside a triangle; (inf, -inf) if it is not."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        # From the lower end to the upper, by u if level: the same numbers for both triangles at an edge.
        swap = (v[:, i] > v[:, j]) | ((v[:, i] == v[:, j]) & (u[:, i] > u[:, j]))
        ua, ub = np.where(swap, u[:, j], u[:, i]), np.where(swap, u[:, i], u[:, j])
        va, vb = np.where(swap, v[:, j], v[:, i]), np.where(swap, v[:, i], v[:, j])
        crossed = (va <= row) & (row < vb)
        slope = (ub - ua) / np.where(crossed, vb - va, 1.0)
        at = np.clip(ua + (row - va) * slope, np.minimum(ua, ub), np.maximum(ua, ub))
        left = np.where(crossed & (at < left), at, left)
        right = np.where(crossed & (at > right), at, right)
    return left, right


def _place(
    u: np.ndarray, v: np.ndarray, along: np.ndarray, normal: np.ndarray, column: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Where a line meets the plane of a triangle, clipped to the triangle's range, which rounding could exceed."""
    du, dv = column - u[:, 0], row - v[:, 0]
    second = du * (v[:, 2] - v[:, 0]) - dv * (u[:, 2] - u[:, 0])
    third = dv * (u[:, 1] - u[:, 0]) - du * (v[:, 1] - v[:, 0])
    safe = np.where(normal == 0, 1.0, normal)
    rise = (second * (along[:, 1] - along[:, 0]) + third * (along[:, 2] - along[:, 0])) / safe
    return np.clip(along[:, 0] + rise, along.min(1), along.max(1))


def _chunks(counts: np.ndarray) -> Iterator[tuple[int, int]]:
    """Ranges of at least one item whose counts add up to about `CHUNK`."""
    total = np.concatenate(([0], np.cumsum(counts)))
    bounds = [0]
    while bounds[-1] < len(counts):
        following = int(np.searchsorted(total, total[bounds[-1]] + CHUNK, side="right")) - 1
        bounds.append(max(following, bounds[-1] + 1))
    for begin, end in pairwise(bounds):
        if total[end] > total[begin]:
            yield begin, end


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each index repeated by its count, and the number of the repetition."""
    index = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return index, np.arange(len(index)) - first[index]
