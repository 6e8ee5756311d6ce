"""Photographs with known cameras and no depth: our sweep against triangulated features, and against sparse points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.classical_baselines import Found, luminance, winners
from benchmarks.classical_rows import Row
from benchmarks.triangulated import Depths, find_features, triangulate
from lsmgeo import data
from lsmgeo.classical import Reconstruction, reconstruct_scene

SETS = {"fountain": "strecha_fountain_quarter", "temple": "middlebury_temple", "COLMAP scene": "colmap_scene"}
DENSITY, MOST_ERROR = 0.4, 0.005
# So many views next to each other are swept, and agreement is asked of these alone; features are matched among more.
VIEWS, VIEWS_MATCHED = 3, 8
# Longer side of the depth maps, pixels.
SIZE = 480


def triangulated_of(scene: data.PosedImages, views: list[int], among: list[int] | None = None) -> list[Depths]:
    """The depths of views' features, in the photographs' own size, from matches among some views or all."""
    among = list(range(len(scene))) if among is None else among
    pictures = (np.rint(255 * luminance(scene.load(view))).astype(np.uint8) for view in among)
    features = [find_features(picture) for picture in pictures]
    K, E = (value[among].double().numpy() for value in scene.cameras[:2])
    return [triangulate(features, K, E, among.index(view)) for view in views]


def sparse_of(scene: data.PosedImages, view: int) -> Depths | None:
    """The depths of the set's own sparse points that a view observes."""
    if scene.points is None:
        return None
    seen = scene.points.observations[view]
    E = scene.cameras.cam_from_world[view].double().numpy()
    return Depths(seen.pixels, scene.points.positions[seen.points] @ E[2, :3] + E[2, 3])


def errors_at(one: Reconstruction, truth: Depths, full: tuple[int, int], density: float) -> np.ndarray:
    """Relative depth errors at the places that lie among the pixels that the method trusts most."""
    depth = one.depth_map.depth.double().numpy()
    mask = winners(Found(np.where(depth > 0, depth, np.nan), one.depth_map.confidence.numpy()), density)
    height, width = depth.shape
    x, y = np.floor((truth.pixels + 0.5) * (width / full[1], height / full[0])).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y, true = x[inside], y[inside], truth.depth[inside]
    return (np.abs(depth[y, x] - true) / true)[mask[y, x]]


def rows(root: Path | None) -> list[Row]:
    """Errors pooled over the views that are judged."""
    return [] if root is None else measure(root)[0]


def measure(root: Path, size: int = SIZE, names: tuple[str, ...] = tuple(SETS)) -> tuple[list[Row], dict[str, Any]]:
    """The rows, and every view's figures."""
    table: list[Row] = []
    figures: dict[str, Any] = {}
    for name in names:
        scene = data.open(root / SETS[name])
        views = list(range(min(VIEWS, len(scene))))
        judged = reconstruct_scene(scene, views, size=size, mesh=False, density=1.0, progress=True).views
        truths = {"triangulated features": triangulated_of(scene, views, list(range(min(VIEWS_MATCHED, len(scene)))))}
        if scene.points is not None:
            truths["the set's sparse points"] = [sparse_of(scene, view) for view in views]  # type: ignore[misc]
        for kind, depths in truths.items():
            errors = [
                errors_at(one, truth, scene.size(one.view), DENSITY) for one, truth in zip(judged, depths, strict=True)
            ]
            pooled = np.concatenate(errors)
            median = float(np.median(pooled))
            table.append(
                Row(
                    name,
                    f"median depth error at {100 * DENSITY:.0f} % density against {len(pooled)} {kind} in "
                    f"{len(views)} views",
                    f"{100 * median:.2f} %, 90 % below {100 * float(np.quantile(pooled, 0.9)):.1f} %",
                    f"at most {100 * MOST_ERROR} %",
                    median <= MOST_ERROR,
                )
            )
            figures.setdefault(name, {})[kind] = [float(np.median(one)) for one in errors]
    return table, {"median_errors": figures}
