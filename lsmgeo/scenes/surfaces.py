"""Normals and colours at points of surfaces. Arrays are (3, K), one row per coordinate."""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo.scenes.tables import Tables

__all__ = ["albedo", "normals"]

TINY = 1e-30


def normals(tables: Tables, rows: Tensor, points: Tensor) -> Tensor:
    """Unit normals at points on the surfaces of primitives, outward (inward for subtracted ones).

    The face is the one whose function (see `Tables`) has the largest value, that is, nearest to 0.

    Args:
        tables: in the points' dtype.
        rows: (K,) the primitive.
        points: (3, K), world.

    Returns:
        (3, K), world.
    """
    columns = (
        tables.linear.flatten(1),  # 0:9
        tables.center,  # 9:12
        tables.low,  # 12:15
        tables.high,  # 15:18
        tables.round,  # 18:21
        torch.stack((tables.radius, tables.slope, tables.side), 1),  # 21:24
    )
    numbers = torch.cat(columns, 1).T.contiguous().index_select(1, rows)  # (24, K)
    linear = numbers[:9].unflatten(0, (3, 3))
    local = (linear * (points - numbers[9:12])).sum(1)
    low, high, curved = numbers[12:15], numbers[15:18], numbers[18:21]
    radius, slope, side = numbers[21:24]

    above = local - high
    flat, axis = torch.maximum(above, low - local).max(0)
    radial = (curved * local.square()).sum(0).sqrt()
    is_round = radial - (radius + slope * local[1]) > flat
    sign = torch.where(above.gather(0, axis[None])[0] >= flat, 1.0, -1.0)
    facet = torch.where(axis == torch.arange(3, device=axis.device)[:, None], sign, 0.0)
    gradient = curved * local / radial.clamp_min(TINY)
    gradient[1] -= slope
    local_normal = torch.where(is_round, gradient, facet)  # a covector: transformed by the transpose
    normal = (linear * local_normal[:, None]).sum(0)
    return normal * (side / normal.square().sum(0).sqrt().clamp_min(TINY))


def albedo(tables: Tables, rows: Tensor, points: Tensor) -> Tensor:
    """RGB (3, K) of points (3, K), world, on the surfaces of primitives ``rows`` (K,)."""
    colours = tables.colour.flatten(1).T.contiguous().index_select(1, rows)  # (6, K)
    colour, second = colours[:3], colours[3:]
    at = tables.textured[rows].nonzero()[:, 0]
    if len(at) == 0:
        return colour
    row, point = rows[at], points[:, at]
    waves = torch.sin((tables.waves[row] * point.T[:, None]).sum(-1) + tables.phase[row])  # (K', 6)
    soft = (0.5 + (tables.weight[row] * waves).sum(-1)).clamp(0, 1)
    cubes = (waves[:, :3] > 0).sum(-1).remainder(2).to(soft.dtype)
    mix = torch.where(tables.checker[row], cubes, soft)
    colour[:, at] = torch.lerp(second[:, at], colour[:, at], mix)
    return colour
