"""Primitives in world coordinates with textbook formulas, and first hits of rays with their unions and differences.

There are no canonical primitives and no intervals: a ray's crossings with all surfaces are sorted, and the hit is the
start of the first interval between two of them whose midpoint is inside the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Crossings = list[tuple[Array, Array]]  # (ray parameter (N,), outward normal (N, 3)); NaN where there is none


@dataclass(frozen=True)
class HalfSpace:
    """``normal . (X - point) <= 0``."""

    point: Array
    normal: Array

    def holds(self, points: Array) -> npt.NDArray[np.bool_]:
        return (points - self.point) @ self.normal <= 0

    def crossings(self, o: Array, d: Array) -> Crossings:
        unit = self.normal / np.linalg.norm(self.normal)
        return [(((self.point - o) @ self.normal) / (d @ self.normal), np.broadcast_to(unit, d.shape))]


@dataclass(frozen=True)
class Faces:
    """A box, or any parallelepiped: a corner and three edges."""

    corner: Array
    edges: Array  # (3, 3), one edge a row

    def planes(self) -> list[HalfSpace]:
        found = []
        for axis in range(3):
            normal = np.cross(self.edges[axis - 2], self.edges[axis - 1])
            normal = normal * np.sign(normal @ self.edges[axis])
            found += [HalfSpace(self.corner, -normal), HalfSpace(self.corner + self.edges[axis], normal)]
        return found

    def holds(self, points: Array) -> npt.NDArray[np.bool_]:
        return np.all([plane.holds(points) for plane in self.planes()], axis=0)

    def crossings(self, o: Array, d: Array) -> Crossings:
        return [crossing for plane in self.planes() for crossing in plane.crossings(o, d)]


@dataclass(frozen=True)
class Ellipsoid:
    """``|S (X - center)| <= 1`` with S = diag(1 / radii) R^T."""

    center: Array
    radii: Array
    rotation: Array

    @property
    def form(self) -> Array:
        return self.rotation @ np.diag(1 / self.radii**2) @ self.rotation.T

    def holds(self, points: Array) -> npt.NDArray[np.bool_]:
        offset = points - self.center
        return np.einsum("ni,ij,nj->n", offset, self.form, offset) <= 1

    def crossings(self, o: Array, d: Array) -> Crossings:
        form, offset = self.form, o - self.center
        a, b, c = (np.einsum("ni,ij,nj->n", x, form, y) for x, y in ((d, d), (offset, d), (offset, offset)))
        root = np.sqrt(b * b - a * (c - 1))
        found = []
        for s in ((-b - root) / a, (-b + root) / a):
            normal = (o + s[:, None] * d - self.center) @ form
            found.append((s, normal / np.linalg.norm(normal, axis=1, keepdims=True)))
        return found


@dataclass(frozen=True)
class Frustum:
    """A cylinder or a cone between two points on its axis, with a radius at each."""

    start: Array
    end: Array
    start_radius: float
    end_radius: float

    def along(self, points: Array) -> tuple[Array, Array, Array]:
        """Height above the start, distance from the axis, and radius at that height."""
        axis = self.end - self.start
        length = np.linalg.norm(axis)
        height = (points - self.start) @ axis / length
        away = np.linalg.norm(points - self.start - height[:, None] * axis / length, axis=1)
        return height, away, self.start_radius + (self.end_radius - self.start_radius) * height / length

    def holds(self, points: Array) -> npt.NDArray[np.bool_]:
        height, away, radius = self.along(points)
        return (height >= 0) & (height <= np.linalg.norm(self.end - self.start)) & (away <= radius)

    def crossings(self, o: Array, d: Array) -> Crossings:
        axis = self.end - self.start
        length = np.linalg.norm(axis)
        axis = axis / length
        slope = (self.end_radius - self.start_radius) / length
        offset = o - self.start
        h0, h1 = offset @ axis, d @ axis
        p, q = offset - h0[:, None] * axis, d - h1[:, None] * axis
        r0, r1 = self.start_radius + slope * h0, slope * h1
        found = []
        # |p + s q|^2 = (r0 + s r1)^2
        a, b, c = (q * q).sum(1) - r1**2, 2 * ((p * q).sum(1) - r0 * r1), (p * p).sum(1) - r0**2
        root = np.sqrt(b * b - 4 * a * c)
        for s in ((-b - root) / (2 * a), (-b + root) / (2 * a)):
            at = o + s[:, None] * d
            height, away, _ = self.along(at)
            normal = (at - self.start - height[:, None] * axis) / away[:, None] - slope * axis
            found.append((s, normal / np.linalg.norm(normal, axis=1, keepdims=True)))
        for point, side in ((self.start, -axis), (self.end, axis)):
            found += HalfSpace(point, side).crossings(o, d)
        return found


Shape = HalfSpace | Faces | Ellipsoid | Frustum


@dataclass(frozen=True)
class Part:
    """A shape minus others."""

    shape: Shape
    cuts: tuple[Shape, ...] = ()

    def holds(self, points: Array) -> npt.NDArray[np.bool_]:
        inside = self.shape.holds(points)
        for cut in self.cuts:
            inside = inside & ~cut.holds(points)
        return inside


def holds(parts: list[Part], points: Array) -> npt.NDArray[np.bool_]:
    """Whether points (N, 3) lie in any of the parts."""
    return np.any([part.holds(points) for part in parts], axis=0)


def first_hit(parts: list[Part], origins: Array, directions: Array) -> tuple[Array, Array, Array]:
    """Where rays from outside enter a union of parts.

    Returns:
        ray parameter (N,), inf for a miss; the normal (N, 3) on the side of the ray's origin, 0 for a miss; and the
        difference (N,) to the nearest other crossing in the ray parameter: small at edges, where rounding decides.
    """
    found = []
    with np.errstate(all="ignore"):
        for part in parts:
            for shape, sign in ((part.shape, 1.0), *((cut, -1.0) for cut in part.cuts)):
                found += [(s, sign * normal) for s, normal in shape.crossings(origins, directions)]
    s = np.stack([s for s, _ in found])  # (M, N)
    normals = np.stack([normal for _, normal in found])
    s = np.where(np.isfinite(s) & (s > 0), s, np.inf)
    order = np.argsort(s, axis=0)
    sorted_s = np.take_along_axis(s, order, 0)
    last = np.full_like(sorted_s[:1], np.inf)
    after = np.concatenate((sorted_s[1:], last))
    hit, normal, margin = np.full(len(origins), np.inf), np.zeros((len(origins), 3)), np.full(len(origins), np.inf)
    open_ = np.ones(len(origins), dtype=bool)
    for index in range(len(s)):
        here = sorted_s[index]
        is_hit = open_ & np.isfinite(here)
        middle = np.where(np.isfinite(after[index]), (here + after[index]) / 2, here + 1.0)[is_hit]
        at = origins[is_hit] + middle[:, None] * directions[is_hit]
        is_hit[is_hit] = holds(parts, at)
        rays = np.nonzero(is_hit)[0]
        hit[rays] = here[rays]
        normal[rays] = normals[order[index, rays], rays]
        before = sorted_s[index - 1][rays] if index else -np.inf
        margin[rays] = np.minimum(after[index][rays] - here[rays], here[rays] - before)
        open_ &= ~is_hit
    return hit, normal, margin
