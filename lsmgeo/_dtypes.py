"""In which dtype to compute, and how to come back from it."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["computing_dtype", "saturating_cast"]


def computing_dtype(values: Tensor) -> torch.dtype:
    """float64 for float64, float32 for all others."""
    return torch.float64 if values.dtype == torch.float64 else torch.float32


def saturating_cast(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Cast to a dtype of which the largest finite value stands for all above it: what is finite stays finite."""
    if values.dtype == dtype:
        return values
    largest = torch.finfo(dtype).max
    return values.clamp(-largest, largest).to(dtype)
