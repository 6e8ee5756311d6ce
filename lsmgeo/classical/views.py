"""The neighbours that a view is matched with, and the depth range in which it is swept."""

from __future__ import annotations

import numpy as np
import torch

from lsmgeo._checks import check_whole
from lsmgeo.cameras import CameraTensors, centers, project, resize
from lsmgeo.data import PosedImages
from lsmgeo.errors import OptionError
from lsmgeo.grids import FrustumGrid, depth_planes

__all__ = [
    "common_point",
    "default_depth_range",
    "depth_of",
    "measured_depth_range",
    "select_neighbours",
]

# In degrees: below the first a pair determines depth poorly, above the last its patches hardly match.
SMALLEST_ANGLE, BEST_ANGLE, LARGEST_ANGLE = 1.5, 10.0, 60.0
# In degrees: neighbours that are closer to each other add no viewpoint.
SMALLEST_SPACING = 1.0
# A view that shares fewer sparse points, or less of the frustum, is not a neighbour.
LEAST_SHARED_POINTS, LEAST_SHARED_FRUSTUM = 5, 0.2
FRUSTUM_SHAPE = (6, 6, 8)
# Fewer depths are not enough for a range.
LEAST_DEPTHS = 10
# Fractions of the image width: larger disparities cannot be matched, smaller ones do not determine depth.
LARGEST_DISPARITY, SMALLEST_DISPARITY = 0.3, 0.01


def common_point(cameras: CameraTensors) -> np.ndarray:
    """The point nearest to all optical axes in the least-squares sense, (3,).

    Equation: ``sum_v (I - a_v a_v^T) (X - C_v) = 0`` with the unit optical axes a_v and the centres C_v.
    """
    axes = cameras.cam_from_world[:, 2, :3].double().numpy()
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    origins = centers(cameras).double().numpy()
    middle = origins.mean(0)
    right = np.einsum("vij,vj->i", projectors, origins - middle)
    # If axes are parallel, the pseudo-inverse gives a point among the cameras.
    return np.asarray(middle + np.linalg.pinv(projectors.sum(0), rcond=1e-6) @ right)


def select_neighbours(
    scene: PosedImages, view: int, count: int, *, near: float | None = None, far: float | None = None
) -> list[int]:
    """Choose the views to match with a reference view.

    Candidates are ranked by a weight of the triangulation angle, best near 10 degrees, times what they share: sparse
    points if the scene has them, otherwise points all over the frustum of the reference that the other view sees. The
    angle is the median over these points. A view at the position of one that is already chosen is skipped. (Score
    after Yao et al., "MVSNet", ECCV 2018, section 4.1.)

    Args:
        scene: posed images.
        view: index of the reference.
        count: the largest number of neighbours.
        near: nearest depth that the reference sees, world units; by default `default_depth_range`.
        far: farthest depth.

    Returns:
        At most ``count`` indices, best first.

    Raises:
        OptionError: no other view is usable, or the depth range is needed and cannot be inferred.
    """
    check_whole("select_neighbours", "view", view, 0, len(scene) - 1)
    check_whole("select_neighbours", "count", count, 1)
    origins = centers(scene.cameras).numpy()
    frustum = np.empty((0, 3))
    if scene.points is None:
        if near is None or far is None:
            near, far = default_depth_range(scene, view)
        frustum = _frustum_points(scene, view, near, far)
        visible = project(scene.cameras, torch.from_numpy(frustum)[None]).visible[0].numpy()
    scores, angles = {}, {}
    for other in range(len(scene)):
        if other == view:
            continue
        if scene.points is not None:
            shared = np.intersect1d(scene.points.observations[view].points, scene.points.observations[other].points)
            points, weight = scene.points.positions[shared], float(len(shared))
            if weight < LEAST_SHARED_POINTS:
                continue
        else:
            points = frustum[visible[other]]
            weight = len(points) / len(frustum)
            if weight < LEAST_SHARED_FRUSTUM:
                continue
        angle = float(np.median(_angles(origins[view], origins[other], points)))
        if SMALLEST_ANGLE < angle < LARGEST_ANGLE:
            spread = 5.0 if angle < BEST_ANGLE else 20.0
            scores[other] = weight * np.exp(-0.5 * ((angle - BEST_ANGLE) / spread) ** 2)
            angles[other] = points
    chosen: list[int] = []
    for other in sorted(scores, key=lambda index: -scores[index]):
        spacings = [np.median(_angles(origins[other], origins[taken], angles[other])) for taken in chosen]
        if all(spacing > SMALLEST_SPACING for spacing in spacings):
            chosen.append(other)
        if len(chosen) == count:
            break
    if not chosen:
        raise OptionError(
            f"view {view} ({scene.names[view]}) has no usable neighbour: no other view sees the same points at "
            f"an angle of {SMALLEST_ANGLE} to {LARGEST_ANGLE} degrees"
        )
    return chosen


