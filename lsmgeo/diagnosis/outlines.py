"""Whether the outlines of one object, seen from several places, can be those of one object."""

from __future__ import annotations

import numpy as np

from lsmgeo.diagnosis.geometry import Geometry, homogeneous

__all__ = ["epipolar_tangency", "outline"]

# An epipole so near to the outline, seen from the outline's middle, makes planes through the baseline that turn a lot
# from pixel to pixel.
LEAST_CLEARANCE = 1.3


def outline(mask: np.ndarray) -> np.ndarray | None:
    """The convex hull of the centres of an object's pixels.

    Args:
        mask: (H, W) bool, True on the object.

    Returns:
        (N, 2) float64 x, y; None where nothing is there or the object leaves the picture, so that its outline is not
        all seen.
    """
    import cv2

    rows, columns = np.nonzero(mask)
    if len(rows) == 0 or mask[[0, -1]].any() or mask[:, [0, -1]].any():
        return None
    # Through pixels' centres: the half pixel up to the border is there in both views, and moves no plane.
    return cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32))[:, 0].astype(np.float64)


def epipolar_tangency(first: np.ndarray, second: np.ndarray, cameras: Geometry) -> np.ndarray:
    """How far the two planes through the baseline that touch the object in one view are from touching it in the other.

    A plane through both camera centres that touches the object does so in both views: its two lines are tangents of the
    outlines. (Cipolla, Astrom, Giblin, "Motion from the frontier of curved surfaces", ICCV 1995; Wong and Cipolla,
    "Structure and motion from silhouettes", ICCV 2001.)

    Args:
        first: (N, 2) outline in the first view, pixels.
        second: (M, 2) outline in the second.
        cameras: of the two views.

    Returns:
        (2,) distances in pixels, the mean over the two views; NaN where an epipole lies in or near an outline.
    """
    nowhere = np.full(2, np.nan)
    K, backward, centers = cameras.K, np.linalg.inv(cameras.R), cameras.centers
    baseline = centers[1] - centers[0]
    length = np.linalg.norm(baseline)
    rays = []
    for points, matrix, turn in zip((first, second), K, backward, strict=True):
        ray = homogeneous(points) @ np.linalg.inv(matrix).T @ turn.T
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    if not length > 1e-9 * max(1.0, float(np.linalg.norm(centers, axis=1).max())):
        return nowhere
    axis = baseline / length
    across = [ray - (ray @ axis)[:, None] * axis for ray in rays]  # the part that tells the half-plane
    middle = across[0].mean(0) / np.linalg.norm(across[0].mean(0))
    side = np.cross(axis, middle)
    ends, widths = [], []
    for part, matrix in zip(across, K, strict=True):
        angles = np.arctan2(part @ side, part @ middle)
        # Where the baseline pierces the object, or passes it closely, half-planes go all around.
        turned = np.exp(1j * angles)
        centre = np.angle(turned.mean())
        around = np.angle(turned * np.exp(-1j * centre))
        if around.max() - around.min() > np.pi / LEAST_CLEARANCE:
            return nowhere
        low, high = around.argmin(), around.argmax()
        ends.append(centre + around[[low, high]])
        focal = np.sqrt(abs(matrix[0, 0] * matrix[1, 1]))
        # What an angle about the baseline is in pixels: the nearer to the epipole, the less.
        widths.append(focal * np.linalg.norm(part[[low, high]], axis=1))
    difference = np.abs(np.angle(np.exp(1j * (ends[0] - ends[1]))))
    return np.asarray(difference * (widths[0] + widths[1]) / 2)
