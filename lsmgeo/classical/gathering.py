"""A reference image and its neighbours, at one size."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lsmgeo.cameras import CameraTensors, resize
from lsmgeo.data import PosedImages

__all__ = ["fitted", "gather", "resized"]


def gather(scene: PosedImages, views: Sequence[int], size: int) -> tuple[Tensor, CameraTensors]:
    """Load images at the size of the first; cameras are resized with them, even if aspect ratios differ.

    ``size`` is the longer side of the first in pixels; it is never enlarged. Returns (V, 3, h, w) RGB in [0, 1], and
    cameras with leading shape (V,). Raises `DataError` if an image cannot be read.
    """
    shape = fitted(scene.size(views[0]), size)
    images = torch.stack([resized(scene.load(view), shape) for view in views])
    return images, resize(scene.cameras.at(list(views)), *shape)


def fitted(size: Sequence[int], longest: int) -> tuple[int, int]:
    """The size (h, w) with a longer side of ``longest`` pixels; never enlarged."""
    scale = min(1.0, longest / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def resized(image: Tensor, shape: tuple[int, int]) -> Tensor:
    """An image (C, H, W) in [0, 1] at the size (h, w), antialiased where it shrinks."""
    if tuple(image.shape[1:]) == shape:
        return image
    return interpolate(image[None], shape, mode="bilinear", antialias=True)[0].clamp(0, 1)
