"""Pictures of meshes on the CPU: colour, depth, normals and silhouettes, shaded as analytic scenes are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_flag, check_number, check_size
from lsmgeo.cameras import as_tensors
from lsmgeo.cameras.matrices import camera_matrices
from lsmgeo.cameras.tensors import Cameras, check_cameras
from lsmgeo.cameras.transforms import common_size
from lsmgeo.data.mesh_topology import corner_normals, face_normals
from lsmgeo.data.meshes import DEFAULT_COLOUR, Mesh, check_mesh
from lsmgeo.data.ray_casting import BACKENDS, RayCaster, make_caster, row_dots
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.scenes import Lights, Rendering, shade
from lsmgeo.scenes.inputs import behind, checked_lights

__all__ = ["render_mesh"]

# Shadow rays leave a surface from this far above it, relative to the size of the mesh, however far the camera is: well
# above what float32 loses there, well below a pixel.
SHADOW_OFFSET = 1e-4
RAYS_AT_ONCE = 1 << 18


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

    Faces are seen from both sides. Smooth normals are the angle-weighted means of the faces around a vertex, taken over
    the edges that bend by less than ``crease``; so a box keeps its edges and a sphere shows none. They turn towards the
    viewer, and silhouettes, depth and shadows stay those of the triangles. The same input gives the same bits.

    Convention:
        Depth is camera z. Integer pixel centres. One ray a pixel, no antialiasing.

    Args:
        mesh: any `Mesh`, world frame; without face colours it is grey, 0.7.
        cameras: leading shape (V,), all images of one size.
        lights: directions and colours (L, 3), ambient (3,).
        shadows: whether the mesh blocks the lights.
        smooth: whether to interpolate normals; else each face is flat.
        crease: degrees, 0 to 180.
        background: RGB behind the mesh, (3,), or anything that broadcasts to (V, 3, H, W).
        size: (H, W) of the images; by default the cameras' own. K is resized for it.
        backend: "embree", "numpy" (needs no extra package; far slower), or "auto": the first that is installed.

    Returns:
        `lsmgeo.scenes.Rendering` on the CPU, without the axis of scenes: images (V, 3, H, W) float32, depth (V, H, W)
        float32, world normals (V, 3, H, W) float32 and mask (V, H, W) bool. Not differentiable: tensors that
        require gradients are taken as they are, and the result requires none.

    Raises:
        DTypeError: not a `Mesh`, not `Lights`.
        ShapeError: shapes that do not belong together.
        OptionError: an impossible option.
        CameraError: bad cameras, or views of different sizes and no ``size``.
        BackendError: embree was asked for by name and is not installed, or ``smooth`` without scipy.

    Example:
        >>> import torch, trimesh
        >>> from lsmgeo import cameras, data, scenes
        >>> box = data.from_trimesh(trimesh.creation.box((0.5, 0.5, 0.5)))
        >>> view = cameras.orbit(torch.zeros(1), 0.0, 2.0, focal_length=60.0, height=33, width=33)
        >>> sun = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.8), torch.full((3,), 0.2))
        >>> picture = data.render_mesh(box, view, sun)
        >>> picture.depth[0, 16, 16], picture.images[0, :, 16, 16], int(picture.mask.sum())
        (tensor(1.7500), tensor([0.7000, 0.7000, 0.7000]), 289)
    """
    who = "render_mesh"
    check_mesh(who, mesh)
    check_flag(who, "shadows", shadows)
    check_flag(who, "smooth", smooth)
    check_choice(who, "backend", backend, ("auto", *BACKENDS))
    if not 0 <= check_number(who, "crease", crease, "degrees, 0 to 180") <= 180:
        raise OptionError(f"{who}: crease must be degrees, 0 to 180; got {crease!r}")
    tensors = as_tensors(cameras, who)
    if tensors.intrinsics.dim() != 3:
        raise ShapeError(f"{who}: cameras must have the leading shape (V,); got {tuple(tensors.intrinsics.shape[:-2])}")
    check_cameras(who, tensors)
    size = common_size(who, tensors) if size is None else check_size(who, "size", size, 2, "(h, w)")  # type: ignore[assignment]
    assert size is not None
    lights = Lights(*(value[0] for value in checked_lights(who, lights, 1, torch.device("cpu"), torch.float32)))
    matrices = camera_matrices(tensors, size)
    centers = matrices.center.numpy(force=True)
    from_pixel = matrices.world_from_pixel.numpy(force=True)
    projections = matrices.projection.numpy(force=True)

    images = behind(who, background, (len(centers), 3, *size), torch.device("cpu"), torch.float32)
    depth, mask = torch.zeros(len(centers), *size), torch.zeros(len(centers), *size, dtype=torch.bool)
    out = Rendering(images, depth, torch.zeros_like(images), mask)
    flat = face_normals(mesh.vertices, mesh.faces)
    corners = corner_normals(mesh.vertices, mesh.faces, float(crease)) if smooth else None
    surface = _Surface(mesh, flat, corners, make_caster(mesh.vertices, mesh.faces, backend))
    for view in range(len(centers)):
        pixels = _pixels_near(mesh, projections[view], size)
        for begin in range(0, len(pixels), RAYS_AT_ONCE):
            some = pixels[begin : begin + RAYS_AT_ONCE]
            # Camera z of these directions is 1, so a distance along them is a depth.
            rays = np.stack((some % size[1], some // size[1], np.ones(len(some))))
            directions = (from_pixel[view] @ rays).T
            surface.render(Rendering(*(field[view] for field in out)), some, centers[view], directions, lights, shadows)
    return out


def _pixels_near(mesh: Mesh, projection: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which pixels may see the mesh, row by row: those in the window of its bounding box, if all of it is in front."""
    box = mesh.bounds
    corners = np.array([[*(box[(k >> axis) & 1, axis] for axis in range(3)), 1.0] for k in range(8)])
    x, y, z = (corners @ projection.T).T
    low, high = np.zeros(2, np.int64), np.array(size)
    if z.min() > 1e-6 * np.abs(z).max():
        v, u = y / z, x / z
        low = np.maximum(np.floor([v.min(), u.min()]).clip(-1, 2**31) - 1, low).astype(np.int64)
        high = np.minimum(np.ceil([v.max(), u.max()]).clip(-1, 2**31) + 2, high).astype(np.int64)
    rows, columns = np.arange(low[0], high[0]), np.arange(low[1], high[1])
    return (rows[:, None] * size[1] + columns).reshape(-1)


class _Surface:
    """A mesh with its normals, ready for rays."""

    def __init__(self, mesh: Mesh, flat: np.ndarray, corners: np.ndarray | None, caster: RayCaster) -> None:
        self.mesh, self.caster = mesh, caster
        # Directions need no more than float32, and half the memory is read.
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
        """(K, L) bool, whether points see each light; those turned away from it do not."""
        start = points + SHADOW_OFFSET * self.extent * flat
        lit = np.zeros((len(points), len(lights.directions)), bool)
        for index, direction in enumerate(lights.directions.double().numpy()):
            # Where a flat face turns away it shades itself, however its smooth normal stands.
            towards = direction.astype(np.float32)
            facing = np.flatnonzero((flat @ towards > 0) & (normal @ towards > 0))
            along = np.broadcast_to(direction, (len(facing), 3))
            lit[facing, index] = ~self.caster.blocked(start[facing], along)
        return torch.from_numpy(lit)


def _mix(corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Normals (K, 3) between those at the corners (K, 3, 3)."""
    second, third = weights.T.astype(np.float32)
    return np.einsum("nk,nki->ni", np.stack((1 - second - third, second, third), 1), corners)


def _towards_viewer(normal: np.ndarray, flat: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Unit normals that do not look away: at silhouettes an interpolated one may, and is laid across the ray."""
    away = np.maximum(row_dots(normal, along) / row_dots(along, along), 0)
    normal = normal - away[:, None] * along
    length = np.sqrt(row_dots(normal, normal))[:, None]
    return np.where(length > 1e-6, normal / np.maximum(length, np.float32(1e-6)), flat)
