"""Classical reconstruction of closed-form scenes: depth, hulls and fused surfaces."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.classical_rivals import row
from lsmgeo import VoxelGrid, scenes
from lsmgeo.cameras import orbit, select, stack
from lsmgeo.classical import extract_mesh, fuse_depth, visual_hull
from lsmgeo.metrics import VoxelIoU
from lsmgeo.scenes import synthetic13
from tests.classical import analytic as traced
from tests.classical.scored import median_error, swept, to_box, to_ellipsoid, within_one_plane
from tests.classical.seen import is_closed

Rows = list[dict[str, Any]]


def analytic() -> Rows:
    """Depth of textured surfaces by plane sweep.

    The images are traced by `tests.classical.analytic`, which shares no code with the library: 96 x 72 pixels, four
    views, 64 planes even in inverse depth, 5 x 5 correlation; pixels nearer than three to the surface's end are left
    out. The worse of two textures counts.
    """
    rows = []
    for surface in (*traced.SURFACES, "corner"):
        measured = []
        for seed in (0, 1):
            rendered = traced.render(surface, seed=seed)
            depths, found = swept(rendered)
            share = 100 * within_one_plane(rendered, depths, found)
            measured.append((share, -median_error(rendered, found.depth.numpy())))
        within, median = (min(values) for values in zip(*measured, strict=True))
        least = 98.0 if surface == "box" else 99.5
        # All faces of a corner are steep: windows parallel to the image are on none of them.
        goals = ("", "") if surface == "corner" else (f"at least {least:g} %", "at most 1e-03")
        name = f"analytic {surface}"
        rows.append(row(name, "pixels within one of 64 planes", f"{within:.2f} %", goals[0], within >= least))
        rows.append(row(name, "median relative error, refined", f"{-median:.1e}", goals[1], -median <= 1e-3))
    for surface in ("slanted", "sphere"):
        rendered, medians = traced.render(surface), []
        for planes in (16, 32, 64):
            depths, found = swept(rendered, planes)
            medians.append(median_error(rendered, depths[found.planes.round().numpy().clip(0).astype(int)]))
        ratios = [first / second for first, second in pairwise(medians)]
        what, text = (
            "unrefined error of 16 over 32, 32 over 64 planes",
            " and ".join(f"{ratio:.2f}" for ratio in ratios),
        )
        rows.append(row(f"analytic {surface}", what, text, "1.7 to 2.3", all(1.7 <= ratio <= 2.3 for ratio in ratios)))
    return rows


# Mean IoU of the thirteen categories with 1 to 4 views; Kar, Haene and Malik 2017, table 1.
PAPER = (18.0, 36.9, 47.0, 52.4)


def hull(shapes: int = 10) -> Rows:
    """Hulls of synthetic shapes from 1 to 4 views of the paper's cameras, 32^3 over the cube, by both rules."""
    grid = VoxelGrid(32)
    dark = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
    rules = {"mean above 0.75": "mean", "strict intersection": "all"}
    scores = {(name, views): VoxelIoU() for name in rules for views in range(1, 5)}
    for index in range(13 * shapes):
        shape = synthetic13.shape(0, index)
        cameras = synthetic13.views(0, index, 4, 224)
        masks = scenes.render([shape.scene], stack([cameras]), dark).mask[0]
        true = scenes.voxels([shape.scene], grid)
        for (name, views), score in scores.items():
            some = stack([select(cameras, 0, view) for view in range(views)])
            found = visual_hull(masks[:views], some, grid, rule=rules[name])
            score.update(found.occupancy[None].float(), true, [shape.category])

    def listed(values: Any) -> str:
        return ", ".join(f"{value:.1f}" for value in values)

    rows, section = [], f"Visual hull, synthetic-13, {shapes} shapes a category, 32^3"
    for name in rules:
        values = [100 * float(scores[name, views].compute().mean) for views in range(1, 5)]
        gains = np.diff(values)
        what = f"{name}: mean IoU of the categories with 1, 2, 3, 4 views (the paper, on ShapeNet: {listed(PAPER)})"
        measured = f"{listed(values)}; gains {listed(gains)} (paper {listed(np.diff(PAPER))})"
        goal = "rises, ever less" if name.startswith("mean") else ""
        rows.append(row(section, what, measured, goal, (gains > 0).all() and (np.diff(gains) < 0).all()))
    return rows


