"""The depths of the planes of a sweep."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_number, check_whole
from lsmgeo.cameras import as_tensors, project, unproject_depth
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.grids import depth_planes

__all__ = ["longest_path", "sweep_planes"]

MOST_PLANES = 1 << 20
SPACINGS = ("inverse", "depth", "disparity")
# The length in pixels of a path that passes behind a neighbour.
ENDLESS = 1e9


def sweep_planes(cameras: Cameras, near: float, far: float, num: int = 300, spacing: str = "inverse") -> Tensor:
    """The depths of the planes of a sweep, from near to far, both included.

    "inverse" makes even steps in the images of neighbours beside the reference, "depth" even steps in the world.
    "disparity" is "inverse" with the number of planes that makes a step of at most a pixel in the neighbour in which
    the centre of the reference moves most.

    Args:
        cameras: leading shape (V,), the reference first, at the size at which they are matched; used by "disparity".
        near: first depth, positive, world units.
        far: last depth, larger.
        num: number of planes, at least 3; not used by "disparity".
        spacing: "inverse", "depth" or "disparity".

    Returns:
        (P,) float64, ascending.

    Raises:
        OptionError: an unknown spacing, a range that is not finite, more than 2^20 steps of a pixel.
        GridError: near and far not positive and ascending.

    Example:
        >>> from lsmgeo.cameras import orbit
        >>> import torch
        >>> cameras = orbit(torch.tensor([0.0, 15.0]), 0.0, 2.0, focal_length=100.0, height=60, width=80)
        >>> len(sweep_planes(cameras, 1.5, 2.5)), len(sweep_planes(cameras, 1.5, 2.5, spacing="disparity"))
        (300, 15)
    """
    who = "sweep_planes"
    check_choice(who, "spacing", spacing, SPACINGS)
    num = check_whole(who, "num", num, 3, MOST_PLANES)
    near, far = (check_number(who, name, end, "a number") for name, end in (("near", near), ("far", far)))
    ends = (torch.tensor(near, dtype=torch.float64), torch.tensor(far, dtype=torch.float64))
    if spacing != "disparity":
        return depth_planes(*ends, num, spacing=spacing)
    depth_planes(*ends, 2)  # checks them
    path = longest_path(cameras, near, far)
    number = math.ceil(path) + 1
    if number > MOST_PLANES:
        cause = "a neighbour has part of the range behind it" if path >= ENDLESS else f"steps take {number} planes"
        raise OptionError(f"{who}: near must be larger for steps of a pixel: {cause}")
    return depth_planes(*ends, max(number, 3), spacing="inverse")


def longest_path(cameras: Cameras, near: float, far: float) -> float:
    """Pixels that the centre of the reference moves from near to far, in the neighbour in which it moves most."""
    tensors = as_tensors(cameras, "longest_path")
    if len(tensors.shape) != 1 or tensors.shape[0] < 2:
        raise ShapeError(f"longest_path: cameras must have leading shape (V,), V at least 2; got {tensors.shape}")
    # The pixel of a map of one pixel is at the centre of the image.
    depth = torch.tensor([near, far], dtype=torch.float64).reshape(1, 2, 1, 1)
    ends = unproject_depth(tensors.at([0, 0]), depth).reshape(1, 2, 3)
    pixels, z, _ = project(tensors.at(slice(1, None)), ends, near=1e-6 * near)
    path = (pixels[0, :, 0] - pixels[0, :, 1]).norm(dim=-1)
    return float(torch.where((z[0] > 1e-6 * near).all(-1), path, ENDLESS).max())
