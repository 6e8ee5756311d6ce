"""What is behind the camera, masked or outside reads nothing: exact zeros, exact zero gradients, no NaN (P10, P14)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lsmgeo import CameraTensors, VoxelGrid, functional
from tests.property import support
from tests.property.test_unproject import plain_camera
from tests.strategies import scenes

EVERYTHING = {"augment": ("depth", "direction")}


def leaves(scene, dtype=torch.float64):
    """Inputs whose features, K and extrinsics require gradients."""
    features, cameras, grid = support.inputs(scene, dtype)
    features.requires_grad_()
    cameras = cameras._replace(
        intrinsics=cameras.intrinsics.requires_grad_(), cam_from_world=cameras.cam_from_world.requires_grad_()
    )
    return features, cameras, grid


@given(scenes(placements=("behind",)))
def test_behind_all_is_zero_and_so_are_all_gradients(scene):
    for padding_mode in ("zeros", "border"):
        features, cameras, grid = leaves(scene)
        volume, visible = functional.unproject(features, cameras, grid, padding_mode=padding_mode)
        assert not bool(visible.any())
        support.assert_same(volume, torch.zeros_like(volume))
        volume.sum().backward()
        for leaf in (features, cameras.intrinsics, cameras.cam_from_world):
            support.assert_same(leaf.grad, torch.zeros_like(leaf))


@support.FEWER
@given(scenes())
def test_features_get_gradient_only_from_sites_in_front(scene):
    """The gradient of a constant cotangent is the sum of weights: the number of sites in front ("border")."""
    features, cameras, grid = leaves(scene)
    volume, _ = functional.unproject(features, cameras, grid, padding_mode="border")
    volume.sum().backward()
    geometry = support.geometry(scene, torch.float64)
    sure = (geometry.depth > support.NEAR + geometry.depth_error).sum(-1)
    possible = (geometry.depth > support.NEAR - geometry.depth_error).sum(-1)
    total = support.array(features.grad.sum((-1, -2)))
    assert np.all(total >= sure[..., None] - 1e-9)
    assert np.all(total <= possible[..., None] + 1e-9)


@given(scenes(placements=("on_site", "inside", "facing", "behind")))
def test_nothing_is_ever_non_finite(scene):
    """A site in the camera centre, behind it, or far outside: finite values and finite gradients."""
    for dtype in support.DTYPES:
        for mode in ("bilinear", "nearest"):
            features, cameras, grid = leaves(scene.rounded(dtype), dtype)
            volume, _ = functional.unproject(features, cameras, grid, mode=mode, **EVERYTHING)
            assert bool(volume.isfinite().all())
            volume.sum().backward()
            for leaf in (features, cameras.intrinsics, cameras.cam_from_world):
                assert leaf.grad is not None
                assert bool(leaf.grad.isfinite().all())


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_site_in_the_camera_centre_gives_zero_gradient(dtype):
    """Depth exactly 0, in a grid and as a point; the voxel in front of it is read as ever."""
    camera = plain_camera(dtype, (3, 3))
    pose = camera.cam_from_world.clone().requires_grad_()
    camera = camera._replace(cam_from_world=pose)
    features = torch.arange(9.0, dtype=dtype).reshape(1, 1, 1, 3, 3)
    grid = VoxelGrid((2, 1, 1), lower=(-0.5, -0.5, -0.5), upper=(0.5, 0.5, 1.5))
    volume, visible = functional.unproject(features, camera, grid, padding_mode="border")
    assert volume[..., 0, 0, 0].item() == 0.0
    assert visible.flatten().tolist() == [False, True]
    volume[..., 0, :, :].sum().backward()
    support.assert_same(pose.grad, torch.zeros_like(pose))
    points = torch.zeros(1, 2, 3, dtype=dtype)
    points[0, 1] = torch.tensor([1.25, 0.5, 1.0], dtype=dtype)
    points.requires_grad_()
    values, _ = functional.unproject_points(features, camera, points, padding_mode="border")
    values.sum().backward()
    expected = torch.tensor([[0.0, 0.0, 0.0], [1.0, 3.0, -1.25 - 3 * 0.5]], dtype=dtype)
    torch.testing.assert_close(points.grad[0], expected)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_feature_reaches_its_footprint_only(bad):
    @support.FEWER
    @given(scenes())
    def check(scene):
        b, v, c = scene.batch - 1, scene.views - 1, scene.channels - 1
        row, column = scene.seed % scene.size[0], scene.seed % scene.size[1]
        features = scene.features.copy()
        features[b, v, c, row, column] = bad
        for padding_mode in ("zeros", "border"):
            clean, _ = support.unproject(scene, padding_mode=padding_mode)
            volume, _ = functional.unproject(
                torch.from_numpy(features), *support.inputs(scene)[1:], padding_mode=padding_mode
            )
            volume = volume.flatten(3).numpy()
            geometry = support.geometry(scene, torch.float64)
            pixels = geometry.pixels[b, v]
            if padding_mode == "border":
                pixels = np.clip(pixels, 0, np.array(scene.size[::-1]) - 1.0)
            with np.errstate(invalid="ignore"):
                distance = np.abs(pixels - np.array([column, row])).max(axis=-1)
            away = (distance > 1 + geometry.pixel_error[b, v]) | (geometry.depth[b, v] < support.NEAR / 2)
            np.testing.assert_array_equal(volume[b, v, c, away], clean[b, v, c, away])
            volume[b, v, c] = clean[b, v, c]
            np.testing.assert_array_equal(volume, clean)

    check()


@support.FEWER
@given(scenes(placements=("behind", "behind", "facing")))
def test_views_that_see_nothing_read_nothing(scene):
    """NaN features of a view whose sites are all behind stay there, backward too."""
    behind = torch.from_numpy(support.geometry(scene, torch.float64).depth.max(-1) < 0)
    features, cameras, grid = leaves(scene)
    poisoned = torch.where(behind[..., None, None, None], torch.full_like(features, torch.nan), features)
    volume, _ = functional.unproject(poisoned, cameras, grid, padding_mode="border")
    assert bool(volume.isfinite().all())
    volume.square().sum().backward()
    for leaf in (features, cameras.intrinsics, cameras.cam_from_world):
        assert bool(leaf.grad.isfinite().all())
    support.assert_same(features.grad[behind], torch.zeros_like(features.grad[behind]))


@given(scenes())
def test_masked_views_are_unread_and_unchecked(scene):
    """Features and cameras of a dropped view may be NaN; the rest does not notice, and the view's channels are 0."""
    mask = torch.from_numpy(scene.view_mask)
    features, cameras, grid = leaves(scene)
    expected, expected_visible = functional.unproject(features, cameras, grid, **EVERYTHING)
    keep = mask[..., None, None]
    poisoned = CameraTensors(
        torch.where(keep, cameras.intrinsics, torch.nan), torch.where(keep, cameras.cam_from_world, torch.nan),
        cameras.height, cameras.width,
    )  # fmt: skip
    bad_features = torch.where(keep[..., None], features, torch.nan)
    volume, visible = functional.unproject(bad_features, poisoned, grid, view_mask=mask, **EVERYTHING)
    support.assert_same(volume, torch.where(keep[..., None, None], expected, 0.0))
    support.assert_same(visible, expected_visible & keep[..., None])
    volume.sum().backward()
    for leaf in (features, cameras.intrinsics, cameras.cam_from_world):
        assert bool(leaf.grad.isfinite().all())
        support.assert_same(leaf.grad[~mask], torch.zeros_like(leaf.grad[~mask]))
