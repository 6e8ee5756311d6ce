"""Rendering meshes on the CPU: colour, depth, normals and masks, with the shading of analytic scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_flag, check_number
from lsmgeo.cameras import as_tensors
from lsmgeo.cameras.camera_checks import check_cameras, image_size
from lsmgeo.cameras.matrices import camera_matrices
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.data.meshes import DEFAULT_COLOUR, Mesh, check_mesh
from lsmgeo.data.meshes.mesh_topology import corner_normals, face_normals
from lsmgeo.errors import BackendError, ShapeError
from lsmgeo.scenes import Lights, Rendering, shade
from lsmgeo.scenes.inputs import background_array, checked_lights

__all__ = ["render_mesh"]

# Shadow rays begin this far above a surface, relative to the size of the mesh: well above the errors of float32, well
# below a pixel.
SHADOW_OFFSET = 1e-4
RAYS_AT_ONCE = 1 << 18
BACKENDS = ("embree", "numpy")
# Triangles in a leaf of the numpy tree, and (ray, box) pairs in memory at once.
LEAF = 4
PAIRS = 1 << 20


@torch.no_grad()
def render_mesh(
    mesh: Mesh,
    cameras: Cameras,
    lights: Lights,
    *,
    shadows: bool = True,
    smooth: bool = True,
    crease: float = 40.0,
    background: Tensor | Sequence[float] = (1.0, 1.0, 1.0),
    size: tuple[int, int] | None = None,
    backend: str = "auto",
) -> Rendering:
    """Render a mesh: the first triangle on the ray of each pixel's centre, shaded by `lsmgeo.scenes.shade`.

    Faces are visible from both sides. Smooth normals are angle-weighted means over the faces around a vertex that are
    connected by edges that bend by less than ``crease``: a box keeps its edges and a sphere has none. Normals point
    towards the viewer; masks, depth and shadows are those of the triangles. The same input gives the same bits.

    Convention:
        Depth is camera z. Integer pixel centres. One ray a pixel, no antialiasing.

    Args:
        mesh: any `Mesh`, world frame; grey (0.7) without face colours.
        cameras: leading shape (V,), all images of one size.
        lights: directions and colours (L, 3), ambient (3,).
        shadows: whether the mesh blocks the lights.
        smooth: whether to interpolate normals; else faces are flat.
        crease: degrees, 0 to 180.
        background: RGB (3,), or anything that broadcasts to (V, 3, H, W).
        size: (H, W) of the images, for which K is resized; by default that of the cameras.
        backend: "embree", "numpy" (needs no extra package; far slower), or "auto": the first that is installed.

    Returns:
        `lsmgeo.scenes.Rendering` on the CPU, without the axis of scenes: images (V, 3, H, W) float32, depth (V, H, W)
        float32, world normals (V, 3, H, W) float32 and mask (V, H, W) bool. Not differentiable.

    Raises:
        DTypeError: not a `Mesh`, not `Lights`.
        ShapeError: shapes that do not match.
        OptionError: an invalid option.
        CameraError: invalid cameras, or views of different sizes without ``size``.
        BackendError: backend "embree" is not installed, or ``smooth`` without SciPy.

    Example:
        >>> import torch, trimesh
        >>> from lsmgeo import cameras, data, scenes
        >>> box = data.from_trimesh(trimesh.creation.box((0.5, 0.5, 0.5)))
        >>> view = cameras.orbit(torch.zeros(1), 0.0, 2.0, focal_length=60.0, height=33, width=33)
        >>> sun = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.8), torch.full((3,), 0.2))
        >>> rendering = data.render_mesh(box, view, sun)
        >>> rendering.depth[0, 16, 16], rendering.images[0, :, 16, 16], int(rendering.mask.sum())
        (tensor(1.7500), tensor([0.7000, 0.7000, 0.7000]), 289)
    """
    who = "render_mesh"
    check_mesh(who, mesh)
    check_flag(who, "shadows", shadows)
    check_flag(who, "smooth", smooth)
    check_choice(who, "backend", backend, ("auto", *BACKENDS))
    check_number(who, "crease", crease, "degrees, 0 to 180", 0, 180)
    tensors = as_tensors(cameras, who)
    if tensors.intrinsics.dim() != 3:
        raise ShapeError(f"{who}: cameras must have the leading shape (V,); got {tensors.shape}")
    check_cameras(who, tensors)
    size = image_size(who, tensors, size)
    lights = Lights(*(value[0] for value in checked_lights(who, lights, 1, torch.device("cpu"), torch.float32)))
    matrices = camera_matrices(tensors, size)
    centers = matrices.center.numpy(force=True)
    from_pixel = matrices.world_from_pixel().numpy(force=True)
    box = torch.cartesian_prod(*torch.from_numpy(mesh.bounds).to(tensors.device, torch.float64).unbind(1))
    windows = matrices.windows(box, size).tolist()

    images = background_array(who, background, (len(centers), 3, *size), torch.device("cpu"), torch.float32)
    depth, mask = torch.zeros(len(centers), *size), torch.zeros(len(centers), *size, dtype=torch.bool)
    out = Rendering(images, depth, torch.zeros_like(images), mask)
    flat = face_normals(mesh.vertices, mesh.faces)
    corners = corner_normals(mesh.vertices, mesh.faces, float(crease)) if smooth else None
    surface = _Surface(mesh, flat, corners, backend)
    for view, (top, bottom, left, right) in enumerate(windows):
        pixels = (np.arange(top, bottom)[:, None] * size[1] + np.arange(left, right)).reshape(-1)
        for begin in range(0, len(pixels), RAYS_AT_ONCE):
            some = pixels[begin : begin + RAYS_AT_ONCE]
            # Camera z of these directions is 1, so distances along them are depths.
            rays = np.stack((some % size[1], some // size[1], np.ones(len(some))))
            directions = (from_pixel[view] @ rays).T
            surface.render(Rendering(*(field[view] for field in out)), some, centers[view], directions, lights, shadows)
    return out


class _Surface:
    """A mesh with its normals, ready for rays."""

    def __init__(self, mesh: Mesh, flat: np.ndarray, corners: np.ndarray | None, backend: str) -> None:
        self.mesh, self.caster = mesh, _make_caster(mesh.vertices, mesh.faces, backend)
        # float32 suffices for directions, and halves the memory traffic.
        self.flat = flat.astype(np.float32)
        self.corners = None if corners is None else corners.astype(np.float32)
        self.extent = float(np.ptp(mesh.bounds, 0).max())

    def render(
        self,
        out: Rendering,
        pixels: np.ndarray,
        center: np.ndarray,
        directions: np.ndarray,
        lights: Lights,
        shadows: bool,
    ) -> None:
        """Render some pixels of one view into its arrays."""
        hits = self.caster.first_hits(np.broadcast_to(center, directions.shape), directions)
        found = np.flatnonzero(hits.face >= 0)
        face, depth = hits.face[found], hits.distance[found]
        points = center + depth[:, None] * directions[found]
        along = directions[found].astype(np.float32)
        flat = self.flat[face]
        side = np.where(row_dots(flat, along) > 0, np.float32(-1), np.float32(1))[:, None]
        flat = flat * side
        normal = flat
        if self.corners is not None:
            normal = _towards_viewer(side * _mix(self.corners[face], hits.weights[found]), flat, along)
        lit = self._lit(points, flat, normal, lights) if shadows else None

        grey = np.broadcast_to(np.array(DEFAULT_COLOUR, np.float32), (len(face), 3))
        albedo = torch.from_numpy(np.array(grey if self.mesh.face_colours is None else self.mesh.face_colours[face]))
        facing = torch.from_numpy(normal)
        at = torch.from_numpy(pixels[found])
        out.images.view(3, -1)[:, at] = shade(albedo, facing, lights, lit).T
        out.normals.view(3, -1)[:, at] = facing.T
        out.depth.view(-1)[at] = torch.from_numpy(depth.astype(np.float32))
        out.mask.view(-1)[at] = True

    def _lit(self, points: np.ndarray, flat: np.ndarray, normal: np.ndarray, lights: Lights) -> Tensor:
        """(K, L) bool, whether points face each light and see it."""
        start = points + SHADOW_OFFSET * self.extent * flat
        lit = np.zeros((len(points), len(lights.directions)), bool)
        for index, direction in enumerate(lights.directions.double().numpy()):
            # A flat face that points away shades itself, whatever its smooth normal.
            towards = direction.astype(np.float32)
            facing = np.flatnonzero((flat @ towards > 0) & (normal @ towards > 0))
            along = np.broadcast_to(direction, (len(facing), 3))
            lit[facing, index] = ~self.caster.occluded(start[facing], along)
        return torch.from_numpy(lit)


def _mix(corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Normals (K, 3) interpolated between those of the corners (K, 3, 3)."""
    second, third = weights.T.astype(np.float32)
    return np.einsum("nk,nki->ni", np.stack((1 - second - third, second, third), 1), corners)