VIEWS, SIZE, RESOLUTION = 20, 224, 64
STEPS, SAMPLES = 5, 200_000  # points along the side of a triangle at which a mesh is sampled, and of the true surface
RADII, HALF = np.array([0.42, 0.25, 0.33]), np.array([0.28, 0.2, 0.33])
# Rotated about two axes, so that no face is parallel to the grid.
R = np.array([[0.8, -0.36, 0.48], [0.6, 0.48, -0.64], [0.0, 0.8, 0.6]])


def solids() -> list[tuple[str, scenes.Solid, Callable[[np.ndarray], np.ndarray], np.ndarray, float]]:
    """Name, solid, distance of points to its surface, points on it, goal for the fraction within half a voxel."""
    generator = np.random.default_rng(6)
    globe = generator.normal(size=(SAMPLES, 3))
    globe /= np.linalg.norm(globe, axis=1, keepdims=True)
    areas = np.prod(HALF) / HALF
    rows, axis = np.arange(SAMPLES), generator.choice(3, SAMPLES, p=areas / areas.sum())
    sides = generator.uniform(-1, 1, (SAMPLES, 3)) * HALF
    sides[rows, axis] = np.sign(sides[rows, axis]) * HALF[axis]
    ball, egg = scenes.sphere((0, 0, 0), 0.4), scenes.ellipsoid((0, 0, 0), tuple(RADII))
    box, rotation = scenes.box((0, 0, 0), tuple(2 * HALF)), np.c_[R, np.zeros(3)]
    return [
        ("sphere", ball, lambda points: np.linalg.norm(points, axis=1) - 0.4, 0.4 * globe, 0.99),
        ("ellipsoid", egg.transformed(rotation), lambda p: to_ellipsoid(p @ R, RADII), (globe * RADII) @ R.T, 0.99),
        ("box along the grid", box, lambda points: to_box(points, HALF), sides, 0.95),
        ("box, turned", box.transformed(rotation), lambda points: to_box(points @ R, HALF), sides @ R.T, 0.95),
    ]


def tsdf() -> Rows:
    """Errors of surfaces fused from exact depth, for cameras evenly distributed on a sphere (the golden spiral)."""
    place = torch.arange(VIEWS, dtype=torch.float64)[None] + 0.5
    azimuth, elevation = torch.rad2deg(np.pi * (3 - 5**0.5) * place), torch.rad2deg(torch.asin(1 - 2 * place / VIEWS))
    cameras = orbit(azimuth, elevation, 2.0, focal_length=1.875 * SIZE, height=SIZE, width=SIZE)
    lights = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.8), torch.full((3,), 0.2))
    shares = np.array([(i, j, STEPS - i - j) for i in range(STEPS + 1) for j in range(STEPS + 1 - i)]) / STEPS
    rows, grid, section = [], VoxelGrid(RESOLUTION), "TSDF, exact depth"
    for name, solid, distance, surface, least in solids():
        rendered = scenes.render([scenes.Scene([solid])], cameras, lights)
        mesh = extract_mesh(fuse_depth(rendered.depth[0], select(cameras, 0, 0), grid), grid)
        points = np.einsum("sk,mkc->msc", shares, mesh.vertices.astype(np.float64)[mesh.faces]).reshape(-1, 3)
        # From points of the true surface to the nearest sample of the mesh: slightly more than to the mesh.
        away = {"mesh to solid": np.abs(distance(points)), "solid to mesh": cKDTree(points).query(surface)[0]}
        for kind, lengths in away.items():
            voxels = lengths * RESOLUTION
            share, median, most = (voxels <= 0.5).mean(), np.median(voxels), voxels.max()
            what = f"{name}, {RESOLUTION}^3, {VIEWS} views of {SIZE} x {SIZE}: {kind}"
            measured = f"{100 * share:.2f} % within half a voxel, median {median:.3f}, most {most:.2f} voxels"
            goal = f">= {100 * least:.0f} % within half a voxel" + (", all within 1" if least > 0.95 else "")
            rows.append(row(section, what, measured, goal, share >= least and (most <= 1 or least <= 0.95)))
        closed = is_closed(mesh.faces)
        rows.append(row(section, f"{name}: closed, {len(mesh.faces)} faces", "yes" if closed else "no", "yes", closed))
    return rows
