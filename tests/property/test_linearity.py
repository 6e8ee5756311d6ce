"""Both operators are linear with non-negative weights, backward is the adjoint (P15, P16); pinned by known weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import functional
from tests import tolerances
from tests.property import support
from tests.property.test_unproject import plain_camera
from tests.strategies import scenes

MODES = st.fixed_dictionaries(
    {"mode": st.sampled_from(("linear", "nearest")), "padding_mode": st.sampled_from(("zeros", "border"))}
)


def operators(scene, dtype, mode, padding_mode):
    """Unprojection and sweep of the scene as linear maps, with a source for each."""
    features, cameras, grid = support.inputs(scene, dtype)
    volume = torch.from_numpy(scene.volume).to(dtype)
    depths = torch.tensor([0.6, 1.7, 3.0], dtype=support.camera_dtype(dtype))
    kinds = {"linear": ("bilinear", "trilinear"), "nearest": ("nearest", "nearest")}[mode]

    def unproject(source):
        return functional.unproject(source, cameras, grid, mode=kinds[0], padding_mode=padding_mode)[0]

    def sweep(source):
        return functional.plane_sweep_project(
            source, cameras, grid, depths, (4, 3), mode=kinds[1], padding_mode=padding_mode
        )[0]

    return (unproject, features), (sweep, volume)


@given(scenes(), MODES)
def test_operators_are_linear_and_bounded_by_their_source(scene, modes):
    for dtype in support.DTYPES:
        for operator, source in operators(scene, dtype, **modes):
            other = source.flip(-1)
            expected = 2.0 * operator(source) - 0.5 * operator(other)
            tolerance = tolerances.termwise(dtype, 3.0)
            support.assert_within(
                support.array(operator(2.0 * source - 0.5 * other)), support.array(expected), tolerance
            )
            values = operator(source.abs() + 1.0)
            assert bool((values >= 0).all())
            largest = float((source.abs() + 1.0).max())
            assert bool((values <= largest * (1 + 8 * tolerances.UNIT_ROUNDOFF[dtype])).all())


@given(scenes(), MODES)
def test_backward_is_the_adjoint(scene, modes):
    for dtype in support.DTYPES:
        for operator, source in operators(scene, dtype, **modes):
            source = source.clone().requires_grad_()
            values = operator(source)
            generator = torch.Generator().manual_seed(scene.seed)
            cotangent = torch.randn(values.shape, generator=generator, dtype=dtype)
            (gradient,) = torch.autograd.grad(values, source, cotangent)
            values, source, gradient = (support.array(tensor) for tensor in (values, source, gradient))
            scale = max(np.linalg.norm(values) * float(cotangent.norm()), 1.0)
            difference = np.sum(values * support.array(cotangent)) - np.sum(source * gradient)
            support.assert_within(difference, np.array(0.0), tolerances.termwise(dtype, 0.0) * scale)


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_weights_of_one_sample_are_known(dtype):
    """At (1.25, 0.5) of a 2 x 3 map: columns 1, 2 with 3/4, 1/4; both rows with 1/2."""
    features = torch.zeros(1, 1, 1, 2, 3, dtype=dtype, requires_grad=True)
    values, _ = functional.unproject_points(
        features, plain_camera(dtype, (2, 3)), torch.tensor([[[1.25, 0.5, 1.0]]], dtype=dtype)
    )
    values.sum().backward()
    expected = torch.tensor([[0.0, 0.375, 0.125]] * 2, dtype=dtype)[None, None, None]
    torch.testing.assert_close(features.grad, expected)


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_weights_of_one_swept_sample_are_known(dtype):
    """Lattice (0.5, 0.25, 0.125) of a 2 x 2 x 2 volume."""
    volume = torch.zeros(1, 1, 2, 2, 2, dtype=dtype, requires_grad=True)
    grid = support.VoxelGrid(2, lower=(-1.0, -0.75, 0.375), upper=(1.0, 1.25, 2.375))
    maps, _ = functional.plane_sweep_project(
        volume, plain_camera(dtype, (1, 1)), grid, torch.ones(1, dtype=dtype), (1, 1)
    )
    maps.sum().backward()
    x, y, z = (torch.tensor([1 - a, a], dtype=dtype) for a in (0.5, 0.25, 0.125))
    expected = (z[:, None, None] * y[:, None] * x)[None, None]
    torch.testing.assert_close(volume.grad, expected)
    assert np.isclose(float(volume.grad.sum()), 1.0)