def _frustum_points(scene: PosedImages, view: int, near: float, far: float) -> np.ndarray:
    """World points (N, 3) all over the frustum of a view, evenly in the image and in inverse depth."""
    camera = resize(scene.camera(view), *FRUSTUM_SHAPE[1:])
    depths = depth_planes(near, far, FRUSTUM_SHAPE[0], spacing="inverse")
    return FrustumGrid(camera, depths, FRUSTUM_SHAPE[1:]).centers().reshape(-1, 3).double().numpy()


def measured_depth_range(scene: PosedImages, view: int) -> tuple[float, float] | None:
    """Nearest and farthest depth of the sparse points that a view observes, or of its measured depth map.

    It is their 2nd and 98th percentile, widened, in world units; None if there are too few. Raises `DataError` if the
    depth map cannot be read.
    """
    check_whole("measured_depth_range", "view", view, 0, len(scene) - 1)
    depth = np.empty(0)
    if scene.points is not None:
        depth = depth_of(scene, view, scene.points.positions[scene.points.observations[view].points])
    elif (measured := scene.load_depth(view)) is not None:
        depth = measured.double().flatten().numpy()
    depth = depth[depth > 0]
    if len(depth) < LEAST_DEPTHS:
        return None
    low, high = np.percentile(depth, (2, 98))
    margin = 0.25 * (high - low) + 0.02 * low
    return float(max(low - margin, 0.5 * low)), float(high + margin)


def depth_of(scene: PosedImages, view: int, points: np.ndarray) -> np.ndarray:
    """Camera z (N,) of points (N, 3) in one view."""
    return project(scene.camera(view).at(None), torch.from_numpy(points)[None]).depth[0, 0].numpy()


def default_depth_range(scene: PosedImages, view: int) -> tuple[float, float]:
    """Nearest and farthest depth of what a view shows, inferred from measured depth or from the cameras.

    Without a `measured_depth_range`, around the point where the optical axes meet: an object there fills the images, so
    its size is about that of the field of view at that depth. If they do not meet, the depths at which disparities
    between this camera and the nearest one are 1 to 30 % of the image width.

    Args:
        scene: posed images.
        view: index of the view.

    Raises:
        OptionError: the depth cannot be inferred; ``near`` and ``far`` must be given.
        DataError: a measured depth map cannot be read.
    """
    measured = measured_depth_range(scene, view)
    if measured is not None:
        return measured
    fx, fy = torch.linalg.vector_norm(scene.cameras.intrinsics[view, :2, :2].double(), dim=-1).tolist()
    height, width = scene.size(view)
    middle = float(depth_of(scene, view, common_point(scene.cameras)[None])[0])
    origins = centers(scene.cameras).numpy()
    away = np.linalg.norm(origins - origins[view], axis=1)
    # If axes are parallel, their common point depends on rounding only.
    if middle > 1e-6 * away.max():
        radius = 0.75 * middle * float(min(0.5 * width / fx, 0.5 * height / fy))
        radius = min(radius, 0.5 * middle)
        return middle - radius, middle + radius
    if not away.any():
        raise OptionError(f"view {view}: the cameras look at no common point; give near and far")
    moved = fx * float(away[away > 0].min()) / width
    return moved / LARGEST_DISPARITY, moved / SMALLEST_DISPARITY


def _angles(first: np.ndarray, second: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The angles (N,) in degrees between the rays from points (N, 3) to two camera centres."""
    a, b = first - points, second - points
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip((a * b).sum(1) / np.maximum(norms, 1e-300), -1, 1)))
