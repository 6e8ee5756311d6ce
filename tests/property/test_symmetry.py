"""Changes of frame, image, order and scale that leave unprojection as it is (P04 to P08, P17, P18)."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import functional
from lsmgeo.cameras import resize
from tests import tolerances
from tests.property import support
from tests.property.test_unproject import OPTIONS, pixel_ramp
from tests.strategies import rotations, scenes, vectors


def steady_sites(scene):
    """Sites whose depth and pixel leave no doubt, with the bound of what two computations may differ by."""
    geometry = support.geometry(scene, torch.float64)
    certain = support.is_certain(geometry, scene.size)
    return certain, tolerances.FRAME + 4.0 * tolerances.value_error(torch.float64, geometry.pixel_error, 1.0)


@given(scenes(), rotations(), vectors())
def test_moving_world_and_cameras_together_changes_nothing_but_ray_frames(scene, turn, shift):
    """P04: X -> Q X + s, R -> R Q^T, t -> t - R Q^T s."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    rotated = scene.rotations @ turn.T
    moved = dataclasses.replace(
        scene, rotations=rotated, translations=scene.translations - rotated @ shift, pose=motion @ scene.pose
    )
    values, visible = support.unproject(scene, augment=("depth", "direction"))
    moved_values, moved_visible = support.unproject(moved, augment=("depth", "direction"))
    certain, bound = steady_sites(scene)
    np.testing.assert_array_equal(visible[certain], moved_visible[certain])
    bound = np.where(certain, bound, 2.0)[:, :, None]
    support.assert_within(moved_values[:, :, :-4], values[:, :, :-4], bound)
    support.assert_within(moved_values[:, :, -4], values[:, :, -4], tolerances.FRAME)
    expected = np.einsum("ij,bvjn->bvin", turn, values[:, :, -3:])
    direction_error = support.geometry(scene, torch.float64).direction_error[:, :, None]
    support.assert_within(moved_values[:, :, -3:], expected, np.minimum(tolerances.FRAME + 8 * direction_error, 2.1))


@given(scenes(least=7), st.integers(1, 4), st.integers(1, 3))
def test_padding_an_image_and_moving_its_centre_changes_nothing_inside(scene, left, top):
    """P05: whatever the pad holds."""
    plain = dataclasses.replace(
        scene, intrinsics=support.feature_intrinsics(scene), image_sizes=np.full_like(scene.image_sizes, scene.size)
    )
    height, width = scene.size
    size = (height + top + 1, width + left + 2)
    padded = np.full((*scene.features.shape[:3], *size), 9.0)
    padded[..., top : top + height, left : left + width] = scene.features
    intrinsics = plain.intrinsics.copy()
    intrinsics[..., :2, 2] += (left, top)
    wider = dataclasses.replace(
        plain, intrinsics=intrinsics, image_sizes=np.full_like(scene.image_sizes, size), size=size
    )
    values, _ = support.unproject(plain)
    padded_values, _ = support.unproject(wider, features=padded)
    geometry = support.geometry(plain, torch.float64)
    with np.errstate(invalid="ignore"):
        slack = geometry.pixel_error[..., None]
        inside = np.all((geometry.pixels > slack) & (geometry.pixels < np.array([width, height]) - 1 - slack), axis=-1)
    inside &= geometry.depth > 1e-3
    bound = np.where(inside, tolerances.FRAME, 20.0)[:, :, None]
    support.assert_within(padded_values, values, bound)
    expected, _ = support.expected_unproject(plain)
    support.assert_within(padded_values, expected, bound)


