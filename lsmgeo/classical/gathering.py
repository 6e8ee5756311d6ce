"""A reference photograph and its neighbours, at one size."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lsmgeo.cameras import CameraTensors, resize, stack
from lsmgeo.data import PosedImages

__all__ = ["gather", "resized", "working_size"]


def gather(scene: PosedImages, views: Sequence[int], size: int) -> tuple[Tensor, CameraTensors]:
    """Load photographs at the size of the first.

    All take the reference's size; the resize rule keeps cameras exact, even where aspects differ.

    Args:
        scene: the posed photographs.
        views: which, the reference first.
        size: longer side of the reference in pixels; photographs are never enlarged for it.

    Returns:
        (V, 3, h, w) RGB in [0, 1], and their cameras, leading shape (V,).

    Raises:
        DataError: a photograph cannot be read.
    """
    shape = working_size(scene, views[0], size)
    images = torch.stack([resized(scene.load(view), shape) for view in views])
    return images, stack([resize(scene.camera(view), *shape) for view in views])


def working_size(scene: PosedImages, view: int, size: int) -> tuple[int, int]:
    """(h, w) of a photograph whose longer side is brought to so many pixels; it is never enlarged."""
    height, width = scene.size(view)
    scale = min(1.0, size / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def resized(image: Tensor, shape: tuple[int, int]) -> Tensor:
    """An image (C, H, W) in [0, 1] at the size (h, w), smoothed where it shrinks."""
    if tuple(image.shape[1:]) == shape:
        return image
    return interpolate(image[None], shape, mode="bilinear", antialias=True)[0].clamp(0, 1)
