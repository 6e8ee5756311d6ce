"""Mean, variance and maximum over the views that see a site (P25)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import functional
from tests import oracle, tolerances
from tests.property import support
from tests.strategies import scenes

NAMES = [
    names for count in (1, 2, 3) for names in itertools.permutations(("mean", "variance", "max"), count)
]  # fmt: skip
CALLS = st.fixed_dictionaries(
    {"padding_mode": st.sampled_from(("zeros", "border")), "augment": st.sampled_from(((), ("depth", "direction")))}
)


@given(scenes(), st.sampled_from(NAMES), CALLS, st.booleans())
def test_statistics_are_the_oracles_after_augmentation(scene, names, call, masked):
    for dtype in support.DTYPES:
        mask = torch.from_numpy(scene.view_mask) if masked else None
        given_ = support.inputs(scene, dtype)
        volume, visible = functional.unproject(*given_, view_mask=mask, **call)
        expected = oracle.view_statistics(support.array(volume.flatten(3)), visible.flatten(2).numpy(), names)
        reduced, reduced_visible = functional.unproject(*given_, view_mask=mask, reduce=names, **call)
        support.assert_same(reduced_visible, visible)
        largest = max(1.0, float(volume.abs().max()))
        tolerance = tolerances.termwise(dtype, 4.0 * largest**2)
        support.assert_within(support.array(reduced.flatten(2)), expected, tolerance)
        separate = functional.view_statistics(volume, visible, names)
        support.assert_within(support.array(separate.flatten(2)), expected, tolerance)


@support.FEWER
@given(scenes(), st.sampled_from(("mean", "variance", "max")))
def test_order_repetition_and_blind_views_do_not_matter(scene, name):
    values = torch.from_numpy(scene.features)
    generator = torch.Generator().manual_seed(scene.seed)
    visible = torch.rand(scene.batch, scene.views, *scene.size, generator=generator) < 0.6
    expected = functional.view_statistics(values, visible, name)
    order = torch.randperm(scene.views, generator=generator)
    changes = {
        "permuted": (values[:, order], visible[:, order]),
        "repeated": (torch.cat((values, values), 1), torch.cat((visible, visible), 1)),
        "blind": (torch.cat((values, values + 9.0), 1), torch.cat((visible, torch.zeros_like(visible)), 1)),
    }
    for other, other_visible in changes.values():
        actual = functional.view_statistics(other, other_visible, name)
        support.assert_within(support.array(actual), support.array(expected), 1e-12)
    mask = torch.from_numpy(scene.view_mask)
    dropped = functional.view_statistics(values, visible & mask[..., None, None], name)
    support.assert_same(functional.view_statistics(values, visible, name, view_mask=mask), dropped)
    alone = functional.view_statistics(values[:, :1], visible[:, :1], name)
    identity = torch.where(visible[:, :1], values[:, 0], 0.0) if name != "variance" else torch.zeros_like(values[:, 0])
    support.assert_within(support.array(alone), support.array(identity), 1e-15)


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_statistics_of_three_numbers_are_known(dtype):
    volume = torch.tensor([1.0, 3.0, 8.0, -7.0], dtype=dtype).reshape(1, 4, 1, 1)
    visible = torch.tensor([True, True, True, False]).reshape(1, 4, 1)
    actual = functional.view_statistics(volume, visible, ("max", "variance", "mean")).flatten()
    torch.testing.assert_close(actual, torch.tensor([8.0, 26.0 / 3.0, 4.0], dtype=dtype))
    unseen = functional.view_statistics(volume, torch.zeros_like(visible), ("mean", "variance", "max"))
    support.assert_same(unseen, torch.zeros(1, 3, 1, dtype=dtype))
    negative = functional.view_statistics(-volume, visible, "max")
    support.assert_same(negative, torch.full((1, 1, 1), -1.0, dtype=dtype))


def test_gradient_of_max_goes_to_the_first_visible_view():
    volume = torch.tensor([5.0, 2.0, 5.0, 5.0], dtype=torch.float64).reshape(1, 4, 1, 1).requires_grad_()
    visible = torch.tensor([False, True, True, True]).reshape(1, 4, 1)
    functional.view_statistics(volume, visible, "max").sum().backward()
    assert volume.grad.flatten().tolist() == [0.0, 0.0, 1.0, 0.0]


def test_gradients_of_mean_and_variance_are_known():
    volume = torch.tensor([1.0, 3.0, 8.0], dtype=torch.float64).reshape(1, 3, 1, 1).requires_grad_()
    visible = torch.tensor([True, True, False]).reshape(1, 3, 1)
    mean, variance = functional.view_statistics(volume, visible, ("mean", "variance")).flatten()
    (of_mean,) = torch.autograd.grad(mean, volume, retain_graph=True)
    (of_variance,) = torch.autograd.grad(variance, volume)
    torch.testing.assert_close(of_mean.flatten(), torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64))
    torch.testing.assert_close(of_variance.flatten(), torch.tensor([-1.0, 1.0, 0.0], dtype=torch.float64))


@support.FEWER
@given(scenes(placements=("facing", "inside", "behind")), st.sampled_from(NAMES))
def test_reduced_gradients_are_those_of_the_unreduced_path(scene, names):
    """Views are recomputed in backward; the numbers are those of keeping them."""
    features, cameras, grid = support.inputs(scene)
    gradients = []
    for inside in (True, False):
        leaf = features.clone().requires_grad_()
        pose = cameras.cam_from_world.clone().requires_grad_()
        arguments = (leaf, cameras._replace(cam_from_world=pose), grid)
        if inside:
            reduced = functional.unproject(*arguments, reduce=names, padding_mode="border").volume
        else:
            reduced = functional.view_statistics(*functional.unproject(*arguments, padding_mode="border"), names)
        weight = torch.cos(torch.arange(reduced.numel(), dtype=torch.float64)).reshape(reduced.shape)
        gradients.append(torch.autograd.grad((reduced * weight).sum(), (leaf, pose)))
    for actual, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)
    assert np.isfinite(support.array(gradients[0][1])).all()
