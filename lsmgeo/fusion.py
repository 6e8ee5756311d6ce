"""Fusion of views: modules of one protocol, from per-view volumes to one.

Each takes ``(volume (B, V, C, *sites), visible (B, V, *sites), view_mask (B, V) or None)`` and gives (B, C, *sites),
with any number of views and ragged scenes.
"""

from __future__ import annotations

from torch import Tensor, nn

from lsmgeo.functional import view_statistics

__all__ = ["Max", "Mean", "Variance"]


class _Statistic(nn.Module):
    name: str

    def forward(self, volume: Tensor, visible: Tensor, view_mask: Tensor | None = None) -> Tensor:
        """Reduce (B, V, C, *sites) over the visible views to (B, C, *sites)."""
        return view_statistics(volume, visible, self.name, view_mask)


class Mean(_Statistic):
    """Mean over the views that see a site, 0 where none does.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Mean
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Mean()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[2.]]])
    """

    name = "mean"


class Variance(_Statistic):
    """Population variance over the views that see a site (as in MVSNet): the mean of squares about the mean.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Variance
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Variance()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[1.]]])
    """

    name = "variance"


class Max(_Statistic):
    """Maximum over the views that see a site; its gradient goes to the first view that attains it.

    Example:
        >>> import torch
        >>> from lsmgeo.fusion import Max
        >>> volume = torch.tensor([1.0, 3.0, 8.0]).reshape(1, 3, 1, 1)
        >>> Max()(volume, torch.tensor([[[True], [True], [False]]]))
        tensor([[[3.]]])
    """

    name = "max"
