"""Sparse points under cameras: how far from their observations they project."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.diagnosis.geometry import Geometry, project

if TYPE_CHECKING:
    from lsmgeo.data import SparsePoints

__all__ = ["reprojection_errors", "reprojections", "view_costs"]

FARTHEST = 1e9


def reprojections(points: SparsePoints, geometry: Geometry, view: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Projection minus observation (M, 2) px and depth (M,) of what one view observes, through one of the cameras."""
    observed = points.observations[view]
    pixels, depth = project(geometry, camera, points.positions[observed.points])
    return np.nan_to_num(pixels - observed.pixels, nan=FARTHEST, posinf=FARTHEST, neginf=-FARTHEST), depth


def reprojection_errors(points: SparsePoints, geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (M,) px, depths (M,), and the view (M,) of every observation."""
    errors, depths, views = [np.zeros(0)], [np.zeros(0)], [np.zeros(0, int)]
    for view, observed in enumerate(points.observations):
        difference, depth = reprojections(points, geometry, view, view)
        errors.append(np.linalg.norm(difference, axis=1))
        depths.append(depth)
        views.append(np.full(len(observed.points), view))
    return np.concatenate(errors), np.concatenate(depths), np.concatenate(views)


def view_costs(points: SparsePoints, geometry: Geometry) -> np.ndarray:
    """Median distance of each view's observations through each camera, (V, V) px; NaN for a view that observes none."""
    count = len(points.observations)
    costs = np.full((count, count), np.nan)
    for view in range(count):
        if len(points.observations[view].points):
            for camera in range(count):
                difference, depth = reprojections(points, geometry, view, camera)
                distance = np.where(depth > 0, np.linalg.norm(difference, axis=1), FARTHEST)
                costs[view, camera] = np.median(distance)
    return costs
