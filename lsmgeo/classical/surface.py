"""Triangle meshes from grids, and their files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from torch import Tensor

from lsmgeo._checks import check_finite, check_number, check_whole, describe
from lsmgeo.classical.tsdf import Tsdf
from lsmgeo.data.atomic_files import write_atomic
from lsmgeo.data.meshes import Mesh, check_mesh
from lsmgeo.data.meshes.mesh_topology import components
from lsmgeo.errors import DataError, DTypeError, GridError, OptionError, ShapeError
from lsmgeo.grids import VoxelGrid

__all__ = ["SurfaceMesh", "drop_specks", "extract_mesh", "write_mesh"]


# The former name of coloured meshes.
SurfaceMesh = Mesh


def extract_mesh(
    field: Tsdf | Tensor,
    grid: VoxelGrid,
    *,
    level: float | None = None,
    specks: int = 0,
) -> Mesh:
    """The surface of a signed distance, of an occupancy or of any field that is larger inside, by marching cubes.

    (Lorensen and Cline, SIGGRAPH 1987; Lewiner's topologically correct variant, from scikit-image.)

    Convention:
        Index i is the centre of voxel i. In a `Tsdf`, only cells with eight observed corners are used, so that the
        surface is open where nothing was observed; any other field is taken to be empty outside the grid, so that its
        surface is closed.

    Args:
        field: a `Tsdf`, or (D, H, W): bool, or numbers that are larger inside.
        grid: of the field.
        level: the value on the surface; by default 0 for a `Tsdf`, 0.5 for others.
        specks: components with fewer faces than this are dropped.

    Returns:
        The mesh, without faces if nothing crosses the level; with colours if the `Tsdf` has them.

    Raises:
        ShapeError, DTypeError: a field that does not fit the grid.
        GridError: a grid with a batch of poses.
        OptionError: a field that is not finite, a level that is not a number, negative specks.

    Example:
        >>> from lsmgeo import VoxelGrid, scenes
        >>> from lsmgeo.classical import extract_mesh
        >>> ball, grid = scenes.Scene([scenes.sphere((0, 0, 0), 0.3)]), VoxelGrid(16)
        >>> extract_mesh(scenes.voxels([ball], grid)[0], grid)
        Mesh(456 vertices, 908 faces)
    """
    who = "extract_mesh"
    if not isinstance(grid, VoxelGrid):
        raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
    T = grid.world_from_lattice.detach().cpu().numpy()
    if T.ndim != 2:
        raise GridError(f"{who}: grid must be of one scene; got {grid}")
    check_whole(who, "specks", specks, 0)
    if level is not None:
        check_number(who, "level", level, "a number")
    values = field.distance if isinstance(field, Tsdf) else field
    if not isinstance(values, Tensor):
        raise DTypeError(f"{who}: field must be a Tsdf or a tensor (D, H, W); got {describe(values)}")
    if tuple(values.shape) != grid.shape:
        raise ShapeError(f"{who}: field must be {grid.shape}, as the grid; got {tuple(values.shape)}")
    values = values.detach().cpu()
    check_finite(who, "field", values)
    if isinstance(field, Tsdf):
        surface = 0.0 if level is None else level
        # Larger inside, like every other field.
        inside = (surface - values).float().numpy()
        cells = _seen_cells(field.weight.detach().cpu().numpy() > 0)
        offset = 0
    else:
        surface = 0.5 if level is None else level
        inside = (values.double() - surface).float().numpy()
        inside = np.pad(inside, 1, constant_values=min(-abs(float(inside.min())), -1e-3 * float(np.abs(inside).max())))
        cells, offset = None, 1
    index, faces = _march(inside, cells)
    index -= offset
    if np.linalg.det(T[:3, :3]) < 0:
        faces = faces[:, ::-1]
    vertices = (index @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    colours = None
    if isinstance(field, Tsdf) and field.colours is not None:
        colours = _colours_at(field.colours, index)
    mesh = Mesh(vertices, faces, colours=colours)
    return drop_specks(mesh, specks) if specks else mesh


def drop_specks(mesh: Mesh, faces: int) -> Mesh:
    """Drop connected components with fewer than ``faces`` faces, and vertices that no face uses."""
    check_mesh("drop_specks", mesh, least=0)
    check_whole("drop_specks", "faces", faces, 0)
    if len(mesh.faces) == 0:
        return mesh
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    component = components(len(mesh.vertices), ends[:, 0], ends[:, 1])[mesh.faces[:, 0]]
    return _without_unused(mesh, mesh.faces[(np.bincount(component) >= faces)[component]])


def write_mesh(path: str | os.PathLike[str], mesh: Mesh) -> Path:
    """Write a mesh as PLY or GLB, according to the ending of the path; no incomplete file is left.

    Convention:
        Coordinates are those of the mesh, also in GLB, in which viewers take y as up.

    Args:
        path: ends in .ply or .glb.
        mesh: with at least one face.

    Returns:
        The path.

    Raises:
        OptionError: another ending, or colours of faces.
        DataError: the mesh has no face, or the file cannot be written.
    """
    kind = Path(path).suffix[1:].lower()
    if kind not in ("ply", "glb"):
        raise OptionError(f"write_mesh: path must end in .ply or .glb; got {os.fspath(path)!r}")
    check_mesh("write_mesh", mesh, least=0)
    if mesh.face_colours is not None:
        raise OptionError("write_mesh: mesh must have colours of its vertices, not of its faces, which are not written")
    if len(mesh.faces) == 0:
        raise DataError(path, "the mesh has no face")
    import trimesh

    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
    content = made.export(file_type=kind)
    assert isinstance(content, bytes)
    return write_atomic(path, content)


def _seen_cells(seen: np.ndarray) -> np.ndarray:
    """Cells with eight observed corners, at the index of their last corner, as `marching_cubes` expects."""
    cells = np.zeros_like(seen)
    corners = [
        seen[z : z - 1 or None, y : y - 1 or None, x : x - 1 or None] for z in (0, 1) for y in (0, 1) for x in (0, 1)
    ]
    if min(seen.shape) > 1:
        cells[1:, 1:, 1:] = np.logical_and.reduce(corners)
    return cells


def _march(inside: np.ndarray, cells: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) as indices x, y, z, float64, and faces (M, 3), where a field crosses 0."""
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    if min(inside.shape) < 2 or not inside.min() < 0 < inside.max():
        return nothing
    from skimage.measure import marching_cubes

    try:
        vertices, faces, _, _ = marching_cubes(inside, 0.0, mask=cells)
    except RuntimeError:  # no cell of the mask crosses the level
        return nothing
    mesh = Mesh(vertices[:, ::-1], faces)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    mesh = _without_unused(mesh, mesh.faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0])
    return mesh.vertices, mesh.faces


def _without_unused(mesh: Mesh, faces: np.ndarray) -> Mesh:
    used, faces = np.unique(faces, return_inverse=True)
    colours = None if mesh.colours is None else mesh.colours[used]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3), colours=colours)


def _colours_at(colours: Tensor, index: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 at fractional indices (N, 3), interpolated between the corners that have a colour."""
    from scipy.ndimage import map_coordinates

    values = colours.detach().cpu().double().numpy()
    known = (values.max(0) > 0).astype(np.float64)
    at = index.T[::-1]
    sums = [map_coordinates(part, at, order=1, mode="nearest") for part in (*values * known, known)]
    mean = np.stack(sums[:3], 1) / np.maximum(sums[3], 1e-12)[:, None]
    return (np.clip(mean, 0, 1) * 255).round().astype(np.uint8)
