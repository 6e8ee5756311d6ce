"""The outputs of the models, and the views after which they predict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from lsmgeo._checks import check_whole, describe
from lsmgeo.errors import OptionError

__all__ = ["DepthOutput", "DepthResult", "VoxelOutput", "VoxelResult", "views_used"]


class VoxelOutput(NamedTuple):
    """The output of a voxel network in training.

    Attributes:
        logits: (B, S, D, H, W); their sigmoid is the probability that a voxel is occupied, after S of the views.
    """

    logits: Tensor


class DepthOutput(NamedTuple):
    """The output of a depth network in training.

    Attributes:
        depth: (B, S, T, H, W) camera z of T views in world units, after S of the views; 0 in masked views.
    """

    depth: Tensor


class VoxelResult(NamedTuple):
    """The result of `run` of a voxel network.

    Attributes:
        occupancy: (B, D, H, W) probabilities in [0, 1], after all views.
        by_view: (B, V, D, H, W), after each view, or None.
    """

    occupancy: Tensor
    by_view: Tensor | None


class DepthResult(NamedTuple):
    """The result of `run` of a depth network.

    Attributes:
        depth: (B, T, H, W) camera z of T views in world units, after all views; 0 in masked views.
        by_view: (B, V, T, H, W), after each view, or None.
    """

    depth: Tensor
    by_view: Tensor | None


def views_used(who: str, steps: str | Sequence[int] | None, views: int) -> list[int]:
    """The indices of the views after which the network predicts.

    Args:
        who: the network, named in errors.
        steps: None for every view, "last", or indices from 0 to V - 1.
        views: V.

    Raises:
        OptionError: none of these, or an index out of range.

    Example:
        >>> views_used("voxel-lsm", "last", 4), views_used("voxel-lsm", None, 3)
        ([3], [0, 1, 2])
    """
    if steps is None:
        return list(range(views))
    if isinstance(steps, str) and steps == "last":
        return [views - 1]
    if isinstance(steps, str) or not isinstance(steps, Sequence) or not steps:
        raise OptionError(f"{who}: steps must be None, 'last' or indices of views; got {describe(steps)}")
    return [check_whole(who, "steps", step, 0, views - 1) for step in steps]
