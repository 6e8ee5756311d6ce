"""How far depth maps and surfaces are from the truth in closed form; the benchmarks print it, the tests bound it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import DepthMap, sweep, sweep_planes
from tests.classical import analytic


def swept(pictures: analytic.Pictures, planes: int = 64, spacing: str = "inverse", **options: Any):
    """The depths, and the depth map of a sweep."""
    cameras = cameras_of(pictures)
    depths = sweep_planes(cameras, analytic.NEAR, analytic.FAR, planes, spacing)
    return depths.numpy(), sweep(torch.from_numpy(pictures.images), cameras, depths, **options)


def cameras_of(pictures: analytic.Pictures) -> CameraTensors:
    return CameraTensors(torch.from_numpy(pictures.K), torch.from_numpy(pictures.E), *pictures.depth.shape)


def within_one_plane(pictures: analytic.Pictures, depths: np.ndarray, found: DepthMap) -> float:
    """The fraction of the surface's pixels."""
    true = np.interp(-1 / pictures.depth, -1 / depths, np.arange(len(depths)))
    return float((np.abs(found.planes.round().numpy() - true) <= 1)[pictures.mask].mean())


def median_error(pictures: analytic.Pictures, depth: np.ndarray) -> float:
    """Relative, over the surface's pixels."""
    return float(np.median(np.abs(errors(pictures, depth))))


def errors(pictures: analytic.Pictures, depth: np.ndarray) -> np.ndarray:
    """Relative and signed, of the surface's pixels."""
    true = pictures.depth[pictures.mask]
    return (depth[pictures.mask] - true) / true


def to_ellipsoid(points: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """First-order distance to an ellipsoid about the origin: ``(|S X| - 1) |S X| / |S^2 X|``, exact on the surface."""
    first, second = np.linalg.norm(points / radii, axis=1), np.linalg.norm(points / radii**2, axis=1)
    return (first - 1) * first / second


def to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distance to a box about the origin, negative within."""
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)
