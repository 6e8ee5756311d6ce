"""The losses in closed form."""

from __future__ import annotations

from math import log

import pytest
import torch

from lsmgeo.data import Batch
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.models import DepthOutput, VoxelOutput, compute_loss, sum_loss


def batch(view_mask, *, occupancy=None, depth=None, mask=None):
    B, V = view_mask.shape
    return Batch(
        torch.zeros(B, V, 3, 4, 4), None, depth, mask, occupancy, (None,) * B, (None,) * B, ("",) * B, view_mask
    )


def softplus(x):
    return torch.log1p(torch.exp(torch.as_tensor(x, dtype=torch.float64)))


def test_cross_entropy_in_closed_form():
    solid = torch.zeros(1, 2, 2, 2, dtype=torch.bool)
    solid[0, 0] = True
    logits = torch.stack((torch.full((2, 2, 2), 3.0), torch.full((2, 2, 2), -1.0)))[None]
    found = compute_loss(VoxelOutput(logits), batch(torch.ones(1, 2, dtype=torch.bool), occupancy=solid))
    # Half of the voxels are occupied: softplus(-x) there, softplus(x) elsewhere; the mean of two steps.
    expected = (softplus(-3.0) + softplus(3.0) + softplus(1.0) + softplus(-1.0)) / 4
    torch.testing.assert_close(found, expected.float())


def test_steps_that_are_padding_do_not_count():
    mask = torch.tensor([[True, True, True], [True, False, False]])
    solid = torch.ones(2, 1, 1, 1, dtype=torch.bool)
    logits = torch.arange(6.0).reshape(2, 3, 1, 1, 1)
    given = batch(mask, occupancy=solid)
    terms = softplus(-torch.arange(6.0)).float().reshape(2, 3)
    total, count = sum_loss(VoxelOutput(logits), given)
    torch.testing.assert_close(total, terms[0].sum() + terms[1, 0])
    assert float(count) == 4
    total, count = sum_loss(VoxelOutput(logits[:, [2]]), given, steps=[2])
    torch.testing.assert_close(total, terms[0, 2])
    assert float(count) == 1
    # After the last view every scene has a prediction, wherever its own last view is.
    total, count = sum_loss(VoxelOutput(logits[:, [2]]), given, steps="last")
    torch.testing.assert_close(total, terms[:, 2].sum())
    assert float(count) == 2


def test_steps_that_are_padding_have_no_gradient_whatever_they_hold():
    mask = torch.tensor([[True, False]])
    logits = torch.tensor([0.0, torch.nan]).reshape(1, 2, 1, 1, 1).requires_grad_()
    found = compute_loss(VoxelOutput(logits), batch(mask, occupancy=torch.ones(1, 1, 1, 1, dtype=torch.bool)))
    found.backward()
    torch.testing.assert_close(found.detach(), torch.tensor(log(2.0)))
    torch.testing.assert_close(logits.grad.flatten(), torch.tensor([-0.5, 0.0]))


def depths():
    """Two views of 1 x 3 pixels: depth 2 on the object of the first two pixels, nothing in the third."""
    depth = torch.tensor([2.0, 2.0, 0.0]).expand(1, 2, 1, 3)
    predicted = torch.tensor([[[2.5, 2.0, 7.0]], [[1.0, 2.0, 9.0]]])[None, None].expand(1, 2, 2, 1, 3)
    return DepthOutput(predicted), depth


def test_absolute_error_of_depth_in_closed_form():
    output, depth = depths()
    given = batch(torch.ones(1, 2, dtype=torch.bool), depth=depth, mask=depth > 0)
    torch.testing.assert_close(compute_loss(output, given), torch.tensor((0.5 + 0.0 + 1.0 + 0.0) / 4))
    # The background is 10 away.
    everything = (0.5 + 0.0 + 3.0 + 1.0 + 0.0 + 1.0) / 6
    torch.testing.assert_close(compute_loss(output, given, region="all"), torch.tensor(everything))
    total, count = sum_loss(output, given)
    assert (float(total), float(count)) == (3.0, 8.0)  # two steps, two views, two pixels


def test_the_mask_tells_the_object_from_what_else_has_a_depth():
    output, depth = depths()
    mask = torch.tensor([True, False, True]).expand(1, 2, 1, 3)
    given = batch(torch.ones(1, 2, dtype=torch.bool), depth=depth, mask=mask)
    torch.testing.assert_close(compute_loss(output, given), torch.tensor((0.5 + 1.0) / 2))
    without = given._replace(mask=None)
    torch.testing.assert_close(compute_loss(output, without), torch.tensor((0.5 + 0.0 + 1.0 + 0.0) / 4))


def test_views_that_are_padding_do_not_count():
    output, depth = depths()
    mask = torch.tensor([[True, False]])
    given = batch(mask, depth=depth, mask=depth > 0)
    torch.testing.assert_close(compute_loss(output, given), torch.tensor(0.25))
    torch.testing.assert_close(compute_loss(output, given, region="all"), torch.tensor(3.5 / 3))
    total, count = sum_loss(output, given)
    assert (float(total), float(count)) == (0.5, 2.0)  # one step, one view, two pixels


