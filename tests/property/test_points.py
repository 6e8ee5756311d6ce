"""``sample_views``: the operator after projection, at pixels the caller has found himself."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import functional
from tests import oracle, tolerances
from tests.kernels import cases
from tests.property import support
from tests.strategies import scenes

MODES = st.fixed_dictionaries(
    {"mode": st.sampled_from(("bilinear", "nearest")), "padding_mode": st.sampled_from(("zeros", "border"))}
)


@given(scenes(), MODES)
def test_sample_views_is_unproject_after_projection(scene, modes):
    for dtype in support.DTYPES:
        geometry = support.geometry(scene, dtype)
        valid = np.isfinite(geometry.pixels).all(-1)
        pixels = np.clip(np.where(valid[..., None], geometry.pixels, 0.0), -1e4, 1e4)
        kind = support.camera_dtype(dtype)
        pixels = torch.from_numpy(pixels).to(kind)
        depth, mask = torch.from_numpy(geometry.depth).to(kind), torch.from_numpy(valid)
        actual, visible = functional.sample_views(
            torch.from_numpy(scene.features).to(dtype), pixels, depth, mask, augment=("depth",), near=1e-3, **modes
        )
        expected = np.zeros_like(support.array(actual))
        pixels, depth = support.array(pixels), support.array(depth)
        front = valid & (depth > 1e-3)
        for b, v in np.ndindex(scene.batch, scene.views):
            chosen = front[b, v]
            mode = "nearest" if modes["mode"] == "nearest" else "linear"
            values = oracle.sample(scene.features[b, v], pixels[b, v, chosen], mode, modes["padding_mode"])
            expected[b, v, : scene.channels, chosen] = values.T
            expected[b, v, -1] = np.where(valid[b, v], depth[b, v], 0.0)
        rounding = tolerances.coordinate_error(dtype, 0.0, 0.0, np.ones_like(depth), np.maximum(np.abs(pixels), 12.0))
        bound = np.broadcast_to(tolerances.value_error(dtype, rounding, 1.0)[:, :, None], expected.shape)
        if modes["mode"] == "nearest":
            fraction = pixels + 0.5
            near_edge = np.abs(fraction - np.round(fraction)).min(-1) <= rounding
            bound = np.where(near_edge[:, :, None], 2.0, tolerances.termwise(dtype, 0.0))
        support.assert_within(actual.detach().double().numpy(), expected, bound)
        np.testing.assert_array_equal(visible.numpy(), front & oracle.is_in_image(pixels, scene.size))


def test_invalid_samples_read_nothing_even_where_their_pixel_is_not_finite():
    features = torch.ones(1, 1, 1, 3, 3, dtype=torch.float64, requires_grad=True)
    nan = float("nan")
    pixels = torch.tensor([[[[nan, nan], [1.0, 1.0], [1.0, 1.0]]]], dtype=torch.float64, requires_grad=True)
    depth = torch.tensor([[[nan, 2.0, -2.0]]], dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[[False, True, True]]])
    values, visible = functional.sample_views(features, pixels, depth, valid, augment=("depth",), padding_mode="border")
    assert values[0, 0].tolist() == [[0.0, 1.0, 0.0], [0.0, 2.0, -2.0]]
    assert visible.flatten().tolist() == [False, True, False]
    values.sum().backward()
    assert features.grad.sum() == 1.0
    assert depth.grad.flatten().tolist() == [0.0, 1.0, 1.0]
    assert bool(pixels.grad.isfinite().all())


@support.FEWER
@given(scenes(least=7))
def test_gradient_with_respect_to_pixels_is_the_slope(scene):
    """On a ramp a u + b v the derivative is (a, b) inside."""
    v, u = np.mgrid[: scene.size[0], : scene.size[1]].astype(np.float64)
    ramp = torch.from_numpy(np.broadcast_to(2 * u - 3 * v, (1, 1, 1, *scene.size)).copy())
    rng = np.random.default_rng(scene.seed)
    inside = rng.uniform(0, np.array(scene.size[::-1]) - 1.0, (1, 1, 20, 2))
    pixels = torch.from_numpy(inside).requires_grad_()
    ones = torch.ones(1, 1, 20, dtype=torch.float64)
    values, _ = functional.sample_views(ramp, pixels, ones, ones.bool())
    values.sum().backward()
    torch.testing.assert_close(pixels.grad, torch.tensor([2.0, -3.0], dtype=torch.float64).expand(1, 1, 20, 2))


@pytest.mark.parametrize("companion", [1e2, 1e6, 1e10])
def test_a_far_point_takes_no_digit_from_the_others(companion):
    """float32 coordinates are exact about the origin, whatever else is read in the same call."""
    near = torch.tensor([[[0.11, 0.2, 0.05], [-0.3, 0.1, 0.2]]])
    far = torch.cat((near, torch.tensor([[[companion, 0.0, 0.0]]]).expand(1, 3, 3)), 1)
    features, views = cases.FEATURES[:1], cases.VIEWS.at(slice(0, 1))
    expected = functional.unproject_points(features, views, near).volume
    assert expected.any()
    torch.testing.assert_close(functional.unproject_points(features, views, far).volume[..., :2], expected)
