"""The losses: cross-entropy and overlap of occupancy, absolute error of depth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from lsmgeo._checks import check_choice
from lsmgeo.data.sample import Batch
from lsmgeo.errors import DTypeError, ShapeError
from lsmgeo.models.outputs import DepthOutput, VoxelOutput, views_used

__all__ = ["LOSSES", "compute_loss", "sum_loss"]

LOSSES = ("bce", "bce+iou")
IOU_WEIGHT = 0.1
FAR = 10.0  # of the background, as in the release's depth maps


def sum_loss(
    output: VoxelOutput | DepthOutput,
    batch: Batch,
    *,
    region: str = "object",
    loss: str = "bce",
    steps: str | Sequence[int] | None = None,
) -> tuple[Tensor, Tensor]:
    """The loss as a sum and a count, which several processes add before they divide; arguments as in `compute_loss`.

    Returns:
        The sum of the terms and how many there are, both float32 scalars; only the sum is differentiable.

    Raises:
        ShapeError, DTypeError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo.data import Batch
        >>> from lsmgeo.models import VoxelOutput
        >>> view_mask = torch.tensor([[True, True], [True, False]])
        >>> occupied = torch.ones(2, 4, 4, 4, dtype=torch.bool)
        >>> batch = Batch(torch.zeros(2, 2, 3, 8, 8), None, None, None, occupied, (), (), (), view_mask)
        >>> sum_loss(VoxelOutput(torch.zeros(2, 2, 4, 4, 4)), batch)[1]  # three views of 64 voxels
        tensor(192.)
    """
    who = "sum_loss"
    check_choice(who, "region", region, ("object", "all"))
    check_choice(who, "loss", loss, LOSSES)
    if isinstance(output, VoxelOutput):
        predicted, truth, form = output.logits, batch.occupancy, "occupancy of (B, D, H, W)"
    elif isinstance(output, DepthOutput):
        predicted, truth, form = output.depth, batch.depth, "depth of (B, V, H, W)"
    else:
        raise DTypeError(f"{who}: output must be a VoxelOutput or a DepthOutput; got {type(output).__name__}")
    if truth is None:
        raise DTypeError(f"{who}: batch must have {form}; got None")
    if predicted.shape[0] != truth.shape[0] or predicted.shape[2:] != truth.shape[1:]:
        raise ShapeError(
            f"{who}: batch must have {form} as predicted, {tuple(predicted.shape)}; got {tuple(truth.shape)}"
        )
    after = views_used(who, steps, batch.view_mask.shape[1])
    if predicted.shape[1] != len(after):
        raise ShapeError(f"{who}: output must be after {len(after)} views; got {tuple(predicted.shape)}")
    # After the last view every scene has a prediction, even where its own last view is padding.
    is_predicted = batch.view_mask.any(1, keepdim=True) if steps == "last" else batch.view_mask[:, after]
    weight = is_predicted.float()[:, :, None, None, None]
    if isinstance(output, DepthOutput):
        is_object = truth > 0 if batch.mask is None else (truth > 0) & batch.mask
        counted = is_object if region == "object" else torch.ones_like(is_object)
        weight = weight * (counted & batch.view_mask[:, :, None, None])[:, None]
    # Selected before and after, not multiplied by 0: 0 times NaN or infinity is NaN, in gradients too.
    counts = weight > 0
    predicted = torch.where(counts, predicted.float(), 0.0)
    if isinstance(output, VoxelOutput):
        target = truth[:, None].float().expand(predicted.shape)
        terms = binary_cross_entropy_with_logits(predicted, target, reduction="none")
    else:
        terms = (predicted - torch.where(is_object, truth, FAR)[:, None]).abs()
    total = torch.where(counts, terms, 0.0).sum()
    if isinstance(output, VoxelOutput) and loss == "bce+iou":
        # The overlap with an empty shape is 0 whatever is predicted.
        is_counted = is_predicted & truth.flatten(1).any(1, keepdim=True)
        missing = torch.where(is_counted, 1 - _soft_iou(predicted, target), 0.0)
        total = total + IOU_WEIGHT * truth.shape[1:].numel() * missing.sum()
    return total, weight.expand(terms.shape).sum()


def _soft_iou(logits: Tensor, target: Tensor) -> Tensor:
    """Overlap of probabilities with the truth, (B, S): the sum of products over the sum of probabilistic unions."""
    probability = logits.sigmoid()
    shared = (probability * target).flatten(2).sum(2)
    return shared / (probability.flatten(2).sum(2) + target.flatten(2).sum(2) - shared).clamp_min(1e-6)


def compute_loss(
    output: VoxelOutput | DepthOutput,
    batch: Batch,
    *,
    region: str = "object",
    loss: str = "bce",
    steps: str | Sequence[int] | None = None,
) -> Tensor:
    """The loss of a model's output: the mean over scenes, their views, and voxels or pixels.

    Equation: binary cross-entropy of occupancy; absolute error of depth (Kar, Haene and Malik, "Learning a Multi-View
    Stereo Machine", 2017, section 3). "bce+iou" adds ``0.1 (1 - sum p t / sum (p + t - p t))`` of each scene and view
    (the overlap of Rahman and Wang, "Optimizing Intersection-Over-Union in Deep Neural Networks", 2016), p the
    probabilities and t the truth: few voxels are occupied, and cross-entropy by itself is slow to leave "all empty".
    Computed in float32, whatever the output's dtype.

    Args:
        output: of a model.
        batch: its input, with `occupancy` of the output's resolution, or `depth`.
        region: of depth maps: "object" for the pixels on the object, "all" for every pixel of the unmasked views, with
            the background 10 units away (the release's).
        loss: of occupancy: "bce", the paper's, or "bce+iou".
        steps: as in the call of the model. Masked views do not count.

    Returns:
        A scalar, float32; 0 where nothing counts.

    Raises:
        ShapeError, DTypeError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo.data import Batch
        >>> from lsmgeo.models import VoxelOutput
        >>> view_mask, occupied = torch.ones(1, 2, dtype=torch.bool), torch.ones(1, 4, 4, 4, dtype=torch.bool)
        >>> batch = Batch(torch.zeros(1, 2, 3, 8, 8), None, None, None, occupied, (), (), (), view_mask)
        >>> compute_loss(VoxelOutput(torch.zeros(1, 2, 4, 4, 4)), batch)  # log 2
        tensor(0.6931)
    """
    total, count = sum_loss(output, batch, region=region, loss=loss, steps=steps)
    return total / count.clamp_min(1.0)
