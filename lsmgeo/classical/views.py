"""Which neighbours a view is matched with, and between which depths it is swept."""

from __future__ import annotations

import numpy as np
import torch

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical.planes import longest_path
from lsmgeo.data import PosedImages
from lsmgeo.errors import OptionError

__all__ = ["camera_centers", "common_point", "default_depth_range", "number_of_planes", "select_neighbours"]

# Below the first angle a pair says little about depth, above the last its patches hardly look alike any more.
SMALLEST_ANGLE, BEST_ANGLE, LARGEST_ANGLE = 1.5, 10.0, 60.0
# Neighbours nearer to each other than this add no viewpoint.
SMALLEST_SPACING = 1.0


def camera_centers(cameras: CameraTensors) -> np.ndarray:
    """Camera centres ``-R^T t``, (V, 3)."""
    E = cameras.cam_from_world.double().numpy()
    return -np.einsum("vji,vj->vi", E[:, :3, :3], E[:, :3, 3])


def common_point(cameras: CameraTensors) -> np.ndarray:
    """The point nearest to all optical axes in the least-squares sense, (3,).

    Equation: ``sum_v (I - a_v a_v^T) (X - C_v) = 0`` with the unit optical axes a_v and the centres C_v.
    """
    axes = cameras.cam_from_world[:, 2, :3].double().numpy()
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    right = np.einsum("vij,vj->i", projectors, camera_centers(cameras))
    # Parallel axes meet nowhere; the pseudo-inverse then stays near the cameras instead of failing.
    return np.linalg.pinv(projectors.sum(0), rcond=1e-6) @ right


def select_neighbours(scene: PosedImages, view: int, count: int) -> list[int]:
    """Choose the views to match with a reference view.

    Candidates are ranked by the angle under which both see the same thing, best near 10 degrees, times the number of
    shared sparse points where the scene has any; the angle is the median over those points, else that at the point
    where the optical axes meet. A view that stands where an already chosen one stands is passed over. (Score after
    Yao et al., "MVSNet", ECCV 2018, section 4.1.)

    Args:
        scene: the posed photographs.
        view: index of the reference.
        count: how many are wanted.

    Returns:
        At most ``count`` indices, best first.

    Raises:
        OptionError: fewer than two other views are usable.
    """
    centers = camera_centers(scene.cameras)
    focus = common_point(scene.cameras)
    scores, angles = {}, {}
    for other in range(len(scene)):
        if other == view:
            continue
        points, weight = focus[None], 1.0
        if scene.points is not None:
            shared = np.intersect1d(scene.points.observations[view].points, scene.points.observations[other].points)
            if len(shared) < 5:
                continue
            points, weight = scene.points.positions[shared], float(len(shared))
        angle = float(np.median(_angles(centers[view], centers[other], points)))
        if SMALLEST_ANGLE < angle < LARGEST_ANGLE:
            spread = 5.0 if angle < BEST_ANGLE else 20.0
            scores[other] = weight * np.exp(-0.5 * ((angle - BEST_ANGLE) / spread) ** 2)
            angles[other] = points
    chosen: list[int] = []
    for other in sorted(scores, key=lambda index: -scores[index]):
        spacings = [np.median(_angles(centers[other], centers[taken], angles[other])) for taken in chosen]
        if all(spacing > SMALLEST_SPACING for spacing in spacings):
            chosen.append(other)
        if len(chosen) == count:
            break
    if len(chosen) < 2:
        raise OptionError(
            f"view {view} ({scene.names[view]}) has {len(chosen)} usable neighbours; matching needs at least 2 that "
            f"see the same from {SMALLEST_ANGLE} to {LARGEST_ANGLE} degrees aside"
        )
    return chosen


def default_depth_range(scene: PosedImages, view: int, neighbours: list[int]) -> tuple[float, float]:
    """Nearest and farthest depth to sweep in a view when nobody says.

    From the sparse points that the view observes (their 2nd and 98th percentile, widened) where there are enough, else
    around the point where the optical axes of the view and its neighbours meet: what lies there fills the pictures, so
    its size is about that of the field of view at that depth.

    Raises:
        OptionError: the depth cannot be told; ``near`` and ``far`` must be given.
    """
    E = scene.cameras.cam_from_world[view].double().numpy()
    if scene.points is not None:
        seen = scene.points.positions[scene.points.observations[view].points]
        depth = seen @ E[2, :3] + E[2, 3]
        depth = depth[depth > 0]
        if len(depth) >= 10:
            low, high = np.percentile(depth, (2, 98))
            margin = 0.25 * (high - low) + 0.02 * low
            return float(max(low - margin, 0.5 * low)), float(high + margin)
    focus = common_point(CameraTensors(*(value[[view, *neighbours]] for value in map(torch.as_tensor, scene.cameras))))
    middle = float(E[2, :3] @ focus + E[2, 3])
    if not middle > 0:
        raise OptionError(f"view {view}: the cameras look at no common point; give near and far")
    K = scene.cameras.intrinsics[view].double().numpy()
    height, width = scene.size(view)
    radius = 0.75 * middle * min(0.5 * width / K[0, 0], 0.5 * height / K[1, 1])
    radius = min(radius, 0.5 * middle)
    return middle - radius, middle + radius


def number_of_planes(cameras: CameraTensors, near: float, far: float) -> int:
    """Planes so that one step moves a sample by about a pixel in the view that moves it most, 32 to 256.

    Args:
        cameras: leading shape (V,), the reference first, at the size at which they are matched.
        near: first depth.
        far: last depth.
    """
    return int(np.clip(np.ceil(longest_path(cameras, near, far)) + 1, 32, 256))


def _angles(first: np.ndarray, second: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Angles in degrees under which points (N, 3) see two centres, (N,)."""
    a, b = first - points, second - points
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip((a * b).sum(1) / np.maximum(norms, 1e-300), -1, 1)))
