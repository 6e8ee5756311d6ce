"""Points and pixels for the fused kernels: where they fall, before anything is sampled.

A kernel that samples given pixels needs to know neither matrices nor points; these few numbers a point are made by
PyTorch, with its derivatives.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo.kernels import reference
from lsmgeo.kernels.request import Options
from lsmgeo.kernels.view_statistics import view_statistics

__all__ = ["pixels_in_front", "project_points", "sample_pixels"]


def project_points(
    matrix: Tensor, direction: Tensor | None, points: Tensor, view_mask: Tensor | None, options: Options
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments of `reference.unproject_points` as those of `sample_pixels`, in float32."""
    near, points = reference._nearby(points)
    matrix = reference._moved(matrix, near)
    scale = reference._scale_below_overflow(reference._point_extent(matrix, points))[..., None]  # (B, V, 1)
    rows = reference._point_rows(matrix * scale[..., None], points, torch.float32)
    unit = scale.float()
    (x, y), front = reference._divide(rows, unit, view_mask, options)
    extra = []
    if options.depth:
        largest = torch.finfo(torch.float32).max
        extra.append(reference._masked(rows[2] / unit, view_mask).clamp(-largest, largest)[:, :, None])
    if direction is not None:
        moved, all_points = reference._moved(direction, near), slice(0, points.shape[1])
        extra.append(reference._point_directions(moved, points, all_points, view_mask, torch.float32))
    return torch.stack((x, y), -1), front, torch.cat(extra, 2) if extra else None


def pixels_in_front(
    pixels: Tensor, depth: Tensor, valid: Tensor, options: Options
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments of `reference.sample_views` as those of `sample_pixels`, in float32."""
    distance, largest = depth.float(), torch.finfo(torch.float32).max
    extra = torch.where(valid, distance.clamp(-largest, largest), 0.0)[:, :, None] if options.depth else None
    return pixels.float(), valid & (distance > options.near), extra


def sample_pixels(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """What the fused kernels do with pixels, in the reference's operations: the second derivatives come from here.

    Args:
        source: (B, V, C, h, w).
        pixels: (B, V, N, 2).
        front: (B, V, N) bool; nothing is read elsewhere.
        extra: (B, V, E, N), channels to append, or None.
        options: mode, padding_mode and reduce.

    Returns:
        (B, V, C + E, N), or (B, C'', N) where options.reduce is set, and visibility (B, V, N).
    """
    dtype = computing_dtype(source)
    index = [torch.where(front, axis, reference.OUTSIDE) for axis in pixels.to(dtype).unbind(-1)]
    values, visible = reference._sample(source.to(dtype), index, front, options)
    if extra is not None:
        values = torch.cat((values, extra.to(dtype)), 2)
    if options.reduce:
        values = view_statistics(values, visible, options.reduce)
    return saturating_cast(values, source.dtype), visible
