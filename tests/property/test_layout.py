"""Strides, precision, empty and tiny inputs (P30, P31, P32)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lsmgeo import CameraTensors, FrustumGrid, VoxelGrid, functional
from tests.property import support
from tests.property.test_unproject import OPTIONS, plain_camera
from tests.strategies import scenes

DEPTHS = torch.tensor([0.6, 1.7, 3.0], dtype=torch.float64)


def restrided(tensor: torch.Tensor) -> dict[str, torch.Tensor]:
    """The same numbers in memory layouts that are not contiguous."""
    order = list(range(tensor.dim()))[::-1]
    transposed = tensor.permute(order).contiguous().permute(order)
    padded = torch.full((*tensor.shape[:-1], 2 * tensor.shape[-1] + 1), 77.0, dtype=tensor.dtype)
    padded[..., 1::2] = tensor
    return {"transposed": transposed, "sliced": padded[..., 1::2]}


@support.FEWER
@given(scenes(), OPTIONS)
def test_memory_layout_does_not_matter_and_inputs_stay_as_they_are(scene, options):
    features, cameras, grid = support.inputs(scene)
    expected, expected_visible = functional.unproject(features, cameras, grid, **options)
    for layout in ("transposed", "sliced"):
        other = restrided(features)[layout]
        before = other.clone()
        poses = cameras._replace(
            intrinsics=restrided(cameras.intrinsics)[layout], cam_from_world=restrided(cameras.cam_from_world)[layout]
        )
        volume, visible = functional.unproject(other, poses, grid, **options)
        support.assert_same(volume, expected)
        support.assert_same(visible, expected_visible)
        support.assert_same(other, before)
        assert volume.untyped_storage().data_ptr() != other.untyped_storage().data_ptr()
    one = features[:, :1, :1]
    spread = one.expand(scene.batch, scene.views, 3, *scene.size)
    shared, _ = functional.unproject(spread, cameras, grid, **options)
    full, _ = functional.unproject(spread.contiguous(), cameras, grid, **options)
    support.assert_same(shared, full)


@support.FEWER
@given(scenes(placements=("facing", "inside", "grazing")))
def test_memory_layout_of_a_volume_does_not_matter(scene):
    volume = torch.from_numpy(scene.volume)
    arguments = (support.cameras(scene), support.grid(scene), DEPTHS, (4, 3))
    expected, _ = functional.plane_sweep_project(volume, *arguments)
    for other in restrided(volume).values():
        support.assert_same(functional.plane_sweep_project(other, *arguments).maps, expected)
    last = volume.contiguous(memory_format=torch.channels_last_3d)
    support.assert_same(functional.plane_sweep_project(last, *arguments).maps, expected)
    support.assert_within(support.array(expected.abs().amax()), np.array(0.5), 0.51)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_features_lose_only_their_own_rounding(dtype):
    """P31: coordinates are float32, so the answer is that of float32 rounded once.

    The two may add in another order, and where that decides how the last bit is rounded they are a step apart.
    """
    step, least = torch.finfo(dtype).eps, torch.finfo(dtype).smallest_normal

    @support.FEWER
    @given(scenes(), OPTIONS)
    def check(scene, options):
        features, cameras, grid = support.inputs(scene, torch.float32)
        half = features.to(dtype)
        actual, visible = functional.unproject(half, cameras, grid, **options)
        expected, expected_visible = functional.unproject(half.float(), cameras, grid, **options)
        assert actual.dtype == dtype
        support.assert_same(visible, expected_visible)
        expected = support.array(expected)
        support.assert_within(support.array(actual.float()), expected, step * np.maximum(np.abs(expected), least))

    check()


@support.FEWER
@given(scenes(), OPTIONS)
def test_autocast_changes_nothing(scene, options):
    features, cameras, grid = support.inputs(scene, torch.float32)
    volume = torch.from_numpy(scene.volume).float()
    depths = DEPTHS.float()
    expected = functional.unproject(features, cameras, grid, **options)
    swept = functional.plane_sweep_project(volume, cameras, grid, depths, (4, 3))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        actual = functional.unproject(features, cameras, grid, **options)
        swept_actual = functional.plane_sweep_project(volume, cameras, grid, depths, (4, 3))
    for one, other in zip((*actual, *swept_actual), (*expected, *swept), strict=True):
        support.assert_same(one, other)
    check = support.expected_unproject(scene.rounded(torch.float32), **options)
    assert actual.volume.shape[2] == check.values.shape[2]


@pytest.mark.parametrize("features_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cameras_dtype", [torch.float32, torch.float64])
def test_camera_dtype_is_free(features_dtype, cameras_dtype):
    camera = plain_camera(torch.float64, (3, 4))
    camera = camera._replace(
        intrinsics=camera.intrinsics.to(cameras_dtype), cam_from_world=camera.cam_from_world.to(cameras_dtype)
    )
    ramp = torch.arange(4.0, dtype=features_dtype).expand(1, 1, 1, 3, 4)
    points = torch.tensor([[[1.25, 1.0, 1.0]]])
    values, _ = functional.unproject_points(ramp, camera, points)
    support.assert_known(values, torch.full((1, 1, 1, 1), 1.25, dtype=features_dtype))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_one_pixel_one_voxel_one_plane(dtype):
    camera = plain_camera(dtype, (1, 1))
    grid = VoxelGrid(1, lower=(-0.5, -0.5, 0.5), upper=(0.5, 0.5, 1.5))
    for padding_mode in ("zeros", "border"):
        volume, visible = functional.unproject(
            torch.full((1, 1, 1, 1, 1), 5.0, dtype=dtype), camera, grid, padding_mode=padding_mode
        )
        five = torch.full((1, 1, 1, 1, 1, 1), 5.0, dtype=dtype)
        support.assert_known(volume, five)
        assert visible.item()
        maps, seen = functional.plane_sweep_project(
            five[:, 0], camera, grid, torch.ones(1, dtype=dtype), (1, 1), padding_mode=padding_mode
        )
        support.assert_known(maps, five[0])
        assert seen.item()
    frustum = FrustumGrid(CameraTensors(*(field[0, 0] for field in camera)), torch.ones(1, dtype=dtype), (1, 1))
    values, _ = functional.unproject(torch.full((1, 1, 1, 1, 1), 5.0, dtype=dtype), camera, frustum)
    support.assert_known(values, five)