def _towards_viewer(normal: np.ndarray, flat: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Unit normals towards the viewer: an interpolated one that points away is projected across the ray."""
    away = np.maximum(row_dots(normal, along) / row_dots(along, along), 0)
    normal = normal - away[:, None] * along
    length = np.sqrt(row_dots(normal, normal))[:, None]
    return np.where(length > 1e-6, normal / np.maximum(length, np.float32(1e-6)), flat)


class RayHits(NamedTuple):
    """The first intersections of N rays with triangles.

    Attributes:
        face: (N,) int64, -1 for no hit.
        distance: (N,) float64 in multiples of the ray's direction; undefined for no hit.
        weights: (N, 2) float64 barycentric weights of the triangle's second and third corner.
    """

    face: np.ndarray
    distance: np.ndarray
    weights: np.ndarray


def _make_caster(vertices: np.ndarray, faces: np.ndarray, backend: str) -> EmbreeCaster | NumpyCaster:
    """The ray caster of vertices (N, 3) float64 and faces (F, 3) int64; "auto" takes embree if it is installed."""
    if backend != "numpy":
        try:
            return EmbreeCaster(vertices, faces)
        except ImportError as error:
            if backend == "embree":
                raise BackendError(
                    'backend "embree" needs the package embreex, which has no wheel for Linux on aarch64; '
                    'install lsmgeo[data], or pass backend="numpy"'
                ) from error
    return NumpyCaster(vertices, faces)


class EmbreeCaster:
    """Rays by embree, in float32.

    The mesh is moved to the origin and scaled to unit size, and rays begin near it, so that neither its position and
    unit nor the distance of the camera costs precision.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        low, high = vertices.min(0), vertices.max(0)
        self.origin, self.scale = 0.5 * low + 0.5 * high, float((high - low).max()) or 1.0
        points = (vertices - self.origin) / self.scale
        self.radius = 1.01 * float(np.sqrt(row_dots(points, points).max()))  # of a ball around it, with a margin
        corners = points[faces]
        self.normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.heights = row_dots(self.normals, corners[:, 0])  # of the planes above the origin
        # Robust: no ray slips between two triangles that share an edge.
        self.scene = EmbreeScene(robust=True)
        TriangleMesh(self.scene, np.ascontiguousarray(points, np.float32), np.ascontiguousarray(faces, np.int32))

    def _scaled(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays in the frame of the scaled mesh, their origins moved up to the ball around it if farther away.

        The last array is the distance by which they are moved, in multiples of the directions.
        """
        along = directions / self.scale
        start = (origins - self.origin) / self.scale
        square = row_dots(along, along)
        begin = np.maximum(-(row_dots(start, along) + self.radius * np.sqrt(square)) / square, 0.0)
        start += begin[:, None] * along
        return start, along, begin

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """The first hits of rays (origins and directions (N, 3) float64); distances are recomputed in float64."""
        start, along, begin = self._scaled(origins, directions)
        found = self.scene.run(start.astype(np.float32), along.astype(np.float32), output=True)
        face, distance = found["primID"].astype(np.int64), found["tfar"].astype(np.float64)
        hit = np.flatnonzero(face >= 0)
        normal, about = self.normals[face[hit]], distance[hit]
        height = self.heights[face[hit]] - row_dots(normal, start[hit])
        speed = row_dots(normal, along[hit])
        exact = np.divide(height, speed, out=np.full(len(hit), np.inf), where=speed != 0)
        # The plane of a triangle seen edge-on is imprecise: embree's distance is kept.
        size = self.radius / np.sqrt(row_dots(along[hit], along[hit]))
        distance[hit] = np.where(np.abs(exact - about) <= 1e-4 * (about + size), exact, about)
        return RayHits(face, begin + distance, np.stack((found["u"], found["v"]), 1).astype(np.float64))

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) bool, whether rays hit the mesh."""
        start, along, _ = self._scaled(origins, directions)
        return self.scene.run(start.astype(np.float32), along.astype(np.float32), query="OCCLUDED") >= 0


class NumpyCaster:
    """Rays by a tree of boxes in numpy, in float64; far slower than embree."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        # An empty slot (-1) is a box of NaN, which no ray hits and which does not extend its parents.
        self.corners = np.concatenate((vertices[faces], np.full((1, 3, 3), np.nan)))
        low, high = self.corners.min(1), self.corners.max(1)
        slots = np.full((1, LEAF << max(0, int(np.ceil(np.log2(max(len(faces), 1) / LEAF))))), -1, np.int64)
        slots[0, : len(faces)] = np.arange(len(faces))
        while slots.shape[1] > LEAF:
            # Boxes are split at the median of their triangles, along another axis at each level; NaN sorts last.
            middles = (0.5 * low + 0.5 * high)[slots, len(slots).bit_length() % 3]
            slots = np.take_along_axis(slots, np.argsort(middles, axis=1, kind="stable"), 1).reshape(2 * len(slots), -1)
        self.slots = slots
        levels = [(np.fmin.reduce(low[self.slots], axis=1), np.fmax.reduce(high[self.slots], axis=1))]
        while len(levels[0][0]) > 1:
            below = levels[0]
            levels.insert(0, (np.fmin(below[0][::2], below[0][1::2]), np.fmax(below[1][::2], below[1][1::2])))
        self.levels = levels

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """The first hits of rays; of equally near triangles, the first in the mesh."""
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
                # NaN if a ray runs in the side of a box: fmin and fmax ignore that axis.
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

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) bool, whether rays hit the mesh."""
        return self.first_hits(origins, directions).face >= 0


def row_dots(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Dot products (N,) of the rows of two arrays (N, 3); einsum needs no array of products."""
    return np.einsum("ni,ni->n", first, second)
