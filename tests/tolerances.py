"""Every tolerance of the suite, from the dtype and the error analysis of a projection; nowhere else.

A projected coordinate computed with unit roundoff u is off by at most
``FACTOR * u * ((|K|_inf + |(u, v)|_inf) * (|X| + |t| + extent) / z + |(u, v)|_inf)``: the sums of ``M q`` have terms of
size ``|K| (|X| + |t| + extent)`` before they cancel, those of the denominator ``|X| + |t| + extent``, and the division
adds a relative error. ``extent`` is the size of the lattice, because lattice indices enter the sum rather than world
points.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

Array = npt.NDArray[np.float64]

UNIT_ROUNDOFF = {torch.float64: 2.0**-53, torch.float32: 2.0**-24, torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}

# In float64 the expected value carries rounding errors of the same size (solves, R^T against inverse), hence more.
FACTOR = {torch.float64: 64.0, torch.float32: 4.0}

VALUE_FACTOR = 16.0

# Laws that hold term by term (linearity, permutation, batch against loop), relative to the largest magnitude.
TERMWISE = {torch.float64: 1e-12, torch.float32: 2e-6}

# Networks in float32 on batches of another size, absolute: their convolutions sum in another order, and the norms of
# small maps enlarge that.
BATCHED = 2e-4

# Laws between two float64 computations that differ by a change of frame.
FRAME = 1e-8

# Distance to a kink of the interpolant, in lattice units, kept by finite differences.
KINK_GUARD = 1e-3


def arithmetic(dtype: torch.dtype) -> torch.dtype:
    """The dtype that coordinates are computed in for features of ``dtype``."""
    return torch.float64 if dtype == torch.float64 else torch.float32


def length_error(dtype: torch.dtype, magnitude: Array | float) -> Array:
    """Bound of the error of a world length (depth, position) whose sum has terms of size ``magnitude``."""
    kind = arithmetic(dtype)
    return np.asarray(FACTOR[kind] * UNIT_ROUNDOFF[kind] * np.asarray(magnitude))


def coordinate_error(
    dtype: torch.dtype, linear_norm: Array | float, magnitude: Array | float, depth: Array, index: Array
) -> Array:
    """Bound of the error of a lattice coordinate (N,); ``magnitude`` is |X| + |t| + extent, ``index`` (N, A)."""
    kind = arithmetic(dtype)
    with np.errstate(all="ignore"):
        largest = np.abs(index).max(axis=-1)
        terms = (linear_norm + largest) * magnitude / np.abs(depth) + largest
    terms = np.where(np.isfinite(terms), terms, np.inf)
    return np.asarray(FACTOR[kind] * UNIT_ROUNDOFF[kind] * terms)


def value_error(dtype: torch.dtype, coordinate: Array | float, largest: float, axes: int = 2) -> Array:
    """Bound of the error of a sampled value: a step of the interpolant is at most ``2 * largest`` per axis."""
    kind = arithmetic(dtype)
    rounding = VALUE_FACTOR * UNIT_ROUNDOFF[kind] * largest
    storage = 0.0 if kind == dtype else UNIT_ROUNDOFF[dtype] * largest
    return np.minimum(2.0 * axes * largest * np.asarray(coordinate), 2.0 * largest) + rounding + storage


def termwise(dtype: torch.dtype, largest: float) -> float:
    """Absolute tolerance of a law that holds term by term."""
    return TERMWISE[arithmetic(dtype)] * max(largest, 1.0)
