"""Random images as backgrounds of objects: analytic, so a training set needs no photos."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_size

__all__ = ["background"]


def background(generator: np.random.Generator, height: int, width: int) -> Tensor:
    """A random image: a gradient, plane waves, a checkerboard, stripes or blobs, in two or three colours.

    With probability one half it is a blend of two such patterns. Lengths are relative to the longer side, so equal
    draws look alike at every size.

    Args:
        generator: the source of randomness; equal states give equal images.
        height: pixels.
        width: pixels.

    Returns:
        (3, H, W) float32 RGB in [0, 1].

    Raises:
        ShapeError: a size below 1.

    Example:
        >>> import numpy as np
        >>> from lsmgeo.scenes import background
        >>> background(np.random.default_rng(0), 48, 64).shape
        torch.Size([3, 48, 64])
    """
    height, width = check_size("background", "(height, width)", (height, width), 2, "two integers")
    longer = max(height, width)
    y = (torch.arange(height, dtype=torch.float32) - (height - 1) / 2)[:, None] / longer
    x = (torch.arange(width, dtype=torch.float32) - (width - 1) / 2) / longer
    image = _coloured(generator, _pattern(generator, y, x))
    if generator.random() < 0.5:
        over, share = _coloured(generator, _pattern(generator, y, x)), float(generator.uniform(0.2, 0.6))
        image = image.lerp(over, share)
    return image.clamp_(0, 1)


def _coloured(generator: np.random.Generator, mix: Tensor) -> Tensor:
    """Two random colours, mixed by (H, W) numbers in [0, 1]."""
    first, second = torch.from_numpy(generator.random((2, 3, 1, 1))).float()
    return first + (second - first) * mix


def _pattern(generator: np.random.Generator, y: Tensor, x: Tensor) -> Tensor:
    """(H, W) in [0, 1] of coordinates (H, 1) and (W,) that span about one unit."""
    kind = int(generator.integers(5))
    angle, pitch, phase = generator.uniform(0, 2 * np.pi), generator.uniform(2, 14), generator.uniform(0, 1)
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    if kind == 0:
        return (along / 1.4 + 0.5).clamp(0, 1)
    if kind == 1:
        # The edges of checks and stripes are soft over a twentieth of their width.
        waves = torch.sin(np.pi * (pitch * along + phase)) * torch.sin(np.pi * pitch * across)
        return (10 * waves + 0.5).clamp(0, 1)
    if kind == 2:
        return (6 * torch.sin(2 * np.pi * (pitch * along + phase)) + 0.5).clamp(0, 1)
    if kind == 3:
        total = torch.zeros(y.shape[0], x.shape[0])
        for _ in range(5):
            angle, shift = generator.uniform(0, 2 * np.pi, 2)
            frequency = 2 * np.pi * generator.uniform(1, 10)
            total += torch.sin(frequency * (x * np.cos(angle) + y * np.sin(angle)) + shift)
        return total / 10 + 0.5
    total = torch.zeros(y.shape[0], x.shape[0])
    for _ in range(int(generator.integers(4, 12))):
        (up, right), size = generator.uniform(-0.5, 0.5, 2), generator.uniform(0.04, 0.25)
        # A Gaussian is the product of its two profiles.
        total += torch.exp(-(((y - up) / size) ** 2)) * torch.exp(-(((x - right) / size) ** 2))
    return total.clamp(0, 1)
