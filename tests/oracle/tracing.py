"""Where rays meet a plane, a sphere and a box. Rays are origin + s * direction; the answer is s, inf for a miss."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def hit_plane(origins: Array, directions: Array, normal: Array, offset: float) -> Array:
    """First s >= 0 with ``normal . X = offset``."""
    with np.errstate(all="ignore"):
        s = (offset - origins @ normal) / (directions @ normal)
    return np.where(np.isfinite(s) & (s >= 0), s, np.inf)


def hit_sphere(origins: Array, directions: Array, center: Array, radius: float) -> Array:
    """First s >= 0 on the sphere."""
    a = np.sum(directions * directions, axis=-1)
    b = np.sum((origins - center) * directions, axis=-1)
    c = np.sum((origins - center) ** 2, axis=-1) - radius**2
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0.0))
    near, far = (-b - root) / a, (-b + root) / a
    s = np.where(near >= 0, near, far)
    return np.where((discriminant >= 0) & (s >= 0), s, np.inf)


def hit_box(origins: Array, directions: Array, lower: Array, upper: Array) -> Array:
    """First s >= 0 on the surface of an axis-aligned box, for rays that start outside it."""
    with np.errstate(all="ignore"):
        first = (lower - origins) / directions
        second = (upper - origins) / directions
    enter = np.nanmax(np.minimum(first, second), axis=-1)
    leave = np.nanmin(np.maximum(first, second), axis=-1)
    return np.where((enter <= leave) & (enter >= 0), enter, np.inf)
