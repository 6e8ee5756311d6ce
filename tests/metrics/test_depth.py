"""Errors of depth maps, against loops over the pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.metrics import bad_pixel_rate, depth_errors, median_depth_error

SIZE = (3, 5)
# Depths as they come: none, several ordinary ones with ties among the errors, something else than a number.
drawn = st.lists(
    st.sampled_from([0.0, 0.5, 1.2, 1.9, 2.0, 2.1, 2.5, 2.8, 3.4, math.inf, math.nan]), min_size=15, max_size=15
)
finite = st.lists(st.sampled_from([0.0, 0.5, 1.2, 1.9, 2.0, 2.1, 2.5, 2.8, 3.4, -1.0]), min_size=15, max_size=15)
masks = st.lists(st.booleans(), min_size=15, max_size=15)


def as_map(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(SIZE)


def has_depth(value: float) -> bool:
    return math.isfinite(value) and value > 0


def looped(predicted, depth, mask) -> dict[str, float]:
    """The definitions, pixel by pixel."""
    there = [(p, d) for p, d, m in zip(predicted, depth, mask, strict=True) if m and has_depth(d)]
    pairs = [(p, d) for p, d in there if p != 0]
    if not pairs:
        nothing = dict.fromkeys(("l1", "abs_rel", "rmse", "delta1", "delta2", "delta3"), math.nan)
        return {**nothing, "density": 0.0 if there else math.nan, "pixels": 0}
    ratios = [max(p / d, d / p) if p > 0 else math.inf for p, d in pairs]
    return {
        "l1": sum(abs(p - d) for p, d in pairs) / len(pairs),
        "abs_rel": sum(abs(p - d) / d for p, d in pairs) / len(pairs),
        "rmse": math.sqrt(sum((p - d) ** 2 for p, d in pairs) / len(pairs)),
        "delta1": sum(ratio < 1.25 for ratio in ratios) / len(pairs),
        "delta2": sum(ratio < 1.25**2 for ratio in ratios) / len(pairs),
        "delta3": sum(ratio < 1.25**3 for ratio in ratios) / len(pairs),
        "density": len(pairs) / len(there),
        "pixels": len(pairs),
    }


@given(finite, drawn, masks)
def test_errors_are_those_of_a_loop(predicted, depth, mask):
    found = depth_errors(as_map(predicted), as_map(depth), torch.tensor(mask).reshape(SIZE))
    expected = looped(predicted, depth, mask)
    for name, value in expected.items():
        np.testing.assert_allclose(float(getattr(found, name)), value, rtol=1e-13, err_msg=name)


@given(finite, drawn, masks, st.floats(-1e6, 1e6))
def test_what_the_mask_hides_does_not_matter(predicted, depth, mask, other):
    hidden = ~torch.tensor(mask).reshape(SIZE)
    first = depth_errors(as_map(predicted), as_map(depth), ~hidden)
    second = depth_errors(as_map(predicted).masked_fill(hidden, other), as_map(depth).masked_fill(hidden, 7.0), ~hidden)
    for one, two in zip(first, second, strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)


def test_known_errors():
    depth = torch.tensor([[2.0, 4.0, 1.0, 0.0]])
    found = depth_errors(torch.tensor([[3.4, 3.0, 1.0, 9.0]]), depth)
    assert float(found.l1) == pytest.approx(2.4 / 3)
    assert float(found.abs_rel) == pytest.approx((0.7 + 0.25) / 3)
    assert float(found.rmse) == pytest.approx(math.sqrt((1.4**2 + 1) / 3))
    assert [float(found.delta1), float(found.delta2), float(found.delta3)] == pytest.approx([1 / 3, 2 / 3, 1.0])


def test_a_ratio_at_the_limit_is_not_within_it():
    assert float(depth_errors(torch.tensor([[1.25]]), torch.tensor([[1.0]])).delta1) == 0.0
    assert float(depth_errors(torch.tensor([[1.0]]), torch.tensor([[1.25]])).delta1) == 0.0


def test_without_a_pixel_that_counts_there_is_no_error_and_no_warning():
    for shape in ((2, 3), (0, 3), (4, 2, 0)):
        empty = torch.zeros(shape)
        found = depth_errors(empty, empty)
        assert found.l1.isnan().all()
        assert found.delta1.isnan().all()
        assert int(found.pixels.sum()) == 0
        assert median_depth_error(empty, empty).error.isnan().all()
        assert bad_pixel_rate(empty, empty, 1.0).rate.isnan().all()


def test_a_prediction_that_is_nan_is_no_good_one():
    predicted, depth = torch.tensor([[torch.nan, 2.0, 2.0]]), torch.full((1, 3), 2.0)
    assert math.isnan(float(depth_errors(predicted, depth).l1))
    assert float(depth_errors(predicted, depth).delta1) == pytest.approx(2 / 3)
    assert float(median_depth_error(predicted, depth).error) == 0.0
    assert float(median_depth_error(predicted[:, :1], depth[:, :1]).error) == math.inf
    assert float(bad_pixel_rate(predicted, depth, 1.0, missing="bad").rate) == pytest.approx(1 / 3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_every_dtype_is_measured_in_float64(dtype):
    predicted, depth = torch.tensor([[2.5, 1.0]], dtype=dtype), torch.tensor([[2.0, 3.0]])
    found = depth_errors(predicted, depth)
    assert found.l1.dtype == torch.float64
    assert float(found.l1) == 1.25


@given(finite, drawn, masks, st.sampled_from([0.0, 0.1, 0.5, 1.0]), st.sampled_from(["skip", "bad"]))
def test_bad_pixels_are_those_of_a_loop(predicted, true, mask, threshold, missing):
    counted = bad = answered = there = 0
    for p, t, m in zip(predicted, true, mask, strict=True):
        if not m or not math.isfinite(t) or t == 0:
            continue
        there += 1
        answered += p != 0
        if p != 0 or missing == "bad":
            counted += 1
            bad += p == 0 or abs(p - t) > threshold
    found = bad_pixel_rate(
        as_map(predicted), as_map(true), threshold, torch.tensor(mask).reshape(SIZE), missing=missing
    )
    assert int(found.pixels) == counted
    np.testing.assert_equal(float(found.rate), bad / counted if counted else math.nan)
    np.testing.assert_equal(float(found.density), answered / there if there else math.nan)


@given(finite, drawn, masks, st.sampled_from(["paper", "release"]))
def test_the_median_is_that_of_the_pixels_in_range(predicted, depth, mask, rule):
    radius = math.sqrt(3) / 2
    errors = []
    for p, d, m in zip(predicted, depth, mask, strict=True):
        if not m or p == 0 or not has_depth(d):
            continue
        within = abs(d - 2) <= radius if rule == "paper" else 2 - radius < p < 2 + radius
        if within:
            errors.append(abs(p - d))
    found = median_depth_error(as_map(predicted), as_map(depth), torch.tensor(mask).reshape(SIZE), rule=rule)
    expected = np.median(errors) if errors else math.nan
    np.testing.assert_allclose(float(found.error), expected, rtol=1e-14)
    assert int(found.pixels) == len(errors)


def test_every_map_has_a_median_of_its_own():
    generator = np.random.default_rng(5)
    depth = generator.uniform(1.5, 2.5, (2, 3, 7, 9))
    predicted = depth + generator.normal(0, 0.1, depth.shape)
    depth[generator.uniform(size=depth.shape) < 0.3] = 0
    found = median_depth_error(torch.from_numpy(predicted), torch.from_numpy(depth)).error
    for b in range(2):
        for v in range(3):
            there = depth[b, v] > 0
            expected = np.median(np.abs(predicted[b, v] - depth[b, v])[there])
            np.testing.assert_allclose(float(found[b, v]), expected, rtol=1e-14)


def test_the_two_rules_differ_where_the_prediction_is_far_off():
    depth, predicted = torch.full((1, 4), 2.0), torch.tensor([[2.1, 9.0, 9.0, 9.0]])
    assert float(median_depth_error(predicted, depth).error) == pytest.approx(7.0)
    assert float(median_depth_error(predicted, depth, rule="release").error) == pytest.approx(0.1)
    far = torch.full((1, 4), 3.0)
    assert int(median_depth_error(predicted, far).pixels) == 0
    assert int(median_depth_error(predicted, far, rule="release").pixels) == 1
    assert int(median_depth_error(predicted, far, center=3.0, radius=1e-9).pixels) == 4


MAP = torch.ones(2, 3)


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda: depth_errors(torch.ones(3), torch.ones(3)), ShapeError, "predicted"),
        (lambda: depth_errors(MAP, torch.ones(3, 2)), ShapeError, "depth"),
        (lambda: depth_errors(MAP, torch.ones(1, 2, 3)), ShapeError, "depth"),
        (lambda: depth_errors(MAP.long(), MAP), DTypeError, "predicted"),
        (lambda: depth_errors(MAP, MAP.numpy()), DTypeError, "depth"),
        (lambda: depth_errors(MAP, MAP, MAP), DTypeError, "mask"),
        (lambda: depth_errors(MAP, MAP, torch.ones(2, 2, dtype=torch.bool)), ShapeError, "mask"),
        (lambda: bad_pixel_rate(MAP, MAP[:1], 1.0), ShapeError, "true"),
        (lambda: bad_pixel_rate(MAP, MAP, -1.0), OptionError, "threshold"),
        (lambda: bad_pixel_rate(MAP, MAP, 1.0, missing="good"), OptionError, "missing"),
        (lambda: median_depth_error(MAP, MAP, radius=0), OptionError, "radius"),
        (lambda: median_depth_error(MAP, MAP, center=math.inf), OptionError, "center"),
        (lambda: median_depth_error(MAP, MAP, rule="mean"), OptionError, "rule"),
    ],
)
def test_errors_name_the_argument(call, error, named):
    with pytest.raises(error, match=f": {named} must"):
        call()
