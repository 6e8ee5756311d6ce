"""First hits of rays and triangles on the CPU: by embree where it is installed, else by numpy, slowly."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from lsmgeo.errors import BackendError

__all__ = ["BACKENDS", "EmbreeCaster", "NumpyCaster", "RayCaster", "RayHits", "make_caster", "row_dots"]

BACKENDS = ("embree", "numpy")
# Leaves of the numpy tree hold this many triangles, and this many (ray, box) pairs are held at once.
LEAF = 4
PAIRS = 1 << 20


class RayHits(NamedTuple):
    """Where N rays first meet a triangle.

    Attributes:
        face: (N,) int64, -1 where nothing is hit.
        distance: (N,) float64 in multiples of the ray's direction; meaningless where nothing is hit.
        weights: (N, 2) float64 barycentric weights of the triangle's second and third corner.
    """

    face: np.ndarray
    distance: np.ndarray
    weights: np.ndarray


def make_caster(vertices: np.ndarray, faces: np.ndarray, backend: str = "auto") -> RayCaster:
    """Make a mesh ready for rays.

    Args:
        vertices: (N, 3) float64.
        faces: (F, 3) int64.
        backend: "embree", "numpy", or "auto": the first that is installed.

    Raises:
        BackendError: embree was asked for by name and is not installed.
    """
    if backend != "numpy":
        try:
            return EmbreeCaster(vertices, faces)
        except ImportError as error:
            if backend == "embree":
                raise BackendError(
                    'backend "embree" needs the package embreex, which has no wheel for Linux on aarch64; '
                    'install lsmgeo[data], or take backend="numpy"'
                ) from error
    return NumpyCaster(vertices, faces)


class EmbreeCaster:
    """Rays by embree, in float32.

    The mesh is moved to the origin and scaled to unit size, and rays begin near it: neither its place and unit nor how
    far the rays come from cost precision.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        low, high = vertices.min(0), vertices.max(0)
        self.origin, self.scale = 0.5 * low + 0.5 * high, float((high - low).max()) or 1.0
        points = (vertices - self.origin) / self.scale
        self.radius = 1.01 * float(np.sqrt(row_dots(points, points).max()))  # of a ball around it, with room to spare
        corners = points[faces]
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.heights = row_dots(self.normals, corners[:, 0])  # of the planes above the origin
        # Robust: no ray slips between two triangles that share an edge.
        self.scene = EmbreeScene(robust=True)
        TriangleMesh(self.scene, np.ascontiguousarray(points, np.float32), np.ascontiguousarray(faces, np.int32))

    def _scaled(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays in the frame of the moved mesh, with origins just outside the ball around it where they were beyond.

        The last array says how far they were moved, in multiples of the directions, which keep their lengths in it.
        """
        along = directions / self.scale
        start = (origins - self.origin) / self.scale
        square = row_dots(along, along)
        begin = np.maximum(-(row_dots(start, along) + self.radius * np.sqrt(square)) / square, 0.0)
        start += begin[:, None] * along
        return start, along, begin

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """Where rays, origins and directions (N, 3) float64, first meet the mesh in front of their origins.

        The distance is computed again in float64 with the triangle found.
        """
        start, along, begin = self._scaled(origins, directions)
        found = self.scene.run(start.astype(np.float32), along.astype(np.float32), output=True)
        face, distance = found["primID"].astype(np.int64), found["tfar"].astype(np.float64)
        hit = np.flatnonzero(face >= 0)
        normal, about = self.normals[face[hit]], distance[hit]
        height = self.heights[face[hit]] - row_dots(normal, start[hit])
        speed = row_dots(normal, along[hit])
        exact = np.divide(height, speed, out=np.full(len(hit), np.inf), where=speed != 0)
        # On a triangle seen edge-on the plane says little, and embree's own distance stays.
        size = self.radius / np.sqrt(row_dots(along[hit], along[hit]))
        distance[hit] = np.where(np.abs(exact - about) <= 1e-4 * (about + size), exact, about)
        return RayHits(face, begin + distance, np.stack((found["u"], found["v"]), 1).astype(np.float64))

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) bool, whether rays meet the mesh at all in front of their origins."""
        start, along, _ = self._scaled(origins, directions)
        return self.scene.run(start.astype(np.float32), along.astype(np.float32), query="OCCLUDED") >= 0


class NumpyCaster:
    """Rays by a tree of boxes in numpy, in float64; far slower than embree."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        # An empty slot (-1) is a box of NaN, which no ray meets and which adds nothing to the boxes above it.
        self.corners = np.concatenate((vertices[faces], np.full((1, 3, 3), np.nan)))
        low, high = self.corners.min(1), self.corners.max(1)
        slots = np.full((1, LEAF << max(0, int(np.ceil(np.log2(max(len(faces), 1) / LEAF))))), -1, np.int64)
        slots[0, : len(faces)] = np.arange(len(faces))
        while slots.shape[1] > LEAF:
            # Each box is cut at the median of its triangles, along another axis at each level; NaN sorts last.
            middles = (0.5 * low + 0.5 * high)[slots, len(slots).bit_length() % 3]
            slots = np.take_along_axis(slots, np.argsort(middles, axis=1, kind="stable"), 1).reshape(2 * len(slots), -1)
        self.slots = slots
        levels = [(np.fmin.reduce(low[self.slots], axis=1), np.fmax.reduce(high[self.slots], axis=1))]
        while len(levels[0][0]) > 1:
            below = levels[0]
            levels.insert(0, (np.fmin(below[0][::2], below[0][1::2]), np.fmax(below[1][::2], below[1][1::2])))
        self.levels = levels

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """Where rays first meet the mesh; of triangles equally near, the first in the mesh."""
        origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        face = np.full(len(origins), -1, np.int64)
        best, weights = np.full(len(origins), np.inf), np.zeros((len(origins), 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / directions
            pieces = range(0, len(origins), PAIRS // 16)
            waiting = [(0, np.arange(at, min(at + PAIRS // 16, len(origins)))) for at in pieces]
            stack = [(level, rays, np.zeros(len(rays), np.int64)) for level, rays in waiting]
            while stack:
                level, rays, nodes = stack.pop()
                low, high = self.levels[level]
                one, two = ((side[nodes] - origins[rays]) * inverse[rays] for side in (low, high))
                # NaN where a ray in a box's side runs along it: fmin and fmax leave that axis out.
                enter = np.fmax.reduce(np.fmin(one, two), axis=1)
                leave = np.fmin.reduce(np.fmax(one, two), axis=1)
                margin = 1e-12 * (1.0 + np.abs(leave))
                keep = (enter <= leave + margin) & (leave >= -margin) & (enter <= best[rays])
                rays, nodes = rays[keep], nodes[keep]
                if level + 1 < len(self.levels):
                    rays, nodes = np.repeat(rays, 2), (2 * nodes[:, None] + [0, 1]).reshape(-1)
                    for at in range(0, len(rays), PAIRS):
                        stack.append((level + 1, rays[at : at + PAIRS], nodes[at : at + PAIRS]))
                elif len(rays):
                    self._meet(origins, directions, rays, nodes, (face, best, weights))
        return RayHits(face, best, weights)

    def _meet(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        rays: np.ndarray,
        leaves: np.ndarray,
        out: tuple[np.ndarray, np.ndarray, np.ndarray],
    ) -> None:
        """Moeller and Trumbore (1997), keeping the nearest hit of each ray."""
        rays, faces = np.repeat(rays, LEAF), self.slots[leaves].reshape(-1)
        corners, direction = self.corners[faces], directions[rays]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        side = np.cross(direction, second)
        volume = (first * side).sum(1)
        offset = origins[rays] - corners[:, 0]
        other = np.cross(offset, first)
        u, v = (offset * side).sum(1) / volume, (direction * other).sum(1) / volume
        distance = (second * other).sum(1) / volume
        within = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (distance > 0) & (faces >= 0)
        rays, faces, distance, u, v = (values[within] for values in (rays, faces, distance, u, v))
        order = np.lexsort((faces, distance, rays))
        nearest = order[np.concatenate(([True], rays[order][1:] != rays[order][:-1]))] if len(order) else order
        rays, faces, distance = rays[nearest], faces[nearest], distance[nearest]
        face, best, weights = out
        nearer = (distance < best[rays]) | ((distance == best[rays]) & (faces < face[rays]))
        rays, nearest = rays[nearer], nearest[nearer]
        face[rays], best[rays] = faces[nearer], distance[nearer]
        weights[rays] = np.stack((u[nearest], v[nearest]), 1)

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays meet the mesh at all."""
        return self.first_hits(origins, directions).face >= 0


RayCaster: TypeAlias = EmbreeCaster | NumpyCaster


def row_dots(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Dot products (N,) of the rows of two arrays (N, 3); einsum needs no array of products."""
    return np.einsum("ni,ni->n", first, second)