@given(scenes(least=7), st.sampled_from([(2, 3), (3, 2), (1, 2)]))
def test_resizing_a_linear_image_changes_nothing_inside(scene, factors):
    """P06: pixel u of the resized image has its centre at (u + 0.5) / s - 0.5 of the image."""
    size = (scene.size[0] * factors[0], scene.size[1] * factors[1])
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    ramp = np.stack([(u + 0.5) / factors[1] - 0.5, (v + 0.5) / factors[0] - 0.5])
    ramp = np.broadcast_to(ramp, (scene.batch, scene.views, 2, *size)).copy()
    values, _ = support.unproject(scene, features=pixel_ramp(scene))
    larger = dataclasses.replace(scene, size=size)
    resized_values, _ = support.unproject(larger, features=ramp)
    geometry = support.geometry(scene, torch.float64)
    with np.errstate(invalid="ignore"):
        inside = np.all((geometry.pixels > 0) & (geometry.pixels < np.array(scene.size[::-1]) - 1), axis=-1)
    inside &= geometry.depth > 1e-3
    expected = np.where(inside[..., None], geometry.pixels, 0.0).swapaxes(2, 3)
    for actual in (values, resized_values):
        support.assert_within(np.where(inside[:, :, None], actual, 0.0), expected, 1e-7)


@given(scenes(), OPTIONS)
def test_views_are_independent_and_keep_their_order(scene, options):
    """P07, P08: permuted views, single views and single scenes give the same numbers."""
    features, cameras, grid = support.inputs(scene)
    volume, visible = functional.unproject(features, cameras, grid, **options)
    order = torch.arange(scene.views - 1, -1, -1)
    shuffled = type(cameras)(*(field[:, order] for field in cameras))
    permuted, permuted_visible = functional.unproject(features[:, order], shuffled, grid, **options)
    support.assert_same(permuted, volume[:, order])
    support.assert_same(permuted_visible, visible[:, order])
    b, v = scene.seed % scene.batch, scene.seed % scene.views
    single = type(cameras)(*(field[b : b + 1, v : v + 1] for field in cameras))
    box = type(grid)(grid.shape, grid.lower, grid.upper, grid.world_from_grid[b])
    alone, alone_visible = functional.unproject(features[b : b + 1, v : v + 1], single, box, **options)
    support.assert_same(alone[0, 0], volume[b, v])
    support.assert_same(alone_visible[0, 0], visible[b, v])


@given(scenes(), st.sampled_from([0.125, 3.0, 40.0]))
def test_scaling_the_world_scales_depth_alone(scene, scale):
    """P17: X -> s X, t -> s t: same pixels."""
    pose = np.diag([scale, scale, scale, 1.0]) @ scene.pose
    scaled = dataclasses.replace(scene, translations=scale * scene.translations, pose=pose)
    values, visible = support.unproject(scene, augment=("depth",), near=1e-4)
    other, other_visible = support.unproject(scaled, augment=("depth",), near=1e-4 * scale)
    geometry = support.geometry(scene, torch.float64)
    certain = support.is_certain(geometry, scene.size, 1e-4)
    _, bound = steady_sites(scene)
    np.testing.assert_array_equal(visible[certain], other_visible[certain])
    support.assert_within(other[:, :, :-1], values[:, :, :-1], np.where(certain, bound, 2.0)[:, :, None])
    support.assert_within(other[:, :, -1], scale * values[:, :, -1], scale * tolerances.FRAME)


@given(scenes(), OPTIONS, st.integers(1, 4))
def test_slabs_are_the_whole(scene, options, planes):
    """P18: exactly."""
    given_ = support.inputs(scene)
    volume, visible = functional.unproject(*given_, **options)
    starts = []
    for start, slab, slab_visible in functional.unproject_slabs(*given_, planes=planes, **options):
        starts.append(start)
        support.assert_same(slab, volume[..., start : start + planes, :, :])
        support.assert_same(slab_visible, visible[..., start : start + planes, :, :])
    assert starts == list(range(0, scene.shape[0], planes))


@support.FEWER
@given(scenes())
def test_resized_cameras_are_what_the_operator_resizes_to(scene):
    features, cameras, grid = support.inputs(scene)
    resized = resize(cameras, *scene.size)
    support.assert_within(support.array(resized.intrinsics), support.feature_intrinsics(scene), 1e-12)
    volume, _ = functional.unproject(features, cameras, grid, padding_mode="border")
    again, _ = functional.unproject(features, resized, grid, padding_mode="border")
    certain, bound = steady_sites(scene)
    bound = np.where(certain, bound, 2.0)[:, :, None]
    support.assert_within(support.array(again.flatten(3)), support.array(volume.flatten(3)), bound)
