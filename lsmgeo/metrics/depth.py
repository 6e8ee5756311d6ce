"""Errors of depth maps at the pixels that count."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_devices, check_float, check_mask, check_number, check_positive
from lsmgeo.errors import ShapeError

__all__ = ["BadPixels", "DepthErrors", "MedianDepthError", "bad_pixel_rate", "depth_errors", "median_depth_error"]

# Half the diagonal of the unit cube that holds every object of the paper's set.
RADIUS = math.sqrt(3) / 2


class DepthErrors(NamedTuple):
    """Errors of depth maps; each (...) float64, NaN where no pixel counts."""

    l1: Tensor  # mean |p - d|, world units
    abs_rel: Tensor  # mean |p - d| / d
    rmse: Tensor  # root of the mean (p - d)^2, world units
    delta1: Tensor  # share of the pixels with max(p / d, d / p) < 1.25
    delta2: Tensor  # ... < 1.25^2
    delta3: Tensor  # ... < 1.25^3
    density: Tensor  # share of the pixels with a true depth that have a predicted one
    pixels: Tensor  # (...) int64, the number that count


class BadPixels(NamedTuple):
    """The share of pixels whose error is above a threshold; each (...)."""

    rate: Tensor  # float64 in [0, 1], NaN where no pixel counts
    density: Tensor  # float64, share of the pixels with a true value that have a predicted one
    pixels: Tensor  # int64, the number that count


class MedianDepthError(NamedTuple):
    """The paper's measure of depth maps; each (...)."""

    error: Tensor  # float64, world units, NaN where no pixel counts
    pixels: Tensor  # int64, the number that count


@torch.no_grad()
def depth_errors(predicted: Tensor, depth: Tensor, mask: Tensor | None = None) -> DepthErrors:
    """The usual errors of depth maps.

    Equation: with p predicted, d true, over the n pixels that count: l1 ``sum |p - d| / n``, abs_rel
    ``sum |p - d| / d / n``, rmse ``sqrt(sum (p - d)^2 / n)``, delta_k the share with ``max(p / d, d / p) < 1.25^k``
    (Eigen, Puhrsch and Fergus 2014, section 4). Predictions that are negative or NaN are in no delta; NaN also makes
    the other errors of its map NaN.

    Convention: depth is camera z, 0 means none. A pixel counts where the mask allows it, the true depth is above 0 and
    finite, and the prediction is not 0. ``density`` is the share that is not left out for the last reason.

    Args:
        predicted: (..., h, w) floating.
        depth: (..., h, w) floating, the truth.
        mask: (..., h, w) bool, pixels that may count; None allows all.

    Returns:
        `DepthErrors`, one value per map. Nothing is differentiable.

    Raises:
        ShapeError: shapes differ.
        DTypeError: a tensor is of another dtype.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import depth_errors
        >>> found = depth_errors(torch.tensor([[2.0, 3.0, 0.0, 1.0]]), torch.tensor([[2.0, 2.0, 2.0, 0.0]]))
        >>> float(found.l1), float(found.abs_rel), float(found.delta1), int(found.pixels)
        (0.5, 0.25, 0.5, 2)
    """
    p, d, true, counts = _compared("depth_errors", "depth", predicted, depth, mask)
    number = counts.sum((-2, -1)).double()
    difference = torch.where(counts, (p - d).abs(), 0.0)
    ratio = torch.where(p > 0, torch.maximum(p / d, d / p), torch.inf)
    near = [(counts & (ratio < 1.25**power)).sum((-2, -1)) / number for power in (1, 2, 3)]
    return DepthErrors(
        l1=difference.sum((-2, -1)) / number,
        abs_rel=(difference / d).sum((-2, -1)) / number,
        rmse=(difference.square().sum((-2, -1)) / number).sqrt(),
        delta1=near[0],
        delta2=near[1],
        delta3=near[2],
        density=number / true.sum((-2, -1)),
        pixels=number.long(),
    )


@torch.no_grad()
def bad_pixel_rate(
    predicted: Tensor, true: Tensor, threshold: float, mask: Tensor | None = None, *, missing: str = "skip"
) -> BadPixels:
    """The share of pixels whose error of disparity or depth is above a threshold.

    Equation: the share of the pixels that count with ``|p - t| > threshold`` (Scharstein and Szeliski 2002,
    section 5.1).

    Convention: 0, and what is not finite, means no value, in both maps. A pixel counts where the mask allows it and it
    has a true value. One without a predicted value is left out (``missing="skip"``) or bad (``missing="bad"``).

    Args:
        predicted: (..., h, w) floating.
        true: (..., h, w) floating.
        threshold: in the units of the maps, at least 0.
        mask: (..., h, w) bool, pixels that may count; None allows all.
        missing: "skip" or "bad".

    Returns:
        `BadPixels`, one value per map. Nothing is differentiable.

    Raises:
        ShapeError: shapes differ.
        DTypeError: a tensor is of another dtype.
        OptionError: ``threshold`` is below 0, or ``missing`` is unknown.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import bad_pixel_rate
        >>> true, predicted = torch.tensor([[8.0, 8.0, 8.0, 8.0]]), torch.tensor([[8.5, 11.0, 7.9, 0.0]])
        >>> float(bad_pixel_rate(predicted, true, 2.0).rate)
        0.3333
        >>> float(bad_pixel_rate(predicted, true, 2.0, missing="bad").rate)
        0.5
    """
    who = "bad_pixel_rate"
    limit = check_number(who, "threshold", threshold, "at least 0", 0)
    check_choice(who, "missing", missing, ("skip", "bad"))
    _check_maps(who, "true", predicted, true, mask)
    p, t = predicted.double(), true.double()
    valued = torch.isfinite(t) & (t != 0)
    valued = valued if mask is None else valued & mask
    answered = valued & torch.isfinite(p) & (p != 0)
    counts = valued if missing == "bad" else answered
    good = answered & ((p - t).abs() <= limit)
    number = counts.sum((-2, -1))
    rate = (counts & ~good).sum((-2, -1)) / number.double()
    return BadPixels(rate, answered.sum((-2, -1)) / valued.sum((-2, -1)).double(), number)


