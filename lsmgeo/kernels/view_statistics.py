"""Mean, variance and maximum over the views that see a site."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["first_maximum", "view_statistics"]


def first_maximum(values: Tensor, seen: Tensor, dim: int) -> Tensor:
    """Index of the first seen value that is the largest, with `dim` of size 1; any where none is seen."""
    largest, first = torch.where(seen, values.detach(), -torch.inf).max(dim, keepdim=True)
    return torch.where(largest == -torch.inf, seen.to(torch.uint8).argmax(dim, keepdim=True), first)


def view_statistics(values: Tensor, visible: Tensor, statistics: Sequence[str]) -> Tensor:
    """Reduce over the visible views of each site.

    Args:
        values: (B, V, C, ...), of a computing dtype.
        visible: (B, V, ...) bool.
        statistics: names out of "mean", "variance" (mean of squares about the mean) and "max".

    Returns:
        (B, len(statistics) * C, ...), blocks of channels in the order requested, 0 where no view sees the site, at most
        the dtype's largest finite value.
    """
    seen = visible[:, :, None]  # (B, V, 1, ...)
    share = 1.0 / visible.sum(1, dtype=values.dtype).clamp_min(1.0)[:, None]  # (B, 1, ...)
    largest = torch.finfo(values.dtype).max
    kept = torch.where(seen, values, 0.0)
    blocks = []
    # Divided before the sum, so that the mean of large finite numbers does not overflow.
    mean = (kept * share[:, None]).sum(1) if "mean" in statistics or "variance" in statistics else kept
    for name in statistics:
        if name == "mean":
            blocks.append(mean)
        elif name == "variance":
            # Clamped where its square would overflow.
            deviation = torch.where(seen, kept - mean[:, None], 0.0).clamp(-(largest**0.5), largest**0.5)
            blocks.append((deviation.square() * share[:, None]).sum(1).clamp(max=largest))
        else:
            # Indices of the first maximum, so that equal views do not share the gradient.
            blocks.append(kept.gather(1, first_maximum(values, seen, 1))[:, 0])
    return torch.cat(blocks, 1)
