"""What the installed PyTorch can do, where older ones cannot."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import grid_sample


def _is_twice_differentiable() -> bool:
    grid = torch.zeros(1, 1, 1, 2, requires_grad=True)
    value = grid_sample(torch.rand(1, 1, 2, 2), grid, align_corners=False).sum()
    (slope,) = torch.autograd.grad(value, grid, create_graph=True)
    try:
        torch.autograd.grad(slope.sum(), grid)
    except RuntimeError:
        return False
    return True


# Forward-mode derivatives of grid_sample came with its second ones, after PyTorch 2.7.
needs_second_derivatives = pytest.mark.skipif(
    not _is_twice_differentiable(), reason="this PyTorch's grid_sample has no forward-mode and second derivatives"
)
