"""Residuals of matched features and sparse points: Sampson distances, reprojection errors, and the cheirality test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.diagnosis.two_view_geometry import Geometry, fundamental, homogeneous, project, relative

if TYPE_CHECKING:
    from lsmgeo.data import SparsePoints
    from lsmgeo.diagnosis.feature_matching import Matches

__all__ = [
    "in_front", "pair_distances", "reprojection_errors", "reprojections", "residuals", "sampson_distances",
    "view_costs",
]  # fmt: skip

# Below this parallax, px, the depth of a match is too uncertain for a sign.
LEAST_PARALLAX = 5.0
# Stands for an infinite distance, px.
FARTHEST = 1e9


def sampson_distances(matches: Matches, geometry: Geometry) -> np.ndarray:
    """Signed distances of matches from their epipolar lines, (M,) px.

    Equation: Sampson's, x2^T F x1 / sqrt(|F x1|^2 + |F^T x2|^2) with the first two coordinates under the root (Hartley
    and Zisserman, "Multiple View Geometry", section 11.4.3). Without a baseline there are no epipolar lines: the value
    is then half the distance between one pixel and the other mapped by the homography K2 A K1^-1, never negative.
    """
    F, H = _epipolar_relations(geometry, matches.first, matches.second)
    return _distances(matches.pixels, F[matches.pair], H[matches.pair])


def residuals(matches: Matches, geometry: Geometry) -> np.ndarray:
    """Signed residuals (M, 2) px, smooth at zero: `sampson_distances` and zero.

    Without a baseline, half the difference in x and y between a pixel and the other mapped by the homography.
    """
    H = _epipolar_relations(geometry, matches.first, matches.second)[1][matches.pair]
    found = np.stack([sampson_distances(matches, geometry), np.zeros(len(matches.pair))], 1)
    static = np.isfinite(H[:, 0, 0])
    mapped = _map_by_homography(H[static], matches.pixels[static, 0])
    found[static] = 0.5 * np.nan_to_num(mapped - matches.pixels[static, 1], nan=FARTHEST)
    return found


def pair_distances(pixels: np.ndarray, geometry: Geometry, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Median distance of one pair's matches (M, 2, 2) for each of Q pairs of cameras, (Q,) px."""
    F, H = _epipolar_relations(geometry, first, second)
    return np.asarray(np.median(np.abs(_distances(pixels[None], F[:, None], H[:, None])), axis=1))


def _epipolar_relations(geometry: Geometry, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fundamental matrices (P, 3, 3), and homographies: of pairs without a baseline, NaN for others."""
    A, b = relative(geometry, first, second)
    H = geometry.K[second] @ A @ np.linalg.inv(geometry.K[first])
    H[(b != 0).any(1)] = np.nan
    return fundamental(geometry, first, second), H


def _map_by_homography(H: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        mapped = (H @ homogeneous(pixels)[..., None])[..., 0]
        return np.asarray(mapped[..., :2] / mapped[..., 2:])


def _distances(pixels: np.ndarray, F: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Distances of pixels (..., 2, 2); F and H broadcast against (..., 3, 3)."""
    a, b = (homogeneous(pixels[..., index, :]) for index in (0, 1))
    line = (F @ a[..., None])[..., 0]
    back = (F.swapaxes(-1, -2) @ b[..., None])[..., 0]
    root = np.sqrt((line[..., :2] ** 2).sum(-1) + (back[..., :2] ** 2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        distance = (b * line).sum(-1) / root
    if np.isfinite(H).any():
        apart = 0.5 * np.linalg.norm(_map_by_homography(H, pixels[..., 0, :]) - pixels[..., 1, :], axis=-1)
        distance = np.where(np.isfinite(H[..., 0, 0]), apart, distance)
    # Neither line nor homography constrains such a match: it counts as the worst.
    return np.nan_to_num(distance, nan=FARTHEST, posinf=FARTHEST, neginf=-FARTHEST)


def in_front(matches: Matches, geometry: Geometry) -> np.ndarray:
    """Whether matches lie in front of both cameras (cheirality), (M,): 1 or 0, NaN where the parallax is too small.

    Equation: the depths z1, z2 that minimise |z1 A r1 + b - z2 r2| for the rays r = K^-1 x.
    """
    A, b = (value[matches.pair] for value in relative(geometry, matches.first, matches.second))
    inverse = np.linalg.inv(geometry.K)
    start, ray = (
        np.einsum("mij,mj->mi", inverse[views[matches.pair]], homogeneous(matches.pixels[:, index]))
        for index, views in enumerate((matches.first, matches.second))
    )
    rotated = np.einsum("mij,mj->mi", A, start)
    aa, rr, ar = (rotated**2).sum(1), (ray**2).sum(1), (rotated * ray).sum(1)
    ab, rb = (rotated * b).sum(1), (ray * b).sum(1)
    determinant = aa * rr - ar**2
    focal = np.sqrt(np.abs(geometry.K[:, 0, 0] * geometry.K[:, 1, 1]))[matches.second[matches.pair]]
    known = (determinant > (LEAST_PARALLAX / focal) ** 2 * aa * rr) & (b != 0).any(1)
    front = (ar * rb - ab * rr > 0) & (aa * rb - ar * ab > 0)
    return np.where(known, front, np.nan)


def reprojections(points: SparsePoints, geometry: Geometry, view: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Projection minus observation (M, 2) px and depth (M,) of the points that a view observes, in a given camera."""
    observed = points.observations[view]
    pixels, depth = project(geometry, camera, points.positions[observed.points])
    return np.nan_to_num(pixels - observed.pixels, nan=FARTHEST, posinf=FARTHEST, neginf=-FARTHEST), depth


def reprojection_errors(points: SparsePoints, geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (M,) px, depths (M,), and the view (M,) of every observation."""
    found = [reprojections(points, geometry, view, view) for view in range(len(points.observations))]
    differences, depths = (np.concatenate(values) for values in zip(*found, strict=True))
    views = np.repeat(np.arange(len(found)), [len(depth) for _, depth in found])
    return np.linalg.norm(differences, axis=1), depths, views


def view_costs(points: SparsePoints, geometry: Geometry) -> np.ndarray:
    """Median reprojection error of each view's observations in each camera, (V, V) px; NaN for a view without any."""
    count = len(points.observations)
    costs = np.full((count, count), np.nan)
    for view in range(count):
        if len(points.observations[view].points):
            for camera in range(count):
                difference, depth = reprojections(points, geometry, view, camera)
                distance = np.where(depth > 0, np.linalg.norm(difference, axis=1), FARTHEST)
                costs[view, camera] = np.median(distance)
    return costs
