"""How true surfaces fused from exact depth are: ``python -m benchmarks.classical --only tsdf``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.classical_rows import Row
from lsmgeo import VoxelGrid, scenes
from lsmgeo.cameras import CameraTensors, orbit, select
from lsmgeo.classical import SurfaceMesh, extract_mesh, fuse_depth

__all__ = ["rows"]

VIEWS, SIZE, RESOLUTION = 20, 224, 64
# Points along the side of a triangle at which a mesh is sampled, and points of the true surface.
STEPS, SAMPLES = 5, 200_000
RADII = np.array([0.42, 0.25, 0.33])
HALF = np.array([0.28, 0.2, 0.33])
# Turned about two axes, so that no face lies along the grid.
TURN = np.array([[0.8, -0.36, 0.48], [0.6, 0.48, -0.64], [0.0, 0.8, 0.6]])

Array = np.ndarray


class Case(NamedTuple):
    """A solid, the distance of points to its surface, points on it, and the share to be within half a voxel."""

    name: str
    solid: scenes.Solid
    distance: Callable[[Array], Array]
    surface: Array
    share: float


def all_round(views: int = VIEWS, size: int = SIZE) -> CameraTensors:
    """Cameras evenly spread over a sphere about the origin (the golden spiral), at distance 2; leading shape (1, V)."""
    turn = np.arange(views) + 0.5
    azimuth = np.degrees(np.pi * (3 - np.sqrt(5)) * turn)
    elevation = np.degrees(np.arcsin(1 - 2 * turn / views))
    around, up = torch.from_numpy(azimuth)[None], torch.from_numpy(elevation)[None]
    return orbit(around, up, 2.0, focal_length=1.875 * size, height=size, width=size)


def to_ellipsoid(points: Array, radii: Array) -> Array:
    """Distance to an ellipsoid about the origin: the root t of ``sum (a p / (a^2 + t))^2 = 1`` by bisection."""
    p = np.abs(points)
    low, high = np.full(len(p), -(radii.min() ** 2)), radii.max() * np.linalg.norm(p, axis=1) + 1e-9
    for _ in range(60):
        middle = (low + high) / 2
        outside = ((radii * p / (radii**2 + middle[:, None])) ** 2).sum(1) > 1
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    foot = radii**2 * p / (radii**2 + high[:, None])
    return np.asarray(np.linalg.norm(p - foot, axis=1))


def to_box(points: Array, half: Array) -> Array:
    """Distance to the surface of a box about the origin."""
    beyond = np.abs(points) - half
    outside, inside = np.linalg.norm(np.maximum(beyond, 0), axis=1), np.minimum(beyond.max(1), 0)
    return np.abs(outside + inside)


def on_box(half: Array, count: int, generator: np.random.Generator) -> Array:
    """Points on the surface of a box, evenly."""
    areas = np.prod(half) / half
    axis = generator.choice(3, count, p=areas / areas.sum())
    points = generator.uniform(-1, 1, (count, 3)) * half
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis]) * half[axis]
    return points


def cases() -> list[Case]:
    generator = np.random.default_rng(6)
    globe = generator.normal(size=(SAMPLES, 3))
    globe /= np.linalg.norm(globe, axis=1, keepdims=True)
    on_sides = on_box(HALF, SAMPLES, generator)
    box = scenes.box((0, 0, 0), tuple(2 * HALF))
    turn = np.c_[TURN, np.zeros(3)]
    return [
        Case(
            "sphere",
            scenes.sphere((0, 0, 0), 0.4),
            lambda points: np.abs(np.linalg.norm(points, axis=1) - 0.4),
            0.4 * globe,
            0.99,
        ),
        Case(
            "ellipsoid",
            scenes.ellipsoid((0, 0, 0), tuple(RADII)).transformed(turn),
            lambda points: to_ellipsoid(points @ TURN, RADII),
            (globe * RADII) @ TURN.T,
            0.99,
        ),
        Case("box along the grid", box, lambda points: to_box(points, HALF), on_sides, 0.95),
        Case("box, turned", box.transformed(turn), lambda points: to_box(points @ TURN, HALF), on_sides @ TURN.T, 0.95),
    ]


def reconstruct(solid: scenes.Solid, grid: VoxelGrid) -> SurfaceMesh:
    """The mesh fused from exact depth."""
    cameras = all_round()
    lights = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.8), torch.full((3,), 0.2))
    pictures = scenes.render([scenes.Scene([solid])], cameras, lights)
    fused = fuse_depth(pictures.depth[0], select(cameras, 0, 0), grid, colours=pictures.images[0])
    return extract_mesh(fused, grid)


def sampled(mesh: SurfaceMesh) -> Array:
    """Points of all triangles, on a lattice of each."""
    shares = np.array([(i, j, STEPS - i - j) for i in range(STEPS + 1) for j in range(STEPS + 1 - i)]) / STEPS
    corners = mesh.vertices.astype(np.float64)[mesh.faces]  # (M, 3, 3)
    return np.einsum("sk,mkc->msc", shares, corners).reshape(-1, 3)


def is_closed(mesh: SurfaceMesh) -> bool:
    """Whether every edge belongs to two triangles, which run along it in opposite directions."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    count = len(mesh.vertices)
    forth, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    return len(np.unique(forth)) == len(forth) and np.array_equal(np.sort(forth), np.sort(back))


def rows(root: Path | None = None) -> list[Row]:
    """The lines of the table; needs no data."""
    from scipy.spatial import cKDTree

    del root
    found = []
    side = 1 / RESOLUTION
    for case in cases():
        mesh = reconstruct(case.solid, VoxelGrid(RESOLUTION))
        points = sampled(mesh)
        accuracy = case.distance(points) / side
        # Of points of the true surface, to the nearest of the mesh's points: a little more than to the mesh.
        completeness = cKDTree(points).query(case.surface)[0] / side
        for name, errors in (("mesh to solid", accuracy), ("solid to mesh", completeness)):
            share, most = float((errors <= 0.5).mean()), float(errors.max())
            found.append(
                Row(
                    "TSDF, exact depth",
                    f"{case.name}, {RESOLUTION}^3, {VIEWS} views of {SIZE} x {SIZE}: {name}",
                    f"{100 * share:.2f} % within half a voxel, median {np.median(errors):.3f}, most {most:.2f} voxels",
                    f">= {100 * case.share:.0f} % within half a voxel"
                    + (", all within 1" if case.share > 0.95 else ""),
                    share >= case.share and (most <= 1 or case.share <= 0.95),
                )
            )
        closed = is_closed(mesh)
        what = f"{case.name}: closed, {len(mesh.faces)} faces"
        found.append(Row("TSDF, exact depth", what, "yes" if closed else "no", "yes", closed))
    return found
