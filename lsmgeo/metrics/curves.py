"""Error against density: the error of the most confident pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_float, check_number, describe
from lsmgeo.errors import DTypeError, OptionError
from lsmgeo.metrics.depth import check_alike, middle_of_lowest

__all__ = ["DensityCurve", "RunningDensityCurve", "density_curve"]

STATISTICS = ("median", "mean", "bad")


class DensityCurve(NamedTuple):
    """The error of the most confident pixels at several densities; each (K,)."""

    density: Tensor  # float64, the share actually kept: pixels of equal confidence are kept or dropped together
    error: Tensor  # float64, NaN where too few pixels have a confidence
    pixels: Tensor  # int64, the number kept


@torch.no_grad()
def density_curve(
    errors: Tensor,
    confidence: Tensor,
    densities: Sequence[float],
    mask: Tensor | None = None,
    *,
    statistic: str = "median",
    threshold: float | None = None,
) -> DensityCurve:
    """Measure the error of the most confident pixels, for several densities.

    Equation: at density d of n pixels that count, the statistic of the errors of the pixels whose confidence is at
    least that of the ``ceil(d n)``-th in descending order. Pixels of equal confidence are kept or dropped together, so
    that the order of the pixels does not matter; the resulting density is reported.

    Convention: a confidence that is 0, negative or NaN means that the pixel has no prediction. It still counts among n:
    density is a share of the pixels with ground truth.

    Args:
        errors: floating, of any shape, at least 0; all pixels form one set. NaN counts as infinite.
        confidence: floating, of the same shape.
        densities: in (0, 1].
        mask: bool, of the same shape: the pixels with ground truth; None for all.
        statistic: "median", "mean", or "bad": the share of errors above the threshold.
        threshold: for "bad", in the units of the errors.

    Returns:
        `DensityCurve`. Nothing is differentiable.

    Raises:
        ShapeError: shapes differ.
        DTypeError: a tensor is of another dtype.
        OptionError: a density outside (0, 1], an unknown statistic, a threshold that is missing, or given
            for another statistic.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import density_curve
        >>> errors = torch.tensor([0.1, 0.2, 0.4, 0.8])
        >>> confidence = torch.tensor([0.9, 0.8, 0.5, 0.0])
        >>> curve = density_curve(errors, confidence, (0.25, 0.5, 0.75, 1.0), statistic="mean")
        >>> curve.error
        tensor([0.1000, 0.1500, 0.2333, nan], dtype=torch.float64)
    """
    who = "density_curve"
    wanted, limit = _check_options(who, densities, statistic, threshold)
    return _curve(*_taken(who, errors, confidence, mask), wanted, statistic, limit)


class RunningDensityCurve:
    """A density curve over many maps, accumulated one by one.

    It keeps an error and a confidence for every pixel that counts, 16 bytes. `compute` equals `density_curve` on all
    maps at once, in any order.

    Args:
        densities: in (0, 1].
        statistic: as in `density_curve`.
        threshold: as in `density_curve`.

    Raises:
        OptionError: as in `density_curve`.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import RunningDensityCurve
        >>> curve = RunningDensityCurve((0.5, 1.0), statistic="bad", threshold=0.3)
        >>> curve.update(torch.tensor([[0.1, 0.5]]), torch.tensor([[0.9, 0.2]]))
        >>> curve.update(torch.tensor([[0.2, 0.4]]), torch.tensor([[0.8, 0.1]]))
        >>> curve.compute().error
        tensor([0.0000, 0.5000], dtype=torch.float64)
    """

    def __init__(self, densities: Sequence[float], *, statistic: str = "median", threshold: float | None = None):
        self.densities, self.threshold = _check_options("RunningDensityCurve", densities, statistic, threshold)
        self.statistic = statistic
        self._parts: list[tuple[Tensor, Tensor]] = []

    def update(self, errors: Tensor, confidence: Tensor, mask: Tensor | None = None) -> None:
        """Add the pixels of more maps; arguments as in `density_curve`."""
        errors, confidence = _taken("RunningDensityCurve.update", errors, confidence, mask)
        self._parts.append((errors.cpu(), confidence.cpu()))

    def merge(self, other: RunningDensityCurve) -> None:
        """Add the pixels of another curve, for instance of another process.

        Raises:
            OptionError: its options differ.
        """
        mine, theirs = ((c.densities, c.statistic, c.threshold) for c in (self, other))
        if mine != theirs:
            raise OptionError(f"RunningDensityCurve.merge: other must have the options {mine}; got {theirs}")
        self._parts += other._parts

    def compute(self) -> DensityCurve:
        """The curve of all pixels so far."""
        empty = torch.zeros(0, dtype=torch.float64)
        errors, confidence = (torch.cat([empty, *(part[i] for part in self._parts)]) for i in (0, 1))
        return _curve(errors, confidence, self.densities, self.statistic, self.threshold)


def _check_options(
    who: str, densities: Sequence[float], statistic: str, threshold: float | None
) -> tuple[tuple[float, ...], float | None]:
    """The densities and the threshold as Python numbers."""
    expected = "numbers in (0, 1]"
    if isinstance(densities, Tensor) or not isinstance(densities, Iterable):
        raise DTypeError(f"{who}: densities must be {expected}; got {describe(densities)}")
    wanted = tuple(check_number(who, "densities", density, expected) for density in densities)
    if not all(0 < density <= 1 for density in wanted):
        raise OptionError(f"{who}: densities must be {expected}; got {wanted}")
    check_choice(who, "statistic", statistic, STATISTICS)
    if (statistic == "bad") != (threshold is not None):
        raise OptionError(f"{who}: threshold goes with statistic='bad'; got {describe(threshold)} with {statistic!r}")
    if threshold is None:
        return wanted, None
    return wanted, check_number(who, "threshold", threshold, "at least 0", 0)


def _taken(who: str, errors: Tensor, confidence: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Errors and confidences (N,) in float64 of the pixels that count."""
    check_float(who, "errors", errors, "of any shape")
    check_alike(who, "errors", errors, "confidence", confidence, mask)
    if mask is not None:
        errors, confidence = errors[mask], confidence[mask]
    return errors.double().flatten().nan_to_num(torch.inf, torch.inf), confidence.double().flatten().nan_to_num(0.0)


def _curve(
    errors: Tensor, confidence: Tensor, densities: tuple[float, ...], statistic: str, threshold: float | None
) -> DensityCurve:
    number = len(errors)
    confidence, order = confidence.sort(descending=True)
    errors = errors[order]
    answered = int((confidence > 0).sum())
    # Where pixels of equal confidence end; searchsorted needs ascending values.
    ascending = (-confidence[:answered]).contiguous()
    kept, found = [], []
    for density in densities:
        # In floats 0.07 * 100 is above 7.
        wanted = max(1, math.ceil(density * number - 1e-9 * number))
        enough = number > 0 and wanted <= answered
        count = int(torch.searchsorted(ascending, ascending[wanted - 1], right=True)) if enough else 0
        kept.append(count)
        found.append(_statistic(errors[:count], statistic, threshold))
    pixels = torch.tensor(kept, dtype=torch.int64)
    return DensityCurve(pixels.double() / max(number, 1), torch.tensor(found, dtype=torch.float64), pixels)


def _statistic(errors: Tensor, statistic: str, threshold: float | None) -> float:
    if statistic == "median":
        return float(middle_of_lowest(errors, torch.tensor(len(errors), device=errors.device)))
    return float(errors.mean() if threshold is None else (errors > threshold).double().mean())
