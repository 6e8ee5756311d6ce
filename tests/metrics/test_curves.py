"""Curves of error against density, against sorting in Python."""

from __future__ import annotations

import math
import statistics
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.metrics import RunningDensityCurve, density_curve

# Hundredths as fractions, so that the loop knows how many pixels a density is without rounding.
DENSITIES = [Fraction(k, 100) for k in (1, 7, 10, 33, 50, 75, 100)]
pixels = st.lists(
    st.tuples(
        st.sampled_from([0.0, 0.1, 0.2, 0.7, 1.5, 4.0]), st.sampled_from([0.0, 0.1, 0.5, 0.6, 0.9, -1.0]), st.booleans()
    ),
    max_size=40,
)


def looped(seen, density: Fraction, statistic: str) -> tuple[int, float]:
    """How many pixels are kept, and the statistic of their errors."""
    true = [(confidence, error) for error, confidence, counts in seen if counts]
    answered = sorted((pair for pair in true if pair[0] > 0), reverse=True)
    wanted = max(1, math.ceil(density * len(true)))
    if not true or wanted > len(answered):
        return 0, math.nan
    least = answered[wanted - 1][0]
    errors = [error for confidence, error in answered if confidence >= least]
    if statistic == "median":
        return len(errors), statistics.median(errors)
    if statistic == "mean":
        return len(errors), statistics.fmean(errors)
    return len(errors), sum(error > 0.7 for error in errors) / len(errors)


def arrays(seen):
    errors, confidence, counts = zip(*seen, strict=True) if seen else ((), (), ())
    kinds = (torch.float64, torch.float32, torch.bool)
    return [torch.tensor(values, dtype=kind) for values, kind in zip((errors, confidence, counts), kinds, strict=True)]


@given(pixels, st.sampled_from(["median", "mean", "bad"]))
def test_the_curve_is_that_of_a_loop(seen, statistic):
    errors, confidence, counts = arrays(seen)
    options = {"statistic": statistic, "threshold": 0.7 if statistic == "bad" else None}
    found = density_curve(errors, confidence, [float(density) for density in DENSITIES], counts, **options)
    for k, density in enumerate(DENSITIES):
        kept, expected = looped(seen, density, statistic)
        assert int(found.pixels[k]) == kept
        np.testing.assert_allclose(float(found.error[k]), expected, rtol=1e-13)
        np.testing.assert_allclose(float(found.density[k]), kept / max(1, int(counts.sum())), rtol=1e-15)


@settings(max_examples=max(10, settings.default.max_examples // 4))
@given(pixels, st.randoms(use_true_random=False))
def test_parts_in_any_order_give_the_curve_of_the_whole(seen, random):
    densities = [float(density) for density in DENSITIES]
    expected = density_curve(*arrays(seen)[:2], densities, arrays(seen)[2])
    shuffled = list(seen)
    random.shuffle(shuffled)
    cut = len(seen) // 3
    here, there = RunningDensityCurve(densities), RunningDensityCurve(densities)
    for curve, part in ((here, shuffled[:cut]), (there, shuffled[cut:])):
        errors, confidence, counts = arrays(part)
        curve.update(errors, confidence, counts)
    here.merge(there)
    for one, two in zip(here.compute(), expected, strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)


def test_hundredths_are_counted_as_hundredths():
    """7 % of 100 pixels are 7, though 0.07 * 100 is a little more in floating point."""
    errors = torch.arange(100.0)
    found = density_curve(errors, 1 / (1 + errors), [k / 100 for k in range(1, 101)], statistic="mean")
    assert found.pixels.tolist() == list(range(1, 101))
    np.testing.assert_allclose(found.error.numpy(), np.arange(100) / 2, rtol=1e-15)


def test_without_a_choice_all_answers_are_kept_together():
    """A matcher that says only where it has an answer: every density that it reaches is the one it has."""
    errors, confidence = torch.tensor([0.0, 3.0, 0.0, 3.0, 9.0]), torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0])
    found = density_curve(errors, confidence, (0.1, 0.8, 0.9), statistic="mean")
    assert found.density.tolist() == [0.8, 0.8, 0.0]
    assert found.error[:2].tolist() == [1.5, 1.5]
    assert math.isnan(float(found.error[2]))


def test_an_error_that_is_no_number_is_infinite_and_a_confidence_that_is_none_is_no_answer():
    errors = torch.tensor([torch.nan, 1.0, 2.0])
    assert float(density_curve(errors, torch.tensor([0.9, 0.8, 0.1]), (1 / 3,)).error[0]) == math.inf
    assert density_curve(errors, torch.tensor([torch.nan, 0.8, 0.1]), (2 / 3, 1.0)).error[0] == 1.5
    assert density_curve(errors, torch.ones(3), (1.0,), statistic="bad", threshold=1.5).error[0] == 2 / 3


def test_nothing_seen_is_no_error():
    found = RunningDensityCurve((0.5, 1.0)).compute()
    assert found.error.isnan().all()
    assert found.pixels.tolist() == [0, 0]


ONES = torch.ones(4)


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda: density_curve(ONES, torch.ones(2, 2), (0.5,)), ShapeError, "confidence"),
        (lambda: density_curve(ONES, ONES, (0.5,), torch.ones(3, dtype=torch.bool)), ShapeError, "mask"),
        (lambda: density_curve(ONES.long(), ONES, (0.5,)), DTypeError, "errors"),
        (lambda: density_curve(ONES, ONES, (0.0,)), OptionError, "densities"),
        (lambda: density_curve(ONES, ONES, (0.5, 1.1)), OptionError, "densities"),
        (lambda: density_curve(ONES, ONES, ("all",)), OptionError, "densities"),
        (lambda: density_curve(ONES, ONES, (1.0,), statistic="worst"), OptionError, "statistic"),
        (lambda: density_curve(ONES, ONES, (1.0,), statistic="bad"), OptionError, "threshold"),
        (lambda: density_curve(ONES, ONES, (1.0,), threshold=1.0), OptionError, "threshold"),
        (lambda: RunningDensityCurve((1.0,)).merge(RunningDensityCurve((0.5,))), OptionError, "other"),
    ],
)
def test_errors_name_the_argument(call, error, named):
    with pytest.raises(error, match=f": {named} must|{named} goes with"):
        call()
