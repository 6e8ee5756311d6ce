"""Voxels compared with the mesh they were made from: placement, order and direction of the axes."""

from __future__ import annotations

from itertools import permutations, product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.data.formats.format_binvox import PATTERN, is_binvox, read_binvox
from lsmgeo.data.meshes import load_mesh
from lsmgeo.data.read_files import plain_files
from lsmgeo.diagnosis.findings import Cause, Check, Findings, Gap
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from lsmgeo.data.meshes import Mesh
    from lsmgeo.data.posed_images import Voxels

__all__ = ["examine_voxels"]

SUFFIXES = (".obj", ".ply", ".off", ".stl", ".glb", ".gltf")
USUAL_STEMS = ("model", "model_normalized")
# Points on the surface; a surface in a 128^3 grid passes through some tens of thousands of voxels.
SAMPLES = 100_000
SEED = 0
# With rounding, points on the faces of the grid's box may be outside it.
TOLERANCE = 1e-4
INSIDE = 0.98
# Carving leaves a few inner walls without a surface.
AT_SURFACE = 0.8
# An alternative must fit better by this much.
CLEARLY = 0.02


class _PlacedVoxels(NamedTuple):
    """Occupancy in x, y, z, in an axis-aligned box."""

    occupied: np.ndarray  # (W, H, D) bool
    lower: np.ndarray
    upper: np.ndarray


def examine_voxels(voxels: Voxels, path: str | Path) -> Findings:
    """Compare voxels with the mesh beside them.

    Every point of the surface is in an occupied voxel, and the outermost occupied voxels are at the surface. If not,
    the other placement of binvox files and all orders and directions of the axes are tried.

    Args:
        voxels: as a reader returned them.
        path: their file, or its folder; the mesh beside it has the same name, else ``model.*``, else is the only one.

    Returns:
        The findings; "unknown" without a mesh.
    """
    path = Path(path)
    placed = _place(voxels)
    facts = _facts(placed)
    try:
        mesh_file = _find_mesh(path)
        mesh = None if mesh_file is None else load_mesh(mesh_file)
    except DataError as error:
        gap = Gap(f"the mesh beside the voxels cannot be read: {error}", "Repair that file, or replace it.")
        return Findings(facts, (), None, (), "voxels", gap)
    if mesh is None or mesh_file is None:
        remark = "voxels of 3D-R2N2 are centred on the origin whatever their header says (placement='centred')"
        gap = Gap(
            "there is no mesh beside the voxels, so their placement cannot be checked",
            "Put the mesh they were made from beside them as model.obj (or .ply, .off, .stl, .glb).",
        )
        return Findings(facts, (), None, (remark,) if _is_binvox_file(path) else (), "voxels", gap)
    samples = _surface_samples(mesh)
    facts += (("mesh", f"{mesh_file.name}, {len(mesh.faces):,} faces"), ("box of the mesh", _box(*mesh.bounds)))
    checks = _checks(placed, samples)
    return Findings(facts, checks, _cause(placed, samples, path, checks[0].value), kind="voxels")


def _place(voxels: Voxels) -> _PlacedVoxels:
    T = voxels.world_from_lattice
    occupied = voxels.occupancy.numpy().transpose(2, 1, 0)
    step = T[:3, :3].diagonal()
    lower = T[:3, 3] - 0.5 * step
    return _PlacedVoxels(occupied, lower, lower + step * occupied.shape)


def _facts(placed: _PlacedVoxels) -> tuple[tuple[str, str], ...]:
    count, shape = int(placed.occupied.sum()), placed.occupied.shape
    facts = [
        ("voxels", f"{shape[0]} x {shape[1]} x {shape[2]} (x, y, z)"),
        ("occupied", f"{count:,} ({100 * count / placed.occupied.size:.2f} %)"),
        ("box of the grid", _box(placed.lower, placed.upper)),
    ]
    if count:
        index = np.argwhere(placed.occupied)
        step = (placed.upper - placed.lower) / shape
        box = _box(placed.lower + index.min(0) * step, placed.lower + (index.max(0) + 1) * step)
        facts.append(("box of the occupied voxels", box))
    return tuple(facts)


