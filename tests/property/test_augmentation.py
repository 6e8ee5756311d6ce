"""Depth and ray-direction channels (P11, P12): geometric, for every site of every unmasked view, visible or not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lsmgeo import CameraTensors, functional
from tests import oracle, tolerances
from tests.property import support
from tests.property.test_unproject import plain_camera
from tests.strategies import scenes


@given(scenes())
def test_depth_is_camera_z(scene):
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        actual, _ = support.unproject(exact, dtype, augment=("depth",))
        third_row, offset = exact.rotations[..., 2, :], exact.translations[..., 2]
        expected = np.einsum("bvi,bni->bvn", third_row, exact.sites) + offset[..., None]
        support.assert_within(actual[:, :, -1], expected, support.geometry(exact, dtype).depth_error)


@given(scenes())
def test_direction_is_the_unit_vector_from_the_camera_centre(scene):
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        bound = support.geometry(exact, dtype).direction_error[:, :, None]
        for frame in ("world", "camera"):
            actual, _ = support.unproject(exact, dtype, augment=("direction",), direction_frame=frame)
            expected = np.zeros_like(actual[:, :, -3:])
            for b, v in np.ndindex(exact.batch, exact.views):
                camera = exact.rotations[b, v], exact.translations[b, v]
                expected[b, v] = oracle.ray_direction(*camera, exact.sites[b], frame).T
            support.assert_within(actual[:, :, -3:], expected, bound)
            length = np.linalg.norm(actual[:, :, -3:], axis=2)
            away = bound[:, :, 0] < 1.0
            support.assert_within(length[away], np.ones(away.sum()), tolerances.termwise(dtype, 1.0))


@pytest.mark.parametrize("asked", [("direction", "depth"), ("depth", "direction")])
def test_channels_come_depth_first_whatever_order_was_asked(asked):
    points = torch.tensor([[[3.0, 4.0, 12.0]]])
    values, _ = functional.unproject_points(
        torch.full((1, 1, 2, 30, 30), 7.0), plain_camera(torch.float32, (30, 30)), points, augment=asked
    )
    expected = torch.tensor([7.0, 7.0, 12.0, 3 / 13, 4 / 13, 12 / 13])
    torch.testing.assert_close(values[0, 0, :, 0], expected)


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_direction_at_the_centre_is_zero_with_zero_gradient(dtype):
    camera = plain_camera(dtype, (4, 4))
    pose = camera.cam_from_world.clone().requires_grad_()
    points = torch.zeros(1, 1, 3, dtype=dtype, requires_grad=True)
    values, visible = functional.unproject_points(
        torch.ones(1, 1, 1, 4, 4, dtype=dtype), camera._replace(cam_from_world=pose), points, augment=("direction",)
    )
    support.assert_same(values, torch.zeros_like(values))
    assert not bool(visible.any())
    values.sum().backward()
    support.assert_same(points.grad, torch.zeros_like(points))
    support.assert_same(pose.grad, torch.zeros_like(pose))


def test_channels_are_defined_behind_and_outside():
    points = torch.tensor([[[0.0, 0.0, -2.0], [100.0, 0.0, 1.0]]])
    values, visible = functional.unproject_points(
        torch.ones(1, 1, 1, 4, 4), plain_camera(torch.float32, (4, 4)), points, augment=("depth", "direction")
    )
    assert not bool(visible.any())
    expected = torch.tensor([[0.0, -2.0, 0.0, 0.0, -1.0], [0.0, 1.0, 0.99995, 0.0, 0.0099995]])
    torch.testing.assert_close(values[0, 0].T, expected)


def test_depth_saturates_at_the_largest_half():
    points = torch.tensor([[[0.0, 0.0, 1e6], [0.0, 0.0, -1e6], [0.0, 0.0, 65000.0]]])
    values, _ = functional.unproject_points(
        torch.ones(1, 1, 1, 4, 4, dtype=torch.float16), plain_camera(torch.float32, (4, 4)), points, augment=("depth",)
    )
    expected = torch.tensor([65504.0, -65504.0, 64992.0], dtype=torch.float16)
    torch.testing.assert_close(values[0, 0, 1], expected)


def test_sweep_appends_plane_depth_and_pixel_rays():
    """Centre pixel of a camera that looks along z: direction (0, 0, 1), depth the plane's."""
    eye = torch.eye(4)[None, None]
    intrinsics = torch.tensor([[2.0, 0.0, 1.0], [0.0, 4.0, 1.0], [0.0, 0.0, 1.0]])[None, None]
    camera = CameraTensors(intrinsics, eye, torch.tensor([[3]]), torch.tensor([[3]]))
    maps, _ = functional.plane_sweep_project(
        torch.ones(1, 1, 2, 2, 2), camera, support.VoxelGrid(2), torch.tensor([2.0, 5.0]), (3, 3),
        augment=("direction", "depth"), flatten=False,
    )  # fmt: skip
    torch.testing.assert_close(maps[0, 0, 1], torch.tensor([2.0, 5.0])[:, None, None].expand(2, 3, 3))
    corner = torch.tensor([-0.5, -0.25, 1.0]) / torch.tensor([-0.5, -0.25, 1.0]).norm()
    for k in range(2):
        torch.testing.assert_close(maps[0, 0, 2:, k, 1, 1], torch.tensor([0.0, 0.0, 1.0]))
        torch.testing.assert_close(maps[0, 0, 2:, k, 0, 0], corner)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_the_direction_of_a_point_next_to_the_camera_has_a_finite_gradient(backend):
    """At (0, 0, h) before a camera in the origin the sum of the direction's entries grows by 1 / h along x and y."""
    h = 1e-15
    views = CameraTensors(torch.eye(3)[None, None], torch.eye(4)[None, None], 4, 5)
    points = torch.tensor([[[1.0, 1, 1], [-1, -1, -1], [0, 0, h], [0, 0, -h]]]).requires_grad_()
    values, _ = functional.unproject_points(
        torch.zeros(1, 1, 1, 4, 5), views, points, augment="direction", backend=backend
    )
    directions = values[0, 0, 1:, 2:]
    torch.testing.assert_close(directions, torch.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, -1.0]]))
    (gradient,) = torch.autograd.grad(directions.sum(), points)
    torch.testing.assert_close(gradient[0, 2:] * h, torch.tensor([[1.0, 1, 0], [1, 1, 0]]), rtol=1e-5, atol=1e-6)
