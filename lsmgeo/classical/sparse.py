"""The error of a depth map at the sparse points of its scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from lsmgeo.classical.plane_sweep import DepthMap
from lsmgeo.classical.views import depth_of
from lsmgeo.data import PosedImages

__all__ = ["SparseError", "sparse_error"]


@dataclass(frozen=True)
class SparseError:
    """Relative depth error at the sparse points of a scene."""

    median: float
    points: int
    observed: int


def sparse_error(scene: PosedImages, view: int, depth_map: DepthMap, mask: Tensor) -> SparseError | None:
    """Median relative depth error at the sparse points that a view observes, among the pixels of a mask (h, w).

    Returns:
        The median of ``|depth - true| / true``, the number of points used, and of those observed; None without points.
    """
    if scene.points is None:
        return None
    observed = scene.points.observations[view]
    expected = depth_of(scene, view, scene.points.positions[observed.points])
    height, width = depth_map.depth.shape
    full = scene.size(view)
    scale = np.array([width / full[1], height / full[0]])
    cells = np.floor((observed.pixels + 0.5) * scale).astype(np.int64)
    inside = ((cells >= 0) & (cells < (width, height))).all(1) & (expected > 0)
    x, y = cells[inside].T
    use = mask.numpy()[y, x]
    errors = np.abs(depth_map.depth.numpy()[y, x] - expected[inside])[use] / expected[inside][use]
    return SparseError(float(np.median(errors)) if len(errors) else float("nan"), len(errors), len(expected))
