"""Measures of whole sets, which come in parts."""

from __future__ import annotations

import functools
import itertools
import math
import pickle
import statistics

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.metrics import (
    DepthError,
    Running,
    VoxelIoU,
    category_means,
    depth_errors,
    median_depth_error,
    point_cloud_scores,
    voxel_iou,
)

NAMES = ["car", "chair", "lamp"]
models = st.lists(st.tuples(st.one_of(st.floats(0, 1e6), st.just(math.nan)), st.sampled_from(NAMES)), max_size=20)


@given(models)
def test_means_are_of_categories_first(seen):
    values, names = [value for value, _ in seen], [name for _, name in seen]
    found = category_means(values, names)
    expected = {}
    for name in sorted(set(names)):
        counted = [value for value, owner in seen if owner == name and not math.isnan(value)]
        expected[name] = statistics.fmean(counted) if counted else math.nan
        assert found.counts[name] == len(counted)
    np.testing.assert_equal(found.categories, expected)
    means = [mean for mean in expected.values() if not math.isnan(mean)]
    np.testing.assert_equal(found.mean, statistics.fmean(means) if means else math.nan)


def random_models(number: int, seed: int = 0):
    generator = np.random.default_rng(seed)
    predicted = torch.from_numpy(generator.uniform(size=(number, 3, 4, 2)))
    truth = torch.from_numpy(generator.uniform(size=(number, 3, 4, 2)) < 0.5)
    return predicted, truth, [NAMES[k] for k in generator.integers(0, 3, number)]


def random_depths(number: int, seed: int = 1):
    generator = np.random.default_rng(seed)
    depth = generator.uniform(1.2, 2.8, (number, 3, 4, 5))
    predicted = depth + generator.normal(0, 0.2, depth.shape)
    depth[generator.uniform(size=depth.shape) < 0.4] = 0
    depth[0, 1], depth[1] = 0, 0  # a view and a model in which nothing counts
    return torch.from_numpy(predicted), torch.from_numpy(depth), [NAMES[k] for k in generator.integers(0, 3, number)]


@functools.cache
def looped_depth_error(rule: str) -> dict[str, float]:
    """Of each category of `random_depths`, from the medians of single maps."""
    predicted, depth, names = random_depths(9)
    expected = {}
    for name in sorted(set(names)):
        of_models = []
        for b in range(9):
            medians = [float(median_depth_error(predicted[b, v], depth[b, v], rule=rule).error) for v in range(3)]
            medians = [median for median in medians if not math.isnan(median)]
            if names[b] == name and medians:
                of_models.append(statistics.fmean(medians))
        expected[name] = statistics.fmean(of_models)
    return expected


# Cuts of nine models into parts, one for each of two processes.
cuts = st.lists(st.integers(0, 9), max_size=4).map(lambda places: [0, *sorted(places), 9])


@settings(max_examples=max(10, settings.default.max_examples // 4))
@given(cuts, st.randoms(use_true_random=False))
def test_voxel_iou_in_parts_is_that_of_the_whole(places, random):
    predicted, truth, names = random_models(9)
    expected = category_means(voxel_iou(predicted, truth, threshold=0.5), names)
    processes = [VoxelIoU(threshold=0.5) for _ in range(2)]
    parts = [slice(*ends) for ends in itertools.pairwise(places)]
    random.shuffle(parts)
    for part in parts:
        random.choice(processes).update(predicted[part], truth[part], names[part])
    whole = pickle.loads(pickle.dumps(processes[1]))
    whole.merge(processes[0])
    assert whole.compute() == expected


@settings(max_examples=max(10, settings.default.max_examples // 4))
@given(cuts, st.randoms(use_true_random=False), st.sampled_from(["paper", "release"]))
def test_depth_error_in_parts_is_that_of_the_whole(places, random, rule):
    predicted, depth, names = random_depths(9)
    expected = looped_depth_error(rule)
    processes = [DepthError(rule=rule) for _ in range(2)]
    parts = [slice(*ends) for ends in itertools.pairwise(places)]
    random.shuffle(parts)
    for part in parts:
        random.choice(processes).update(predicted[part], depth[part], names[part])
    processes[0].merge(processes[1])
    found = processes[0].compute()
    assert sum(found.counts.values()) == 8
    assert list(found.categories) == list(expected)
    np.testing.assert_allclose(list(found.categories.values()), list(expected.values()), rtol=1e-14)
    np.testing.assert_allclose(found.mean, statistics.fmean(expected.values()), rtol=1e-14)


def test_any_measure_can_run():
    predicted, depth, names = random_depths(9)
    errors = Running(depth_errors)
    for part in (slice(0, 4), slice(4, 9)):
        errors.update(predicted[part, 0], depth[part, 0], categories=names[part])
    whole = depth_errors(predicted[:, 0], depth[:, 0])
    found = errors.compute()
    assert set(found) == set(whole._fields)
    for field in whole._fields:
        assert found[field] == category_means(getattr(whole, field), names), field

    clouds = Running(point_cloud_scores, threshold=0.2)
    clouds.update(np.zeros((1, 3)), np.zeros((1, 3)), categories="car")
    clouds.update(np.zeros((1, 3)), np.ones((1, 3)), categories="car")
    other = Running(point_cloud_scores, threshold=0.2)
    other.update(np.zeros((1, 3)), np.zeros((1, 3)), categories="lamp")
    clouds.merge(pickle.loads(pickle.dumps(other)))
    assert clouds.compute()["f_score"] == (0.75, {"car": 0.5, "lamp": 1.0}, {"car": 2, "lamp": 1})
    assert Running(voxel_iou).compute() == {}


def test_nothing_seen_has_no_mean():
    for running in (VoxelIoU(), DepthError()):
        found = running.compute()
        assert math.isnan(found.mean)
        assert found[1:] == ({}, {})


def test_errors_name_the_argument():
    predicted, truth, _ = random_models(2)
    with pytest.raises(ShapeError, match=r"VoxelIoU.update: predicted must be \(B, D, H, W\)"):
        VoxelIoU().update(predicted[0], truth[0])
    with pytest.raises(ShapeError, match=r"VoxelIoU.update: categories must be as many names as values, 2; got 1"):
        VoxelIoU().update(predicted, truth, ["car"])
    with pytest.raises(ShapeError, match=r"DepthError.update: predicted must be \(B, V, h, w\)"):
        DepthError().update(torch.ones(2, 3, 4), torch.ones(2, 3, 4))
    with pytest.raises(ShapeError, match=r"category_means: categories must be as many names as values, 2; got 1"):
        category_means([0.1, 0.2], ["car"])
    with pytest.raises(DTypeError, match=r"VoxelIoU.update: categories must be names; got NoneType None"):
        VoxelIoU().update(predicted, truth, ["car", None])
    with pytest.raises(OptionError, match=r"VoxelIoU.merge: other must have the options"):
        VoxelIoU().merge(VoxelIoU(threshold=0.75))
    with pytest.raises(OptionError, match=r"DepthError.merge: other must have"):
        DepthError().merge(DepthError(rule="release"))
    with pytest.raises(OptionError, match=r"Running.merge: other must measure"):
        Running(voxel_iou, threshold=0.4).merge(Running(voxel_iou, threshold=0.75))
    with pytest.raises(OptionError, match="median_depth_error: rule must be"):
        DepthError(rule="mean")


def test_a_failed_update_leaves_nothing_behind():
    predicted, truth, names = random_models(3)
    iou = VoxelIoU()
    iou.update(predicted, truth, names)
    before = iou.compute()
    with pytest.raises(ShapeError):
        iou.update(predicted, truth, names[:2])
    assert iou.compute() == before
