"""Overlap of voxel grids."""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo._checks import FLOATS, check_devices, check_flag, check_float, check_mask, check_number
from lsmgeo.errors import ShapeError

__all__ = ["voxel_iou"]


@torch.no_grad()
def voxel_iou(predicted: Tensor, occupancy: Tensor, *, threshold: float = 0.4, skip_empty: bool = False) -> Tensor:
    """Intersection over union of voxel grids.

    Equation: ``|P and T| / |P or T|`` over the voxels of a grid, with P the voxels whose probability is above the
    threshold. Two empty grids agree: 1. (Kar et al. 2017, section 4: 0.75 for the visual hull, 0.4 for the others.)

    Args:
        predicted: (..., D, H, W) probabilities of any floating dtype, where NaN counts as empty; or bool.
        occupancy: bool, of the same shape: the ground truth.
        threshold: of the probabilities.
        skip_empty: whether the IoU is NaN where the truth is empty, so that means leave it out: a thin shape may have
            no voxel at a coarse resolution, and then says nothing about a method.

    Returns:
        (...) float64 in [0, 1], or NaN, one per grid. Nothing is differentiable.

    Raises:
        ShapeError: the shapes differ, or there are fewer than three axes.
        DTypeError: ``occupancy`` is not bool.
        OptionError: ``threshold`` is not a number, or ``skip_empty`` not a bool.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import voxel_iou
        >>> truth = torch.zeros(1, 4, 4, 4, dtype=torch.bool)
        >>> truth[:, :, :, 1:3] = True
        >>> predicted = torch.full((1, 4, 4, 4), 0.2)
        >>> predicted[:, :, :, 2:] = 0.9
        >>> voxel_iou(predicted, truth)
        tensor([0.3333], dtype=torch.float64)
    """
    who = "voxel_iou"
    if not isinstance(predicted, Tensor) or predicted.dtype != torch.bool:
        check_float(who, "predicted", predicted, "(..., D, H, W), floating or bool", dtypes=FLOATS)
    if predicted.dim() < 3:
        raise ShapeError(f"{who}: predicted must be (..., D, H, W); got {tuple(predicted.shape)}")
    check_mask(who, "occupancy", occupancy, tuple(predicted.shape), "of the shape of predicted")
    check_devices(who, predicted=predicted, occupancy=occupancy)
    level = check_number(who, "threshold", threshold, "a number")
    occupied = predicted if predicted.dtype == torch.bool else predicted > level
    shared = (occupied & occupancy).sum((-3, -2, -1)).double()
    union = (occupied | occupancy).sum((-3, -2, -1)).double()
    iou = torch.where(union > 0, shared / union.clamp_min(1), 1.0)
    if check_flag(who, "skip_empty", skip_empty):
        iou = torch.where(occupancy.flatten(-3).any(-1), iou, torch.nan)
    return iou
