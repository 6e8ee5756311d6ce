"""The baselines that models are compared with: the visual hull of the first views, and plane-sweep stereo."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import sweep, sweep_planes, visual_hull
from lsmgeo.data.sample import first_views
from lsmgeo.evaluation.report import iou_by_view
from lsmgeo.grids import VoxelGrid

__all__ = ["HULL", "STRICT_HULL", "SURE", "SWEEP", "DepthMaps", "hull_iou", "sweep_views"]

HULL, STRICT_HULL, SWEEP = "visual hull", "visual hull, strict", "plane sweep"
# Below this confidence a depth is only the best of many bad ones.
SURE = 0.05
# The depths of the unit cube from 2 units away.
NEAR, FAR = 2 - math.sqrt(3) / 2, 2 + math.sqrt(3) / 2


def hull_iou(masks: Tensor, cameras: CameraTensors, occupancy: Tensor, *, rule: str = "mean") -> Tensor:
    """IoU (B, V) of the hull of the first 1, 2, ... V views.

    Args:
        masks: (B, V, H, W) bool silhouettes.
        cameras: leading shape (B, V).
        occupancy: (B, D, H, W) bool over the unit cube, the truth.
        rule: "mean" (above 0.75, as in the paper) or "all" (within all silhouettes).
    """
    grid = VoxelGrid(tuple(occupancy.shape[1:]))  # type: ignore[arg-type]
    hulls = [
        visual_hull(masks[:, :views], first_views(cameras, views), grid, rule=rule).occupancy
        for views in range(1, masks.shape[1] + 1)
    ]
    return iou_by_view(torch.stack(hulls, 1), occupancy)


class DepthMaps(NamedTuple):
    """The depth maps of all views."""

    depth: Tensor  # (V, H, W) camera z, 0 where no plane wins
    confidence: Tensor  # (V, H, W) in [0, 1]


def sweep_views(images: Tensor, cameras: CameraTensors, *, planes: int, window: int) -> DepthMaps:
    """Depth of every view, matched with all others by zero-mean normalised cross-correlation.

    Args:
        images: (V, 3, H, W).
        cameras: leading shape (V,).
        planes: their number, from 2 - sqrt(3) / 2 to 2 + sqrt(3) / 2.
        window: side of the patches in pixels.
    """
    depths = sweep_planes(cameras, NEAR, FAR, planes)
    maps = []
    for view in range(len(images)):
        order = [view, *(other for other in range(len(images)) if other != view)]
        maps.append(sweep(images[order], cameras.at(order), depths, score="zncc", window=window))
    return DepthMaps(torch.stack([one.depth for one in maps]), torch.stack([one.confidence for one in maps]))
