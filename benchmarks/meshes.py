"""Meshes: how right their voxels are, and what reading, rendering and voxelising cost: ``python -m benchmarks.meshes``.

Solids with exact occupancy are damaged in several ways and turned into voxels by each method. With the folder of
coloured meshes that ``LSMGEO_TEST_DATA`` names, so are the watertight ones of them, against their own winding number,
and every mesh is read, rendered and turned into voxels. Times are processor time, one thread.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import timing
from lsmgeo import cameras, data, scenes
from lsmgeo.data.voxelise import plan_voxels

RESOLUTION = 32
SIZE, VIEWS = 224, 4
METHODS = ("auto", "winding", "parity", "escape", "surface")
Inside = Callable[[np.ndarray], np.ndarray]


def centres(count: int) -> np.ndarray:
    """(D, H, W, 3) x, y, z."""
    line = (np.arange(count) + 0.5) / count - 0.5
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)[..., ::-1]


def in_boxes(points: np.ndarray, boxes: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """In any of the boxes (centre, half size)."""
    return np.any([(np.abs(points - centre) < half).all(-1) for centre, half in boxes], axis=0)


def solids() -> Iterator[tuple[str, Any, np.ndarray]]:
    """Name, watertight mesh, exact occupancy, which is known without the mesh but for the sphere's."""
    import trimesh

    points = centres(RESOLUTION)
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.45)
    yield "sphere", ball, ball.contains(points.reshape(-1, 3)).reshape(points.shape[:3])

    boxes = [(rng.uniform(-0.2, 0.2, 3), rng.uniform(0.08, 0.25, 3)) for _ in range(6)]
    parts = [trimesh.creation.box(bounds=(centre - half, centre + half)) for centre, half in boxes]
    yield "union of 6 boxes", trimesh.boolean.union(parts), in_boxes(points, boxes)
    yield "6 overlapping boxes", trimesh.util.concatenate(parts), in_boxes(points, boxes)

    outer, inner = (np.zeros(3), np.array([0.31, 0.43, 0.37])), (np.array([0, 0.12, 0]), np.array([0.23, 0.41, 0.29]))
    cup = [trimesh.creation.box(bounds=(centre - half, centre + half)) for centre, half in (outer, inner)]
    yield "square cup", trimesh.boolean.difference(cup), in_boxes(points, [outer]) & ~in_boxes(points, [inner])

    angles = np.arange(7) * (2 * np.pi / 7)
    normals = np.stack([np.cos(angles), np.sin(angles)], 1)
    prism = trimesh.creation.cylinder(0.4 / np.cos(np.pi / 7), 0.7, sections=7)
    sides = np.roll(prism.vertices[:, :2], 1, 0)
    turn = np.arctan2(*sides[np.argmax(np.linalg.norm(sides, axis=1))][::-1]) + np.pi / 7
    spun = normals @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    inside = (points[..., :2] @ spun.T < 0.4).all(-1) & (np.abs(points[..., 2]) < 0.35)
    yield "prism of 7 sides", prism, inside


def fine(mesh: Any) -> Any:
    """The same surface in small triangles, so that one that is missing is a small hole."""
    return mesh.subdivide_to_size(0.06, max_iter=12)