@torch.no_grad()
def median_depth_error(
    predicted: Tensor,
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    center: float = 2.0,
    radius: float = RADIUS,
    rule: str = "paper",
) -> MedianDepthError:
    """The depth error of Kar et al. 2017 (section 4, "Comparison to Plane Sweeping").

    Equation: ``median |p - d|`` over the pixels that count; for an even number the mean of the middle two. A prediction
    that is NaN has an infinite error.

    Convention: depth is camera z, 0 means none; an object in the unit cube about the origin, seen from distance
    ``center``, lies within ``center +- sqrt(3) / 2``. A pixel counts where both depths exist and

    - ``rule="paper"``: the *true* depth lies in the range, ends included ("the evaluation region is limited to a depth
      range of +-sqrt(3)/2");
    - ``rule="release"``: the *predicted* depth lies in the range, ends excluded, as the authors' released code has it.
      Pixels predicted far away are then not counted, and a method with gross errors looks better.

    The caption of the paper's table says mean L1; text and code say median.

    Args:
        predicted: (..., h, w) floating.
        depth: (..., h, w) floating, the truth; 0 on the background.
        mask: (..., h, w) bool, pixels that may count; None allows all.
        center: depth of the middle of the evaluated range, world units.
        radius: half the range, world units.
        rule: "paper" or "release".

    Returns:
        `MedianDepthError`, one value per map. Nothing is differentiable. `DepthError` takes the mean over the views of
        a model, the models of a category, and the categories.

    Raises:
        ShapeError: shapes differ.
        DTypeError: a tensor is of another dtype.
        OptionError: ``radius`` is not above 0, or ``rule`` is unknown.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import median_depth_error
        >>> depth = torch.tensor([[1.8, 1.9, 2.0, 2.1, 0.0]])
        >>> predicted = torch.tensor([[1.81, 1.93, 4.0, 2.1, 3.0]])
        >>> float(median_depth_error(predicted, depth).error)  # of 0.01, 0.03, 2, 0
        0.02
        >>> float(median_depth_error(predicted, depth, rule="release").error)  # of 0.01, 0.03, 0
        0.01
    """
    who = "median_depth_error"
    middle = check_number(who, "center", center, "a number")
    reach = check_positive(who, "radius", radius)
    check_choice(who, "rule", rule, ("paper", "release"))
    p, d, _, counts = _compared(who, "depth", predicted, depth, mask)
    if rule == "paper":
        counts = counts & ((d - middle).abs() <= reach)
    else:
        counts = counts & (p > middle - reach) & (p < middle + reach)
    errors = torch.where(counts, (p - d).abs().nan_to_num(torch.inf, torch.inf), torch.inf).flatten(-2)
    return MedianDepthError(middle_of_lowest(errors, counts.flatten(-2).sum(-1)), counts.sum((-2, -1)))


def middle_of_lowest(values: Tensor, count: Tensor) -> Tensor:
    """The median of the ``count`` (...) lowest of (..., N) values, NaN where ``count`` is 0."""
    if values.shape[-1] == 0:
        return torch.full_like(count, torch.nan, dtype=values.dtype)
    ordered = values.sort(-1).values
    ends = torch.stack(((count - 1).div(2, rounding_mode="floor"), count // 2), -1).clamp(0, values.shape[-1] - 1)
    return torch.where(count > 0, ordered.gather(-1, ends).mean(-1), torch.nan)


def _compared(
    who: str, name: str, predicted: Tensor, depth: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Both depths in float64 (the true one 1 where it does not count), where truth exists, and which pixels count."""
    _check_maps(who, name, predicted, depth, mask)
    p, d = predicted.double(), depth.double()
    true = torch.isfinite(d) & (d > 0)
    true = true if mask is None else true & mask
    # A true depth of 0 or NaN must not reach a division, not even at a pixel that is left out.
    return p, torch.where(true, d, 1.0), true, true & (p != 0)


def _check_maps(who: str, name: str, predicted: Tensor, true: Tensor, mask: Tensor | None) -> None:
    check_float(who, "predicted", predicted, "(..., h, w)")
    if predicted.dim() < 2:
        raise ShapeError(f"{who}: predicted must be (..., h, w); got {tuple(predicted.shape)}")
    check_alike(who, "predicted", predicted, name, true, mask)


def check_alike(who: str, name: str, value: Tensor, other_name: str, other: Tensor, mask: Tensor | None) -> None:
    """Require a floating tensor, and a mask if any, of a first one's shape and on its device."""
    check_float(who, other_name, other, f"of the shape of {name}")
    shape = tuple(value.shape)
    if other.shape != shape:
        raise ShapeError(f"{who}: {other_name} must be of the shape of {name} = {shape}; got {tuple(other.shape)}")
    if mask is not None:
        check_mask(who, "mask", mask, shape, f"of the shape of {name}")
    check_devices(who, **{name: value, other_name: other}, mask=mask)
