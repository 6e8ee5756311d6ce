"""Plane-sweep stereo of all views of a shape, as a method beside the models."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import sweep, sweep_planes

__all__ = ["SURE", "SWEEP", "Swept", "sweep_views"]

SWEEP = "plane sweep"
# The confidence from which a depth is more than the best of many bad ones.
SURE = 0.05
# All that an object in the unit cube can be at, seen from 2 units away.
NEAR, FAR = 2 - math.sqrt(3) / 2, 2 + math.sqrt(3) / 2


class Swept(NamedTuple):
    """What the sweeps of all views found."""

    depth: Tensor  # (V, H, W) camera z, 0 where no plane wins
    confidence: Tensor  # (V, H, W) in [0, 1]


def sweep_views(images: Tensor, cameras: CameraTensors, *, planes: int, window: int) -> Swept:
    """Depth of every view, matched with all others by zero-mean normalised cross-correlation.

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
        found.append(sweep(images[order], some, depths, score="zncc", window=window))
    return Swept(torch.stack([one.depth for one in found]), torch.stack([one.confidence for one in found]))