def damaged(vertices: np.ndarray, faces: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Name and faces."""
    yield "whole", faces
    for seed in range(3):
        yield f"5 % missing, seed {seed}", faces[np.random.default_rng(seed).random(len(faces)) >= 0.05]
    yield "20 % missing", faces[np.random.default_rng(3).random(len(faces)) >= 0.2]
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    down = normal[:, 1] < -0.99 * np.linalg.norm(normal, axis=1)
    if 0 < down.sum() < len(faces):
        yield "no floor", faces[~down]
    turned = faces.copy()
    some = np.random.default_rng(4).random(len(faces)) < 0.5
    turned[some] = turned[some, ::-1]
    yield "random winding", turned
    yield "drawn from both sides", np.concatenate((faces, faces[:, ::-1]))


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union."""
    either = int((first | second).sum())
    return 1.0 if either == 0 else int((first & second).sum()) / either


def score(name: str, vertices: np.ndarray, faces: np.ndarray, exact: np.ndarray) -> Iterator[dict[str, Any]]:
    for damage, some in damaged(vertices, faces):
        mesh = data.Mesh(vertices, some)
        case: dict[str, Any] = {"solid": name, "damage": damage}
        for method in METHODS:
            # Without what "auto" adds of parts thinner than a voxel, which is not solid-by-centre.
            case[method] = overlap(data.voxelise(mesh, RESOLUTION, method=method, keep_thin=False).numpy(), exact)
        yield case


def accuracy(folder: Path | None) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """IoU of each method on each solid, and on the watertight meshes the means over them."""
    table = []
    for name, mesh, exact in solids():
        small = fine(mesh)
        table += score(name, np.array(small.vertices, float), np.array(small.faces), exact)
    if folder is None:
        return table, []
    every: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("*.ply")):
        mesh = data.normalise(data.load_mesh(path))
        exact = data.voxelise(mesh, RESOLUTION, method="auto", keep_thin=False).numpy()
        if mesh.watertight and exact.sum() >= 200:  # of fewer cells an IoU says little
            for case in score(path.stem, mesh.vertices, mesh.faces, exact):
                every.setdefault(case["damage"], []).append(case)
    means = []
    for damage, cases in every.items():
        mean = {method: statistics.mean(case[method] for case in cases) for method in METHODS}
        means.append({"solid": f"mean of {len(cases)} meshes", "damage": damage, **mean})
        worst = {method: min(case[method] for case in cases) for method in METHODS}
        means.append({"solid": f"worst of {len(cases)} meshes", "damage": damage, **worst})
    return table, means


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds of processor time, and the result."""
    begin = time.process_time()
    result = run()
    return 1e3 * (time.process_time() - begin), result


def every_mesh(folder: Path) -> list[dict[str, Any]]:
    azimuths, elevations = torch.arange(VIEWS) * 90.0 + 30.0, torch.linspace(-20, 30, VIEWS)
    views = cameras.orbit(azimuths, elevations, 2.0, focal_length=1.875 * SIZE, height=SIZE, width=SIZE)
    one = cameras.CameraTensors(*(field[:1] for field in views))
    sun = scenes.Lights(torch.tensor([[0.48, 0.8, 0.36]]), torch.full((1, 3), 0.7), torch.full((3,), 0.3))
    rows = []
    for path in sorted(folder.glob("*.ply")):
        reading, mesh = timed(lambda path=path: data.load_mesh(path))
        mesh = data.normalise(mesh)
        first, _ = timed(lambda mesh=mesh: data.render_mesh(mesh, one, sun))
        whole, picture = timed(lambda mesh=mesh: data.render_mesh(mesh, views, sun))
        voxels32, solid = timed(lambda mesh=mesh: data.voxelise(mesh, 32))
        voxels64, _ = timed(lambda mesh=mesh: data.voxelise(mesh, 64))
        strict = data.voxelise(mesh, 32, keep_thin=False)
        seen = picture.depth[picture.mask]
        plan = plan_voxels(mesh)
        rows.append({
            "mesh": path.stem,
            "faces": len(mesh.faces),
            "watertight": mesh.watertight,
            **{f"faces_{name}": len(group) for name, group in zip(plan._fields, plan, strict=True)},
            "solid_by_centre": int(strict.sum()),
            "voxels": int(solid.sum()),
            "seen_least": float(picture.mask.float().mean((1, 2)).min()),
            "nearest": float(seen.min()),
            "farthest": float(seen.max()),
            "finite": bool(picture.images.isfinite().all() and picture.normals.isfinite().all()),
            "load_ms": reading,
            "render_first_ms": first,
            "render_view_ms": max(0.0, (whole - first) / (VIEWS - 1)),
            "voxels32_ms": voxels32,
            "voxels64_ms": voxels64,
        })  # fmt: skip
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    argparse.ArgumentParser(description=__doc__).parse_args(argv)
    torch.set_num_threads(1)
    where = timing.machine("cpu")
    root = os.environ.get("LSMGEO_TEST_DATA")
    folder = Path(root) / "meshes_cc0" if root else None
    folder = folder if folder is not None and folder.is_dir() else None
    solid, means = accuracy(folder)
    timing.table(solid + means, {"solid": "", "damage": "", **dict.fromkeys(METHODS, ".4f")})
    rows = every_mesh(folder) if folder else []
    columns = ("load_ms", "render_first_ms", "render_view_ms", "voxels32_ms", "voxels64_ms")
    timing.table(rows, {"mesh": "", "faces": "", "solid_by_centre": "", "voxels": "", **dict.fromkeys(columns, ".1f")})
    medians = {name: statistics.median(row[name] for row in rows) for name in columns} if rows else {}
    print(medians)
    print(timing.save("meshes", where, solid + means, meshes=rows, medians=medians))


if __name__ == "__main__":
    main()
