"""The dtype of the arithmetic, and the cast from it to the dtype of the output."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["computing_dtype", "saturating_cast", "saturation_limit"]


def computing_dtype(values: Tensor) -> torch.dtype:
    """float64 for float64, float32 for all others."""
    return torch.float64 if values.dtype == torch.float64 else torch.float32


def saturation_limit(dtype: torch.dtype) -> float:
    """The limit beyond which outputs saturate; what rounds to the dtype's largest finite value passes gradients."""
    info = torch.finfo(dtype)
    return info.max * (1.0 + info.eps / 8.0)


def saturating_cast(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Cast to a dtype; larger values become its largest finite value, so that finite values stay finite."""
    if values.dtype == dtype:
        return values
    limit = saturation_limit(dtype)
    return values.clamp(-limit, limit).to(dtype)
