"""Plane-sweep stereo of all views of a shape, as a method beside the models."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import sweep, sweep_planes

__all__ = ["SWEEP", "sweep_views"]

SWEEP = "plane sweep"
# All that an object in the unit cube can be at, seen from 2 units away.
NEAR, FAR = 2 - math.sqrt(3) / 2, 2 + math.sqrt(3) / 2


def sweep_views(images: Tensor, cameras: CameraTensors, *, planes: int, window: int) -> Tensor:
    """Depth (V, H, W) of every view, matched with all others by zero-mean normalised cross-correlation; 0 where none.

    Args:
        images: (V, 3, H, W).
        cameras: leading shape (V,).
        planes: of a sweep, between 2 -+ sqrt(3) / 2.
        window: side of the patches in pixels.
    """
    depths = sweep_planes(cameras, NEAR, FAR, planes)
    found = []
    for view in range(len(images)):
        order = [view, *(other for other in range(len(images)) if other != view)]
        some = CameraTensors(*(torch.as_tensor(field)[order] for field in cameras))
        found.append(sweep(images[order], some, depths, score="zncc", window=window).depth)
    return torch.stack(found)