def _box(lower: np.ndarray, upper: np.ndarray) -> str:
    return ", ".join(f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", lower, upper, strict=True))


def _is_binvox_file(path: Path) -> bool:
    try:
        return is_binvox(path)
    except OSError:
        return False


def _find_mesh(path: Path) -> Path | None:
    try:
        folder = path if path.is_dir() else path.parent
        voxel_files = plain_files(path, PATTERN) if path.is_dir() else [path]
        meshes = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})") from error
    for stem in (*(file.stem for file in voxel_files), *USUAL_STEMS):
        found = next((file for file in meshes if file.stem == stem), None)
        if found is not None:
            return found
    return meshes[0] if len(meshes) == 1 else None


def _surface_samples(mesh: Mesh) -> np.ndarray:
    """(SAMPLES, 3) points, equally dense on all faces, with a fixed seed."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(SEED)
    chosen = rng.choice(len(areas), SAMPLES, p=areas / areas.sum())
    u, v = rng.random((2, SAMPLES, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def _voxels_of(placed: _PlacedVoxels, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) the voxel of each sample, and whether there is one."""
    place = (samples - placed.lower) / (placed.upper - placed.lower)
    within = ((place >= -TOLERANCE) & (place <= 1 + TOLERANCE)).all(1)
    shape = np.array(placed.occupied.shape)
    return np.clip(np.floor(np.clip(place, 0, 1) * shape), 0, shape - 1).astype(int), within


def _inside(placed: _PlacedVoxels, samples: np.ndarray) -> float:
    index, within = _voxels_of(placed, samples)
    return float((placed.occupied[tuple(index.T)] & within).mean())


def _checks(placed: _PlacedVoxels, samples: np.ndarray) -> tuple[Check, ...]:
    from scipy.ndimage import binary_dilation, binary_erosion

    index, within = _voxels_of(placed, samples)
    surface = np.zeros_like(placed.occupied)
    surface[tuple(index[within].T)] = True
    outermost = placed.occupied & ~binary_erosion(placed.occupied)
    at_surface = outermost & binary_dilation(surface, np.ones((3, 3, 3), bool))
    count = int(outermost.sum())
    fraction = float(at_surface.sum() / count) if count else 0.0
    inside = _inside(placed, samples)
    return (
        Check("surface of the mesh in occupied voxels", 100 * inside, "%", 100 * INSIDE, SAMPLES, "points", True),
        Check("outermost voxels at the surface", 100 * fraction, "%", 100 * AT_SURFACE, count, "voxels", True),
    )


def _cause(placed: _PlacedVoxels, samples: np.ndarray, path: Path, percent: float) -> Cause | None:
    """The placement, and the order and direction of the axes, with which the surface is in occupied voxels."""
    if percent >= 100 * INSIDE or not placed.occupied.any():
        return None
    # The fewest changes first: symmetric objects fit several.
    for name, other in _placements(placed, path):
        for changes, words, occupied in sorted(_axis_permutations(other.occupied), key=lambda order: order[0]):
            fits = 100 * _inside(other._replace(occupied=occupied), samples)
            if fits < 100 * INSIDE or fits < percent + 100 * CLEARLY:
                continue
            title, read = "axes of the voxels exchanged or flipped", f"Read the file with placement={name!r}"
            remedy = f"{read} and permute its axes: {words}." if name else f"Permute the axes of the grid: {words}."
            if changes == 0:
                title, remedy = "voxels placed otherwise", f"{read}."
            evidence = f"with the correction, the surface in occupied voxels rises from {percent:.1f} % to {fits:.1f} %"
            return Cause(title, evidence, remedy)
    return None


def _placements(placed: _PlacedVoxels, path: Path) -> list[tuple[str, _PlacedVoxels]]:
    """The placement that was read, without a name, and the other placements of binvox files."""
    found = [("", placed)]
    if _is_binvox_file(path):
        for placement in ("header", "centred"):
            other = _place(read_binvox(path, placement=placement))
            if np.abs(other.lower - placed.lower).max() > 1e-9 * np.abs(placed.upper - placed.lower).max():
                found.append((placement, other))
    return found


def _axis_permutations(occupied: np.ndarray) -> list[tuple[int, str, np.ndarray]]:
    """The grid with its axes in each order and direction: the number of changes, their words, and the array."""
    found = []
    for axes in permutations(range(3)):
        for flips in product((False, True), repeat=3):
            array = occupied.transpose(axes)
            array = np.flip(array, tuple(axis for axis in range(3) if flips[axis]))
            moved = sum(axis != place for place, axis in enumerate(axes))
            words = ", ".join(f"{'xyz'[k]} is {'minus ' if flips[k] else ''}{'xyz'[axes[k]]}" for k in range(3))
            found.append((moved + sum(flips), words, array))
    return found
