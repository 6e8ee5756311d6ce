"""Overlap of voxel grids, against sets of cells and loops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo.errors import DeviceError, DTypeError, OptionError, ShapeError
from lsmgeo.metrics import VoxelIoU, voxel_iou

SHAPE = (3, 2, 4)
cells = st.sets(st.sampled_from(list(itertools.product(*map(range, SHAPE)))))


def grid(members) -> torch.Tensor:
    solid = torch.zeros(SHAPE, dtype=torch.bool)
    for place in members:
        solid[place] = True
    return solid


def overlap(first, second) -> float:
    """The same of Python's sets."""
    return len(first & second) / len(first | second) if first | second else 1.0


@given(cells, cells)
def test_it_is_the_overlap_of_sets(first, second):
    found = float(voxel_iou(grid(first), grid(second)))
    assert found == overlap(first, second)
    assert 0 <= found <= 1
    assert found == float(voxel_iou(grid(second), grid(first)))
    assert float(voxel_iou(grid(first), grid(first))) == 1.0


@given(cells, cells, cells)
def test_a_cell_that_is_right_never_lowers_it_and_a_wrong_one_never_raises_it(predicted, truth, more):
    before = float(voxel_iou(grid(predicted), grid(truth)))
    assert float(voxel_iou(grid(predicted | (more & truth)), grid(truth))) >= before
    if predicted | truth:
        assert float(voxel_iou(grid(predicted | (more - truth)), grid(truth))) <= before


def test_two_empty_grids_agree_and_an_empty_one_shares_nothing():
    assert float(voxel_iou(grid(()), grid(()))) == 1.0
    assert float(voxel_iou(grid(()), grid({(0, 0, 0)}))) == 0.0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_probabilities_are_cut_above_the_threshold(dtype):
    generator = np.random.default_rng(3)
    probabilities = torch.from_numpy(generator.uniform(size=(2, 3, *SHAPE))).to(dtype)
    truth = torch.from_numpy(generator.uniform(size=(2, 3, *SHAPE)) < 0.4)
    expected = np.zeros((2, 3))
    for b, v in itertools.product(range(2), range(3)):
        shared = union = 0
        for place in itertools.product(*map(range, SHAPE)):
            inside = float(probabilities[(b, v, *place)]) > 0.75
            shared += inside and bool(truth[(b, v, *place)])
            union += inside or bool(truth[(b, v, *place)])
        expected[b, v] = shared / union
    found = voxel_iou(probabilities, truth, threshold=0.75)
    np.testing.assert_array_equal(found.numpy(), expected)


def test_a_probability_at_the_threshold_is_empty_and_so_is_nan():
    probabilities = torch.tensor([0.5, torch.nan, 0.51]).reshape(1, 1, 3)
    truth = torch.tensor([False, False, True]).reshape(1, 1, 3)
    assert float(voxel_iou(probabilities, truth, threshold=0.5)) == 1.0


def test_no_grids_and_strided_grids():
    assert voxel_iou(torch.zeros(0, *SHAPE), torch.zeros(0, *SHAPE, dtype=torch.bool)).shape == (0,)
    generator = np.random.default_rng(4)
    wide = torch.from_numpy(generator.uniform(size=(4, 8, 6)))
    truth = torch.from_numpy(generator.uniform(size=(4, 8, 6)) < 0.5)
    strided, straight = wide[::2, ::3].transpose(0, 2), wide[::2, ::3].transpose(0, 2).contiguous()
    other = truth[::2, ::3].transpose(0, 2)
    assert float(voxel_iou(strided, other)) == float(voxel_iou(straight, other.contiguous()))


@pytest.mark.parametrize(
    ("predicted", "occupancy", "threshold", "error", "named"),
    [
        (torch.zeros(2, 2), torch.zeros(2, 2, dtype=torch.bool), 0.4, ShapeError, "predicted"),
        (torch.zeros(SHAPE), torch.zeros(3, 2, 3, dtype=torch.bool), 0.4, ShapeError, "occupancy"),
        (torch.zeros(SHAPE), torch.zeros(1, *SHAPE, dtype=torch.bool), 0.4, ShapeError, "occupancy"),
        (torch.zeros(SHAPE), torch.zeros(SHAPE), 0.4, DTypeError, "occupancy"),
        (torch.zeros(SHAPE, dtype=torch.int64), torch.zeros(SHAPE, dtype=torch.bool), 0.4, DTypeError, "predicted"),
        (torch.zeros(SHAPE), torch.zeros(SHAPE, dtype=torch.bool), float("nan"), OptionError, "threshold"),
        (torch.zeros(SHAPE), torch.zeros(SHAPE, dtype=torch.bool), "much", OptionError, "threshold"),
    ],
)
def test_errors_name_the_argument(predicted, occupancy, threshold, error, named):
    with pytest.raises(error, match=f"voxel_iou: {named} must"):
        voxel_iou(predicted, occupancy, threshold=threshold)


def test_tensors_must_share_a_device():
    with pytest.raises(DeviceError, match="predicted on cpu, occupancy on meta"):
        voxel_iou(torch.zeros(SHAPE), torch.zeros(SHAPE, dtype=torch.bool, device="meta"))


def test_an_empty_truth_may_be_left_out():
    truth = torch.zeros(3, 2, 2, 2, dtype=torch.bool)
    truth[0] = True
    predicted = torch.zeros(3, 2, 2, 2)
    predicted[0, 0], predicted[2] = 1.0, 1.0
    assert voxel_iou(predicted, truth).tolist() == [0.5, 1.0, 0.0]
    found = voxel_iou(predicted, truth, skip_empty=True)
    assert found[0] == 0.5
    assert found[1:].isnan().all()
    running = VoxelIoU()
    running.update(predicted, truth, ["car", "car", "rifle"])
    means = running.compute()
    assert (means.mean, means.counts) == (0.5, {"car": 1, "rifle": 0})
    with pytest.raises(OptionError, match="skip_empty must be True or False; got int 1"):
        voxel_iou(predicted, truth, skip_empty=1)
