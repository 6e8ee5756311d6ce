"""Depths from matched features: the truth where a set has none. Independent of the library."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

RATIO = 0.75
MOST_EPIPOLAR, LEAST_ANGLE = 1.0, 2.0  # px, degrees


class Features(NamedTuple):
    """SIFT features of one image."""

    pixels: np.ndarray  # (N, 2) x, y, integer centres
    descriptors: np.ndarray  # (N, 128)


class Depths(NamedTuple):
    """Points that are visible in a view, and their depth."""

    pixels: np.ndarray  # (N, 2) x, y, integer centres
    depth: np.ndarray  # (N,) camera z


def find_features(image: np.ndarray) -> Features:
    """The features of an (h, w) uint8 image."""
    # Without precise upscaling SIFT's coordinates are a quarter of a pixel off.
    finder = cv2.SIFT_create(nfeatures=8000, contrastThreshold=0.02, enable_precise_upscale=True)  # type: ignore[attr-defined]
    points, descriptors = finder.detectAndCompute(image, None)
    return Features(np.array([point.pt for point in points]).reshape(-1, 2), descriptors)


def triangulate(features: list[Features], K: np.ndarray, E: np.ndarray, reference: int) -> Depths:
    """The depths in one view of the features that others share with it.

    A feature counts where its matches lie within a pixel of their epipolar lines, all of them within a pixel of the
    projection of one point, and where two views see that point under more than two degrees. The point is the linear
    least-squares solution (DLT; Hartley and Zisserman, Multiple View Geometry, section 12.2) over its views.
    K is (V, 3, 3), E (V, 4, 4) world-to-camera.
    """
    seen: dict[int, list[tuple[int, np.ndarray]]] = {}
    for other in range(len(features)):
        if other == reference:
            continue
        for first, second in _matches(features[reference].descriptors, features[other].descriptors):
            pixel, pixel_other = features[reference].pixels[first], features[other].pixels[second]
            if _epipolar_error(pixel, pixel_other, K, E, reference, other) < MOST_EPIPOLAR:
                seen.setdefault(int(first), []).append((other, pixel_other))
    P = K @ E[:, :3]
    centers = -np.einsum("vji,vj->vi", E[:, :3, :3], E[:, :3, 3])
    pixels, depths = [], []
    for first, found in seen.items():
        views = [reference, *(other for other, _ in found)]
        places = np.array([features[reference].pixels[first], *(pixel for _, pixel in found)])
        rows = (places[:, :, None] * P[views, 2:] - P[views, :2]).reshape(-1, 4)
        X = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True))[2][-1]
        point = X[:3] / X[3]
        image = P[views] @ np.append(point, 1.0)
        error = np.linalg.norm(image[:, :2] / image[:, 2:] - places, axis=1).max()
        rays = centers[views] - point
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((rays @ rays[0]).min(), -1, 1)))
        if error < MOST_EPIPOLAR and angle > LEAST_ANGLE and (image[:, 2] > 0).all():
            pixels.append(places[0])
            depths.append(E[reference, 2, :3] @ point + E[reference, 2, 3])
    return Depths(np.array(pixels).reshape(-1, 2), np.array(depths))


def _matches(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Pairs (M, 2) of mutually nearest descriptors that pass the ratio test."""
    pairs = cv2.BFMatcher().knnMatch(first, second, k=2)
    forward = [(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < RATIO * n.distance]
    back = {(m.trainIdx, m.queryIdx) for m in cv2.BFMatcher().match(second, first)}
    return np.array([pair for pair in forward if pair in back]).reshape(-1, 2)


def _epipolar_error(a: np.ndarray, b: np.ndarray, K: Any, E: Any, first: int, second: int) -> float:
    """The larger distance in pixels of two points from each other's epipolar line."""
    relative = E[second] @ np.linalg.inv(E[first])
    cross = np.cross(np.eye(3), relative[:3, 3]).T  # cross @ v is t x v
    F = np.linalg.inv(K[second]).T @ cross @ relative[:3, :3] @ np.linalg.inv(K[first])
    x, y = np.append(a, 1.0), np.append(b, 1.0)
    return float(abs(y @ F @ x) / min(np.hypot(*(F.T @ y)[:2]), np.hypot(*(F @ x)[:2])))
