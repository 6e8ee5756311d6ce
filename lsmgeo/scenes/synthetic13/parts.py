"""Parts used by several categories. Lengths are in the category's own unit; the front is +x, up is +y."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from lsmgeo.scenes.primitives import Kind, Material, Solid, box, cone, cylinder, half_space

__all__ = [
    "Pair",
    "Point",
    "bar",
    "below",
    "block",
    "kept",
    "pair",
    "pillar",
    "rack",
    "ring",
    "rod",
    "slab",
    "spaced",
    "spokes",
    "tube",
    "wheel",
    "window",
    "wing",
]

Vector = Sequence[float] | np.ndarray
Pair = tuple[float, float]
Point = tuple[float, float, float]


def block(low: Vector, high: Vector, material: Material) -> Solid:
    """The box between two opposite corners."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return box((low + high) / 2, high - low, material)


def slab(low: Pair, high: Pair, half: float, material: Material) -> Solid:
    """The box between two corners (x, y) that extends ``half`` to either side of z = 0."""
    return block((*low, -half), (*high, half), material)


def pillar(foot: Point, top: float, radius: float, material: Material, top_radius: float | None = None) -> Solid:
    """An upright cylinder from ``foot`` to y = ``top``, or a frustum."""
    head = (foot[0], top, foot[2])
    if top_radius is None:
        return cylinder(foot, head, radius, material)
    return cone(foot, head, radius, top_radius, material)


def rod(start: Point, end: float, radius: float, material: Material) -> Solid:
    """A cylinder along x from ``start`` to x = ``end``."""
    return cylinder(start, (end, start[1], start[2]), radius, material)


def bar(start: Vector, end: Vector, width: float, depth: float, material: Material) -> Solid:
    """A sheared box from one point to another at a different height, with horizontal ends.

    ``width`` is measured along x, ``depth`` along z.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    matrix = np.stack(((width / 2, 0, 0), (end - start) / 2, (0, 0, depth / 2), (start + end) / 2), 1)
    return Solid(Kind.BOX, matrix, material=material)


def wing(root: Vector, tip: Vector, root_chord: float, tip_chord: float, thickness: float, material: Material) -> Solid:
    """A wing or fin of constant thickness, between the midpoints of its two chords, which are along x.

    The thickness is along y, or along z for an upright fin.
    """
    root, tip = np.asarray(root, dtype=np.float64), np.asarray(tip, dtype=np.float64)
    upright = abs(tip[1] - root[1]) > abs(tip[2] - root[2])
    thin = np.array([0.0, 0.0, 1.0] if upright else [0.0, 1.0, 0.0])
    # A sheared box along the trailing edge, with the leading edge cut off, has a small bounding box.
    reach, chord = np.array([root_chord / 2, 0, 0]), np.array([tip_chord / 2, 0, 0])
    middles = (root, tip - chord + reach)
    matrix = np.stack((reach, (middles[1] - root) / 2, thickness / 2 * thin, (root + middles[1]) / 2), 1)
    slab = Solid(Kind.BOX, matrix, material=material)
    edge = tip + chord - root - reach
    normal = np.cross(edge, thin)
    return kept(slab, root + reach, -np.sign(normal[0]) * normal)


def kept(solid: Solid, point: Vector, towards: Vector) -> Solid:
    """The part of a solid on the side of the plane through ``point`` to which ``towards`` points."""
    return solid.minus(half_space(point, towards))


def below(solid: Solid, first: tuple[float, float], second: tuple[float, float], *, axis: int = 2) -> Solid:
    """The part of a solid below the plane along ``axis`` through two points (x, y), or (z, y) for axis 0."""
    along, up = second[0] - first[0], second[1] - first[1]
    down = (up, -along) if along > 0 else (-up, along)
    if axis == 2:
        return kept(solid, (first[0], first[1], 0.0), (down[0], down[1], 0.0))
    return kept(solid, (0.0, first[1], first[0]), (0.0, down[1], down[0]))


def pair(*solids: Solid) -> list[Solid]:
    """Parts, and the same parts mirrored in the plane z = 0."""
    return [*solids, *(solid.mirrored(2) for solid in solids)]


def spaced(low: float, high: float, count: int) -> list[float]:
    """The centres of ``count`` equal pieces of an interval."""
    return [low + (index + 0.5) * (high - low) / count for index in range(count)]


def rack(
    low: Vector, high: Vector, axis: int, count: int, material: Material, filling: float | None = None
) -> list[Solid]:
    """Slats: a box split into ``count`` bars along ``axis``; each fills ``filling`` of its piece."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    share = (high[axis] - low[axis]) / count
    slats = []
    for middle in spaced(low[axis], high[axis], count):
        size, center = high - low, (low + high) / 2
        size[axis], center[axis] = share * (0.5 if filling is None else filling), middle
        slats.append(box(center, size, material))
    return slats


def window(low: Vector, high: Vector, axis: int, width: float, material: Material) -> list[Solid]:
    """A rectangular frame of four bars ``width`` wide around a hole along ``axis``."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    bars = []
    for across in (index for index in range(3) if index != axis):
        for end in (0, 1):
            first, second = low.copy(), high.copy()
            if end:
                first[across] = high[across] - width
            else:
                second[across] = low[across] + width
            bars.append(block(first, second, material))
    return bars


def spokes(
    hub: Vector, radius: float, drop: float, count: int, width: float, material: Material, *, turn: float = 0.0
) -> list[Solid]:
    """Rods from a hub outwards in all directions, with ends ``drop`` lower: star feet, tripods."""
    hub = np.asarray(hub, dtype=np.float64)
    angles = np.deg2rad(turn) + 2 * np.pi * np.arange(count) / count
    ends = (hub + np.array([radius * np.cos(a), -drop, radius * np.sin(a)]) for a in angles)
    return [cylinder(hub, end, width / 2, material) for end in ends]


def ring(points: Iterable[Vector], radius: float, material: Material) -> list[Solid]:
    """Rods along a chain of points, each a little longer than its piece to close the bends."""
    chain = [np.asarray(point, dtype=np.float64) for point in points]
    rods = []
    for first, second in pairwise(chain):
        over = (second - first) / np.linalg.norm(second - first) * radius * 0.7
        rods.append(cylinder(first - over, second + over, radius, material))
    return rods


def tube(start: Vector, end: Vector, start_radius: float, end_radius: float, wall: float, material: Material) -> Solid:
    """A frustum hollow from end to end: lamp shades, horns."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    over = (end - start) * 1e-3  # no coincident faces of a part and its cut
    outer = cone(start, end, start_radius, end_radius, material)
    return outer.minus(cone(start - over, end + over, start_radius - wall, end_radius - wall))


def wheel(center: Vector, radius: float, width: float, tyre: Material, hub: Material) -> list[Solid]:
    """A wheel that rolls along x, with a hub cap that protrudes on both sides."""
    center = np.asarray(center, dtype=np.float64)
    across = np.array([0.0, 0.0, width / 2])
    return [
        cylinder(center - across, center + across, radius, tyre),
        cylinder(center - 1.15 * across, center + 1.15 * across, 0.55 * radius, hub),
    ]
