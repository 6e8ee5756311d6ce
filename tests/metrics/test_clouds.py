"""Scores of point clouds, against all distances one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.metrics import point_cloud_scores

clouds = st.lists(st.tuples(*[st.integers(-3, 3)] * 3), max_size=12)


def as_cloud(points) -> np.ndarray:
    return 0.3 * np.array(points, dtype=np.float64).reshape(-1, 3)


def looped(predicted, true, threshold):
    """accuracy, completeness, precision, recall, F-score from the definitions."""

    def nearest(points, others):
        return [min((math.dist(point, other) for other in others), default=math.inf) for point in points]

    to_true, to_predicted = nearest(predicted, true), nearest(true, predicted)
    accuracy, completeness = (sum(d) / len(d) if d else math.nan for d in (to_true, to_predicted))
    precision, recall = (
        sum(distance < threshold for distance in d) / len(d) if d else math.nan for d in (to_true, to_predicted)
    )
    if not to_true and not to_predicted:
        return accuracy, completeness, precision, recall, math.nan
    f_score = 2 * precision * recall / (precision + recall) if precision > 0 and recall > 0 else 0.0
    return accuracy, completeness, precision, recall, f_score


@given(clouds, clouds)
def test_scores_are_those_of_a_loop(first, second):
    predicted, true = as_cloud(first), as_cloud(second)
    # No distance in this lattice is near 0.5: its squares are 0.09 times whole numbers.
    found = point_cloud_scores(predicted, true, 0.5)
    np.testing.assert_allclose(found, looped(predicted, true, 0.5), rtol=1e-12, atol=1e-14)


@given(clouds, clouds)
def test_exchanged_clouds_exchange_the_directions(first, second):
    one, two = (
        point_cloud_scores(as_cloud(first), as_cloud(second), 0.5),
        point_cloud_scores(as_cloud(second), as_cloud(first), 0.5),
    )
    np.testing.assert_equal((one.accuracy, one.precision), (two.completeness, two.recall))
    np.testing.assert_allclose(one.f_score, two.f_score, rtol=1e-15)


def test_a_distance_at_the_threshold_is_not_within_it():
    scores = point_cloud_scores(np.zeros((1, 3)), np.array([[0.5, 0, 0]]), 0.5)
    assert scores == (0.5, 0.5, 0.0, 0.0, 0.0)
    assert point_cloud_scores(np.zeros((1, 3)), np.array([[0.5, 0, 0]]), 0.500001).f_score == 1.0


def test_empty_clouds():
    some, none = np.zeros((2, 3)), np.zeros((0, 3))
    np.testing.assert_equal(tuple(point_cloud_scores(none, some, 1.0)), (math.nan, math.inf, math.nan, 0.0, 0.0))
    np.testing.assert_equal(tuple(point_cloud_scores(some, none, 1.0)), (math.inf, math.nan, 0.0, math.nan, 0.0))
    np.testing.assert_equal(tuple(point_cloud_scores(none, none, 1.0, cell=0.1)), (math.nan,) * 5)


def test_tensors_and_arrays_of_any_dtype_are_the_same():
    generator = np.random.default_rng(7)
    predicted, true = (generator.integers(-8, 8, (30, 3)) / 4 for _ in range(2))
    expected = point_cloud_scores(predicted, true, 0.6)
    for kind in (torch.float16, torch.float32, torch.float64):
        assert point_cloud_scores(torch.from_numpy(predicted).to(kind).requires_grad_(), true, 0.6) == expected
    assert point_cloud_scores(predicted.astype(np.float32), torch.from_numpy(true), 0.6) == expected


def test_points_of_one_cell_are_averaged_first():
    """A place that is seen a hundred times counts as often as one that is seen once."""
    generator = np.random.default_rng(8)
    true = np.array([[0.5, 0.5, 0.5], [-1.5, 2.5, 0.5]])
    crowd = true[0] + generator.uniform(-0.4, 0.4, (100, 3))
    predicted = np.concatenate((crowd, [[5.5, 5.5, 5.5]]))
    plain, averaged = point_cloud_scores(predicted, true, 0.7), point_cloud_scores(predicted, true, 0.7, cell=1.0)
    assert plain.precision == pytest.approx(100 / 101)
    assert averaged.precision == 0.5
    far = min(math.dist((5.5, 5.5, 5.5), point) for point in true)
    assert averaged.accuracy == pytest.approx((np.linalg.norm(crowd.mean(0) - true[0]) + far) / 2, rel=1e-12)


POINTS = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda: point_cloud_scores(np.zeros((2, 2)), POINTS, 1.0), ShapeError, "predicted"),
        (lambda: point_cloud_scores(POINTS, np.zeros(3), 1.0), ShapeError, "true"),
        (lambda: point_cloud_scores(POINTS, [[0, 0, 0]], 1.0), DTypeError, "true"),
        (lambda: point_cloud_scores(POINTS.astype(bool), POINTS, 1.0), DTypeError, "predicted"),
        (lambda: point_cloud_scores(POINTS, POINTS + np.nan, 1.0), OptionError, "true"),
        (lambda: point_cloud_scores(POINTS, POINTS, 0.0), OptionError, "threshold"),
        (lambda: point_cloud_scores(POINTS, POINTS, 1.0, cell=-1.0), OptionError, "cell"),
    ],
)
def test_errors_name_the_argument(call, error, named):
    with pytest.raises(error, match=f"point_cloud_scores: {named} must"):
        call()
