"""What the classical machine is measured against, with its settings: OpenCV's stereo, and the plainest plane sweep.

Nothing here goes through the library's operators.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

__all__ = ["BLOCK", "Found", "bad_at", "block_matching", "median_at", "plain_sweep", "semi_global_matching", "winners"]

# 5 x 5 blocks, the penalties that OpenCV's documentation gives for them, a uniqueness margin of 10 %, and both
# directions within one pixel of each other.
SEMI_GLOBAL = {
    "minDisparity": 0,
    "numDisparities": 64,
    "blockSize": 5,
    "P1": 8 * 5 * 5,
    "P2": 32 * 5 * 5,
    "disp12MaxDiff": 1,
    "uniquenessRatio": 10,
    "speckleWindowSize": 100,
    "speckleRange": 2,
    "mode": cv2.STEREO_SGBM_MODE_SGBM,
}
BLOCK = {"numDisparities": 64, "blockSize": 15, "uniquenessRatio": 10, "disp12MaxDiff": 1}
NOISE = (
    0.5 / 255
)  # a standard deviation that hardly counts; it was chosen among three for the lowest errors of the plain sweep
LUMINANCE = (0.299, 0.587, 0.114)


class Found(NamedTuple):
    """What a method says of every pixel of a view: depth or disparity, and how far it trusts it."""

    value: np.ndarray  # (h, w), NaN where it says nothing
    confidence: np.ndarray  # (h, w), higher is better, of any scale


def semi_global_matching(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparities (h, w) of OpenCV's StereoSGBM for a rectified pair of (h, w, 3) uint8; NaN where it gives none."""
    return _disparity(cv2.StereoSGBM_create(**SEMI_GLOBAL).compute(left, right))  # type: ignore[attr-defined]


def block_matching(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparities (h, w) of OpenCV's StereoBM; NaN where it gives none."""
    matcher = cv2.StereoBM_create(BLOCK["numDisparities"], BLOCK["blockSize"])  # type: ignore[attr-defined]
    matcher.setUniquenessRatio(BLOCK["uniquenessRatio"])
    matcher.setDisp12MaxDiff(BLOCK["disp12MaxDiff"])
    pair = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    return _disparity(matcher.compute(*pair))


def _disparity(sixteenths: np.ndarray) -> np.ndarray:
    return np.where(sixteenths > 0, sixteenths / 16.0, np.nan)


def plain_sweep(images: Sequence[np.ndarray], cameras: Any, depths: np.ndarray, window: int = 5) -> Found:
    """The depth of the first view by the plainest plane sweep: mean ZNCC over the neighbours, the best plane wins.

    Args:
        images: (h, w) float32 luminances in [0, 1], the reference first.
        cameras: their CameraTensors at that size, leading shape (V,).
        depths: (P,) planes.
        window: side of the square over which correlation is taken.

    Returns:
        Depths of planes, with the correlation as confidence.
    """
    best = np.full(images[0].shape, -2.0, np.float32)
    winner = np.full(images[0].shape, -1)
    for index, scores in enumerate(correlations(images, cameras, depths, window)):
        better = scores > best
        best[better], winner[better] = scores[better], index
    return Found(np.where(winner >= 0, np.asarray(depths)[winner], np.nan), best)


def correlations(images: Sequence[np.ndarray], cameras: Any, depths: np.ndarray, window: int) -> Any:
    """The mean ZNCC of each plane over the neighbours that see it, (h, w) each; -1 where none does."""
    K, E = (np.asarray(value, np.float64) for value in cameras[:2])
    size, shape = (images[0].shape[1], images[0].shape[0]), (window, window)
    mean, deviation = _moments(images[0], shape)
    for depth in depths:
        total, count = np.zeros_like(mean), np.zeros_like(mean)
        for image, k, e in zip(images[1:], K[1:], E[1:], strict=True):
            relative = e @ np.linalg.inv(E[0])
            # A point at camera z = depth of the reference: x' ~ K' (R + t n' / depth) K^-1 x, n = (0, 0, 1).
            plane = relative[:3, :3] + np.outer(relative[:3, 3], (0, 0, 1 / depth))
            H = k @ plane @ np.linalg.inv(K[0])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warped = cv2.warpPerspective(image, H, size, flags=flags, borderValue=-1.0)
            seen = cv2.erode((warped >= 0).astype(np.uint8), np.ones(shape, np.uint8)) > 0
            other, spread = _moments(warped, shape)
            score = (cv2.boxFilter(images[0] * warped, -1, shape) - mean * other) / (deviation * spread)
            total += np.where(seen, score, 0)
            count += seen
        yield np.where(count > 0, total / np.maximum(count, 1), -1)


def _moments(image: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    mean = cv2.boxFilter(image, -1, shape)
    variance = cv2.boxFilter(image * image, -1, shape) - mean * mean
    return mean, np.sqrt(np.maximum(variance, 0) + NOISE**2)


def luminance(image: Any) -> np.ndarray:
    """(3, h, w) in [0, 1] to (h, w) float32."""
    return np.einsum("chw,c->hw", np.asarray(image, np.float32), np.float32(LUMINANCE))


def winners(found: Found, density: float) -> np.ndarray:
    """The pixels (h, w) bool that a method trusts most: of all pixels, so many; fewer where it says less."""
    confidence = np.where(np.isfinite(found.value), found.confidence, -np.inf).ravel()
    best = np.argsort(-confidence, kind="stable")[: round(density * confidence.size)]
    mask = np.zeros(confidence.size, bool)
    mask[best] = True
    return (mask & np.isfinite(confidence)).reshape(found.value.shape)


def bad_at(found: Found, true: np.ndarray, density: float, threshold: float) -> float:
    """The fraction of wrong pixels among those that a method trusts most and whose true value is known."""
    use = winners(found, density) & np.isfinite(true)
    return float((np.abs(found.value - true)[use] > threshold).mean())


def median_at(found: Found, true: np.ndarray, density: float) -> float:
    """The median relative error among the pixels that a method trusts most and whose true value is known."""
    use = winners(found, density) & np.isfinite(true)
    return float(np.median((np.abs(found.value - true) / true)[use])) if use.any() else float("nan")
