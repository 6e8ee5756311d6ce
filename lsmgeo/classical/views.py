"""Which neighbours a view is matched with, and between which depths it is swept."""

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

# Below the first angle a pair says little about depth, above the last its patches hardly look alike any more.
SMALLEST_ANGLE, BEST_ANGLE, LARGEST_ANGLE = 1.5, 10.0, 60.0
# Neighbours nearer to each other than this add no viewpoint.
SMALLEST_SPACING = 1.0
# A view that shares fewer sparse points, or less of the frustum, sees something else.
LEAST_SHARED_POINTS, LEAST_SHARED_FRUSTUM = 5, 0.2
FRUSTUM_SHAPE = (6, 6, 8)
# Fewer depths do not tell a range.
LEAST_DEPTHS = 10
# Of a picture's width: what moves more between two views cannot be matched, what moves less has no depth.
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
    # Parallel axes meet nowhere; the pseudo-inverse then stays among the cameras instead of failing.
    return np.asarray(middle + np.linalg.pinv(projectors.sum(0), rcond=1e-6) @ right)


def select_neighbours(
    scene: PosedImages, view: int, count: int, *, near: float | None = None, far: float | None = None
) -> list[int]:
    """Choose the views to match with a reference view.

    Candidates are ranked by the angle under which both see the same thing, best near 10 degrees, times how much they
    share: sparse points where the scene has any, else places all over the reference's frustum that the other view sees
    too. The angle is the median over these. A view that stands where an already chosen one stands is passed over.
    (Score after Yao et al., "MVSNet", ECCV 2018, section 4.1.)

    Args:
        scene: the posed photographs.
        view: index of the reference.
        count: how many are wanted.
        near: nearest depth of what the reference sees, world units; by default `default_depth_range`.
        far: farthest depth.

    Returns:
        At most ``count`` indices, best first.

    Raises:
        OptionError: no other view is usable, or the depth range is needed and cannot be told.
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
            f"view {view} ({scene.names[view]}) has no usable neighbour: no other view sees the same from "
            f"{SMALLEST_ANGLE} to {LARGEST_ANGLE} degrees aside"
        )
    return chosen


def _frustum_points(scene: PosedImages, view: int, near: float, far: float) -> np.ndarray:
    """World points (N, 3) all over a view's frustum, evenly in the picture and in inverse depth."""
    camera = resize(scene.camera(view), *FRUSTUM_SHAPE[1:])
    depths = depth_planes(near, far, FRUSTUM_SHAPE[0], spacing="inverse")
    return FrustumGrid(camera, depths, FRUSTUM_SHAPE[1:]).centers().reshape(-1, 3).double().numpy()


def measured_depth_range(scene: PosedImages, view: int) -> tuple[float, float] | None:
    """Nearest and farthest depth of the sparse points that a view observes, or of the depth that comes with it.

    Args:
        scene: the posed photographs.
        view: index of the view.

    Returns:
        Their 2nd and 98th percentile, widened, world units; None where there are too few.

    Raises:
        DataError: the depth that comes with the photograph cannot be read.
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
    """Nearest and farthest depth of what a view shows, as told by what was measured, or by the cameras.

    Where there is no `measured_depth_range`, around the point where the optical axes meet: what lies there fills the
    pictures, so its size is about that of the field of view at that depth. Where they meet nowhere, the depths at which
    things move between this camera and the next by 1 to 30 % of the picture's width.

    Args:
        scene: the posed photographs.
        view: index of the view.

    Raises:
        OptionError: the depth cannot be told; ``near`` and ``far`` must be given.
        DataError: the depth that comes with the photograph cannot be read.
    """
    measured = measured_depth_range(scene, view)
    if measured is not None:
        return measured
    K = scene.cameras.intrinsics[view].double().numpy()
    height, width = scene.size(view)
    middle = float(depth_of(scene, view, common_point(scene.cameras)[None])[0])
    origins = centers(scene.cameras).numpy()
    away = np.linalg.norm(origins - origins[view], axis=1)
    # Parallel axes: rounding alone decides how far before or behind the cameras they meet.
    if middle > 1e-6 * away.max():
        radius = 0.75 * middle * float(min(0.5 * width / K[0, 0], 0.5 * height / K[1, 1]))
        radius = min(radius, 0.5 * middle)
        return middle - radius, middle + radius
    if not away.any():
        raise OptionError(f"view {view}: the cameras look at no common point; give near and far")
    moved = float(K[0, 0]) * float(away[away > 0].min()) / width
    return moved / LARGEST_DISPARITY, moved / SMALLEST_DISPARITY


def _angles(first: np.ndarray, second: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Angles in degrees under which points (N, 3) see two centres, (N,)."""
    a, b = first - points, second - points
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip((a * b).sum(1) / np.maximum(norms, 1e-300), -1, 1)))
