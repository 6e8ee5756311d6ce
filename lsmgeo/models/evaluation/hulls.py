"""The visual hull of the first views, as a method beside the models."""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import visual_hull
from lsmgeo.data.sample import first_views
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.evaluation.scores import iou_by_view

__all__ = ["HULL", "STRICT_HULL", "hull_iou"]

HULL, STRICT_HULL = "visual hull", "visual hull, strict"


def hull_iou(masks: Tensor, cameras: CameraTensors, occupancy: Tensor, *, rule: str = "mean") -> Tensor:
    """IoU (B, V) of the hull of the first views, after each.

    Args:
        masks: (B, V, H, W) bool silhouettes.
        cameras: leading shape (B, V).
        occupancy: (B, D, H, W) bool over the unit cube, the truth.
        rule: "mean" above 0.75, as in the paper, or "all": strictly within all silhouettes.
    """
    grid = VoxelGrid(tuple(occupancy.shape[1:]))  # type: ignore[arg-type]
    hulls = [
        visual_hull(masks[:, :views], first_views(cameras, views), grid, rule=rule).occupancy
        for views in range(1, masks.shape[1] + 1)
    ]
    return iou_by_view(torch.stack(hulls, 1), occupancy)
