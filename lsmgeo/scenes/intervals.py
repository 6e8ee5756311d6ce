"""Where a ray is inside a canonical primitive: one interval of its parameter, in closed form.

A ray intersects a convex primitive in one interval, so these five functions suffice for visibility, shadows and CSG
subtraction. The ray is ``p + s d`` in local coordinates; a miss is an interval whose end is before its start.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo.scenes.primitives import Kind

__all__ = ["interval"]

Interval = tuple[Tensor, Tensor]

# Replaces a divisor of exactly 0: its reciprocal is still finite in float32.
TINY = 1e-30


def interval(kind: Kind, p: Tensor, d: Tensor, taper: Tensor | float = 1.0) -> Interval:
    """The intervals of rays inside a canonical primitive.

    Args:
        kind: the primitive (see `Kind`).
        p: (..., 3, H, W) points of the rays at s = 0, local coordinates; any two trailing axes.
        d: (..., 3, H, W) directions, need not be unit.
        taper: of a cone, broadcasts against (..., H, W).

    Returns:
        start and end of s, (..., H, W) each; end < start where the ray misses.
    """
    x, y, z = p.unbind(-3)
    dx, dy, dz = d.unbind(-3)
    if kind is Kind.HALF_SPACE:
        return _half_space(y, dy)
    if kind is Kind.BOX:
        return _both(_both(_slab(x, dx), _slab(y, dy)), _slab(z, dz))
    if kind is Kind.SPHERE:
        return _quadric(dx * dx + dy * dy + dz * dz, x * dx + y * dy + z * dz, x * x + y * y + z * z - 1)
    if kind is Kind.CYLINDER:
        return _both(_quadric(dx * dx + dz * dz, x * dx + z * dz, x * x + z * z - 1), _slab(y, dy))
    # r(y) = middle + slope y
    slope = (taper - 1) / 2
    radius, change = (1 + taper) / 2 + slope * y, slope * dy
    a = dx * dx + dz * dz - change * change
    b = x * dx + z * dz - radius * change
    c = x * x + z * z - radius * radius
    return _both(_nappe(a, b, c, change), _slab(y, dy))


def _both(first: Interval, second: Interval) -> Interval:
    return torch.maximum(first[0], second[0]), torch.minimum(first[1], second[1])


def _not_zero(values: Tensor) -> Tensor:
    return torch.where(values.abs() < TINY, TINY, values)


def _half_space(y: Tensor, dy: Tensor) -> Interval:
    dy = _not_zero(dy)
    place = -y / dy
    return torch.where(dy < 0, place, -torch.inf), torch.where(dy < 0, torch.inf, place)


def _slab(x: Tensor, dx: Tensor) -> Interval:
    inverse = _not_zero(dx).reciprocal_()
    middle, reach = -x * inverse, inverse.abs_()
    return middle - reach, middle + reach


def _quadric(a: Tensor, b: Tensor, c: Tensor) -> Interval:
    """``a s^2 + 2 b s + c <= 0`` with a >= 0."""
    a = a.clamp_min(TINY)
    discriminant = b * b - a * c
    root = discriminant.clamp_min(0).sqrt_()
    start = torch.where(discriminant < 0, torch.inf, (-b - root) / a)
    return start, (root - b) / a


def _nappe(a: Tensor, b: Tensor, c: Tensor, change: Tensor) -> Interval:
    """The same for a cone, where a may be negative: then the ray enters one of the two nappes and stays inside.

    The root with cancellation is computed from the product of both, so a = 0 is no special case.
    """
    a = _not_zero(a)
    discriminant = b * b - a * c
    q = _not_zero(-(b + torch.copysign(discriminant.clamp_min(0).sqrt(), b)))
    one, other = q / a, c / q
    low, high = torch.minimum(one, other), torch.maximum(one, other)
    steep = a < 0
    widening = steep & (change > 0)  # the radius grows along the ray: inside from the far root on
    start = torch.where(widening, high, torch.where(steep, -torch.inf, low))
    end = torch.where(widening, torch.inf, torch.where(steep, low, high))
    return torch.where(~steep & (discriminant < 0), torch.inf, start), end
