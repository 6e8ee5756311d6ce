"""Closed forms for matrices of 3 and 4 rows.

Written with elementwise products, never with matrix multiplication: autocast and TF32 act on the latter, and cost
whole pixels there.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["affine_inverse", "basis_row", "cross", "homogeneous_row", "inverse_3x3", "multiply", "transform"]


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Matrix product of (..., n, k) and (..., k, m)."""
    return (left[..., :, :, None] * right[..., None, :, :]).sum(-2)


def transform(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix (..., n, k) times vector (..., k)."""
    return (matrix * vector[..., None, :]).sum(-1)


def cross(left: Tensor, right: Tensor) -> Tensor:
    """Cross product over the last axis, broadcasting."""
    a, b, c = left.unbind(-1)  # torch.linalg.cross has no rule for vmap
    d, e, f = right.unbind(-1)
    return torch.stack((b * f - c * e, c * d - a * f, a * e - b * d), -1)


def inverse_3x3(matrix: Tensor) -> Tensor:
    """Inverse of (..., 3, 3) as the adjugate over the determinant: differentiable, and exact where a solver is not."""
    # With cyclic indices, cofactor (i, j) is m[i+1, j+1] m[i+2, j+2] - m[i+1, j+2] m[i+2, j+1].
    one, two = matrix.roll(-1, -2), matrix.roll(-2, -2)
    cofactors = one.roll(-1, -1) * two.roll(-2, -1) - one.roll(-2, -1) * two.roll(-1, -1)
    determinant = (matrix[..., 0, :] * cofactors[..., 0, :]).sum(-1)
    return cofactors.transpose(-1, -2) / determinant[..., None, None]


def homogeneous_row(rows: Tensor) -> Tensor:
    """Append the row (0, 0, 0, 1) to (..., 3, 4)."""
    return torch.cat((rows, basis_row(rows, 4, 3)), -2)


def basis_row(rows: Tensor, length: int, index: int) -> Tensor:
    """The row (..., 1, length) with a 1 at `index`, to go with rows (..., n, length); made on their device."""
    row = torch.eye(length, dtype=rows.dtype, device=rows.device)[index : index + 1]
    return row.expand(*rows.shape[:-2], 1, length)


def affine_inverse(matrix: Tensor) -> Tensor:
    """Inverse of an affine (..., 4, 4), whose last row is taken to be (0, 0, 0, 1)."""
    linear = inverse_3x3(matrix[..., :3, :3])
    offset = -transform(linear, matrix[..., :3, 3])
    return homogeneous_row(torch.cat((linear, offset[..., None]), -1))
