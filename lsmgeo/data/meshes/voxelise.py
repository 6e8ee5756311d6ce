"""Solid voxels of a mesh: exact for closed parts, by vote for open ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_flag
from lsmgeo.data.meshes import Mesh, check_mesh
from lsmgeo.data.meshes.mesh_topology import (
    Parts,
    are_nondegenerate,
    distinct_faces,
    merged_faces,
    misoriented_faces,
    parts_of,
)
from lsmgeo.data.meshes.scan_conversion import LINES, Line, cells_touched, crossing_counts, line_extent
from lsmgeo.errors import OptionError
from lsmgeo.grids import VoxelGrid

__all__ = ["plan_voxels", "voxelise"]

LARGEST_RESOLUTION = 512
AXES = LINES[:3]
# Beyond this many inside-out parts, they are reversed without a test whether they are cavities of other parts.
MOST_CAVITIES = 64

Shape = tuple[int, int, int]

Group = tuple[np.ndarray, Sequence[Line], bool]


def voxelise(
    mesh: Mesh,
    resolution: int | Shape = 32,
    *,
    keep_thin: bool | None = None,
    lower: float | Sequence[float] = -0.5,
    upper: float | Sequence[float] = 0.5,
) -> Tensor:
    """The voxels of a grid that are solid.

    A voxel is solid if its centre is inside the mesh. Lines through the centres are intersected with all triangles in
    float64, with a rule for edges that leaves no gap: a closed mesh gives exactly its occupancy, deterministically.

    Each part, connected through edges, has its own rule. A closed part has the winding number (nonzero rule, so parts
    may overlap) of its faces, first oriented consistently and outwards unless it is a cavity of another part; if no
    consistent orientation exists, parity. A line whose crossings do not balance meets a hole: it abstains, and the
    other lines vote, the three axes for closed parts, else 13 directions (axes, diagonals of faces and of the cube).
    Copies of faces that make a part visible from both sides are left out.

    Args:
        mesh: (N, 3) vertices in world units and (F, 3) faces.
        resolution: voxels along each side, or (D, H, W); 512 at most.
        keep_thin: add parts thinner than a voxel: voxels that the surface passes through with no solid voxel next to
            them along the surface's normals. By default only if the mesh is not watertight; of a watertight one exactly
            the voxels whose centres are inside are solid.
        lower: lower bounds of the grid, world units, a number or (x, y, z).
        upper: upper bounds.

    Returns:
        (D, H, W) bool, axes z, y, x; centres as in `lsmgeo.VoxelGrid`; parts outside the grid are cut off. It takes
        the memory of several integer arrays of the grid's size.

    Raises:
        DTypeError: not a `Mesh`, or arrays of other types.
        ShapeError: a wrong shape.
        GridError: an invalid grid.
        OptionError: a resolution above 512, or vertices that are not finite.
        BackendError: scipy is not installed.

    Example:
        >>> import numpy as np
        >>> from lsmgeo.data import Mesh, voxelise
        >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> voxelise(Mesh(corners * 0.8 - 0.4, faces), 4)[1].int()
        tensor([[1, 1, 0, 0],
                [1, 0, 0, 0],
                [0, 0, 0, 0],
                [0, 0, 0, 0]], dtype=torch.int32)
    """
    who = "voxelise"
    check_mesh(who, mesh)
    if keep_thin is None:
        keep_thin = not mesh.watertight
    check_flag(who, "keep_thin", keep_thin)
    grid = VoxelGrid(resolution, lower, upper)
    depth, height, width = shape = tuple(grid.shape)  # type: ignore[arg-type]
    if max(shape) > LARGEST_RESOLUTION:
        raise OptionError(f"{who}: resolution must be at most {LARGEST_RESOLUTION} voxels a side; got {shape}")
    low, high = (np.array(bound, np.float64) for bound in (grid.lower, grid.upper))
    count = (width, height, depth)
    points = (mesh.vertices - low) / (high - low) * count - 0.5  # centres are at integers
    solid = np.zeros(count, bool)
    for faces, lines, signed in plan_voxels(mesh):
        if len(faces):
            solid |= _vote_inside(points[faces], count, lines, signed=signed)
    if keep_thin:
        solid = _add_thin(solid, cells_touched(points[mesh.faces], count))
    return torch.from_numpy(np.ascontiguousarray(solid.transpose(2, 1, 0)))


def plan_voxels(mesh: Mesh) -> tuple[Group, ...]:
    """Groups of faces (K, 3), the lines that vote on each, and whether by the winding number, else by parity.

    They are: closed parts, oriented outwards; closed parts without a consistent orientation, such as with edges of more
    than two faces; oriented parts with holes; other parts with holes.
    """
    faces = mesh.faces
    merged = merged_faces(mesh.vertices, faces)
    real = are_nondegenerate(merged)
    merged, faces = merged[real], faces[real]
    if len(faces) == 0:
        return ()
    parts = parts_of(merged)
    if parts.doubled.any():
        twice = parts.doubled[parts.part]
        kept = np.sort(np.concatenate((np.flatnonzero(~twice), np.flatnonzero(twice)[distinct_faces(merged[twice])])))
        merged, faces = merged[kept], faces[kept]
        parts = parts_of(merged)
    if (parts.closed & ~parts.oriented).any():
        reversed_ = (parts.closed & ~parts.oriented)[parts.part]
        reversed_[reversed_] = misoriented_faces(merged[reversed_])
        merged, faces = (np.where(reversed_[:, None], names[:, ::-1], names) for names in (merged, faces))
        parts = parts_of(merged)
    closed, oriented = parts.closed[parts.part], parts.oriented[parts.part]
    outward = _outward(mesh.vertices, faces, parts)
    return (
        (outward[closed & oriented], AXES, True),
        (faces[closed & ~oriented], AXES, False),
        (faces[~closed & oriented], LINES, True),
        (faces[~closed & ~oriented], LINES, False),
    )


def _outward(vertices: np.ndarray, faces: np.ndarray, parts: Parts) -> np.ndarray:
    """Faces with inside-out closed parts reversed, except those that are cavities of another part."""
    corners = vertices[faces]
    low = vertices.min(0)
    a, b, c = (corners[:, k] - low for k in range(3))
    volume = np.bincount(parts.part, weights=(a * np.cross(b, c)).sum(1))
    negative = np.flatnonzero(parts.closed & parts.oriented & (volume < 0))
    if len(negative) == 0:
        return faces
    solid = corners[(parts.closed & parts.oriented & (volume > 0))[parts.part]]
    reverse = np.zeros(len(volume), bool)
    for rank, part in enumerate(negative[np.argsort(volume[negative], kind="stable")]):
        own = np.unique(faces[parts.part == part])
        probes = vertices[own[np.linspace(0, len(own) - 1, 4).astype(int)]]
        reverse[part] = rank >= MOST_CAVITIES or not bool((winding_number(probes, solid) > 0.5).all())
    return np.where(reverse[parts.part][:, None], faces[:, ::-1], faces)


def winding_number(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The winding numbers (N,) of triangles (F, 3, 3) around points (N, 3): signed solid angle over 4 pi."""
    result = np.zeros(len(points))
    for index, point in enumerate(points):
        a, b, c = (triangles[:, k] - point for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        # Van Oosterom and Strackee (1983): tan(omega / 2) = det(a, b, c) / (...)
        above = (a * np.cross(b, c)).sum(1)
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        result[index] = np.arctan2(above, below).sum() / (2 * np.pi)
    return result


def _vote_inside(triangles: np.ndarray, count: Shape, lines: Sequence[Line], *, signed: bool) -> np.ndarray:
    """(W, H, D) bool: inside by the majority of the lines through a centre whose crossings balance."""
    votes = np.zeros(count, np.int8)
    for line in lines:
        change = crossing_counts(triangles, count, line, signed=signed)  # (length + 1, columns, rows)
        total = change.sum(0, dtype=np.int32)
        balanced = total == 0 if signed else total % 2 == 0
        running = np.zeros_like(total)
        slabs = np.moveaxis(votes, line.axis, 0)
        for step, window in _windows(count, line):
            running += change[step]
            passed = running[window]
            inside = passed != 0 if signed else passed % 2 != 0
            slabs[step] += np.where(balanced[window], np.where(inside, 1, -1), 0).astype(np.int8)
    return _majority(votes)


def _windows(count: Shape, line: Line) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """The lines through the centres of each slab: the shear shifts a window over the columns and rows."""
    lows = [line_extent(count, line, index)[0] for index in (0, 1)]
    columns, rows = (count[axis] for axis in line.others)
    for step in range(count[line.axis]):
        column, row = (-slope * step - low for slope, low in zip(line.slopes, lows, strict=True))
        yield step, (slice(column, column + columns), slice(row, row + rows))


def _majority(votes: np.ndarray) -> np.ndarray:
    """Votes > 0; a tie takes the majority of its decided neighbours, from the border inwards."""
    sign = np.pad(np.sign(votes), 1)
    flat = sign.reshape(-1)
    open_cells = np.flatnonzero(np.pad(votes == 0, 1))
    strides = [sign.shape[1] * sign.shape[2], sign.shape[2], 1]
    for _ in range(sum(votes.shape)):
        if len(open_cells) == 0:
            break
        near = sum(flat[open_cells + shift].astype(np.int8) for stride in strides for shift in (stride, -stride))
        changed = np.sign(near)
        if not changed.any():
            break
        flat[open_cells] = changed
        open_cells = open_cells[changed == 0]
    return sign[1:-1, 1:-1, 1:-1] > 0


def _add_thin(solid: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Add touched voxels whose surface no solid voxel represents.

    A solid voxel represents the surface in a voxel next to it along the axes of the surface's normals: behind a face,
    across an edge. The next voxel along a rod does not.
    """
    lost = np.zeros_like(solid)
    # A face that grazes a voxel may be found only in the next one.
    normals = touched
    for axis in range(3):
        normals = _dilate(normals, axis)
    normals = np.where(touched > 0, normals, 0)
    for axes in range(1, 8):
        near = solid
        for axis in range(3):
            near = _dilate(near, axis) if axes >> axis & 1 else near
        lost |= (normals == axes) & ~near
    if not lost.any():
        return solid
    # Where a rod meets a board, the board represents their common voxel: join them.
    beside_lost, beside_solid = (np.any([_dilate(cells, axis) for axis in range(3)], axis=0) for cells in (lost, solid))
    return solid | lost | ((touched > 0) & beside_lost & beside_solid)


def _dilate(cells: np.ndarray, axis: int) -> np.ndarray:
    """Cells combined (or) with their two neighbours along an axis."""
    result = cells.copy()
    there, here = (np.moveaxis(array, axis, 0) for array in (result, cells))
    there[1:] |= here[:-1]
    there[:-1] |= here[1:]
    return result