def test_nothing_to_count_is_nothing_to_lose():
    output, depth = depths()
    logits = DepthOutput(output.depth.clone().requires_grad_())
    found = compute_loss(logits, batch(torch.ones(1, 2, dtype=torch.bool), depth=torch.zeros_like(depth)))
    found.backward()
    assert float(found.detach()) == 0.0
    assert float(logits.depth.grad.abs().sum()) == 0.0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_does_not_overflow(dtype):
    """The sum of 4 million terms of 20 is far beyond float16."""
    solid = torch.zeros(1, 128, 128, 128, dtype=torch.bool)
    logits = torch.full((1, 2, 128, 128, 128), 20.0, dtype=dtype)
    found = compute_loss(VoxelOutput(logits), batch(torch.ones(1, 2, dtype=torch.bool), occupancy=solid))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor(20.0), rtol=1e-5, atol=0)


def test_arguments_are_checked():
    mask = torch.ones(1, 2, dtype=torch.bool)
    logits = VoxelOutput(torch.zeros(1, 2, 4, 4, 4))
    with pytest.raises(DTypeError, match=r"batch must have occupancy of .*; got None"):
        compute_loss(logits, batch(mask))
    with pytest.raises(ShapeError, match=r"as predicted, \(1, 2, 4, 4, 4\); got \(1, 8, 8, 8\)"):
        compute_loss(logits, batch(mask, occupancy=torch.zeros(1, 8, 8, 8, dtype=torch.bool)))
    given = batch(mask, occupancy=torch.zeros(1, 4, 4, 4, dtype=torch.bool))
    with pytest.raises(ShapeError, match="output must be after 1 views"):
        compute_loss(logits, given, steps="last")
    with pytest.raises(OptionError, match="region must be one of"):
        compute_loss(logits, given, region="edge")
    with pytest.raises(DTypeError, match="output must be a VoxelOutput or a DepthOutput"):
        compute_loss(logits.logits, given)


def test_overlap_in_closed_form():
    """Two steps of half-occupied scenes: p of sigmoid(3) everywhere, then of sigmoid(-1)."""
    solid = torch.zeros(1, 2, 2, 2, dtype=torch.bool)
    solid[0, 0] = True
    logits = torch.stack((torch.full((2, 2, 2), 3.0), torch.full((2, 2, 2), -1.0)))[None].requires_grad_()
    given = batch(torch.ones(1, 2, dtype=torch.bool), occupancy=solid)
    found = compute_loss(VoxelOutput(logits), given, loss="bce+iou")
    p = torch.tensor([3.0, -1.0], dtype=torch.float64).sigmoid()
    # 8 voxels of which 4 are occupied: 4 p / (8 p + 4 - 4 p)
    apart = (1 - p / (1 + p)).mean()
    plain = compute_loss(VoxelOutput(logits), given)
    torch.testing.assert_close((found - plain).detach(), (0.1 * apart).float())
    found.backward()
    assert bool((logits.grad[0, :, 0] < 0).all())


def test_overlap_is_of_each_scene_and_step_that_counts():
    """A padded step and a scene without voxels add nothing, and the sum of parts is the whole."""
    mask = torch.tensor([[True, True], [True, False], [True, True]])
    solid = torch.zeros(3, 1, 1, 2, dtype=torch.bool)
    solid[:2, ..., 0] = True
    logits = torch.arange(12.0).reshape(3, 2, 1, 1, 2) / 6
    given = batch(mask, occupancy=solid)
    (plain, count), (found, same) = (sum_loss(VoxelOutput(logits), given, loss=loss) for loss in ("bce", "bce+iou"))
    p = logits.double().sigmoid()
    iou = p[..., 0].flatten(1) / (1 + p[..., 1].flatten(1))
    expected = 0.1 * 2 * (3 - iou[0, 0] - iou[0, 1] - iou[1, 0])
    torch.testing.assert_close((found - plain).double(), expected, rtol=1e-5, atol=0)
    assert float(count) == float(same) == 10
    parts = [
        sum_loss(VoxelOutput(logits[n : n + 1]), batch(mask[n : n + 1], occupancy=solid[n : n + 1]), loss="bce+iou")[0]
        for n in range(3)
    ]
    torch.testing.assert_close(torch.stack(parts).sum(), found)


def test_the_loss_is_checked():
    given = batch(torch.ones(1, 1, dtype=torch.bool), occupancy=torch.ones(1, 1, 1, 1, dtype=torch.bool))
    with pytest.raises(OptionError, match="loss must be one of 'bce', 'bce\\+iou'"):
        compute_loss(VoxelOutput(torch.zeros(1, 1, 1, 1, 1)), given, loss="iou")


@pytest.mark.parametrize("loss", ["bce", "bce+iou"])
def test_no_scene_is_nothing_to_lose(loss):
    given = batch(torch.ones(0, 2, dtype=torch.bool), occupancy=torch.ones(0, 2, 2, 2, dtype=torch.bool))
    total, count = sum_loss(VoxelOutput(torch.zeros(0, 2, 2, 2, 2)), given, loss=loss)
    assert float(total) == float(count) == 0
