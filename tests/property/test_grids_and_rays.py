"""Sites of voxel grids, depth planes, pixel rays, along-ray reductions: closed forms."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import PlaneSweepProject, Unproject, VoxelGrid, depth_planes, functional, rays
from lsmgeo.cameras import crop, look_at, orbit, perturb
from lsmgeo.cameras import rays as camera_rays
from lsmgeo.errors import GridError, ShapeError
from tests import oracle, tolerances
from tests.property import support
from tests.strategies import scenes, vectors


@given(scenes())
def test_voxel_centres_and_matrices_are_the_oracles(scene):
    grid = support.grid(scene)
    centers = support.array(grid.centers()).reshape(scene.batch, -1, 3)
    support.assert_within(centers, scene.sites, 1e-13)
    support.assert_within(support.array(grid.world_from_lattice), scene.lattice, 1e-13)
    product = support.array(grid.lattice_from_world) @ scene.lattice
    support.assert_within(product, np.broadcast_to(np.eye(4), product.shape), 1e-11)


def test_voxel_centres_of_a_known_box():
    grid = VoxelGrid((2, 1, 4), lower=(0.0, 0.0, 10.0), upper=(4.0, 3.0, 14.0))
    expected = torch.tensor([[0.5, 1.5, 13.0], [1.5, 1.5, 13.0], [2.5, 1.5, 13.0], [3.5, 1.5, 13.0]])
    torch.testing.assert_close(grid.centers()[1, 0], expected)


@support.FEWER
@given(st.integers(2, 40), st.floats(0.1, 5.0), st.floats(1.01, 20.0))
def test_depth_planes_are_evenly_spaced_in_their_measure(count, near, ratio):
    far = near * ratio
    for spacing, measure in (("depth", lambda d: d), ("inverse", lambda d: 1 / d), ("log", np.log)):
        near_tensor = torch.tensor(near, dtype=torch.float64)
        planes = depth_planes(near_tensor, far, count, spacing=spacing).numpy()
        np.testing.assert_allclose(planes[[0, -1]], [near, far], rtol=1e-12)
        steps = np.diff(measure(planes))
        np.testing.assert_allclose(steps, np.full(count - 1, (measure(far) - measure(near)) / (count - 1)), rtol=1e-6)
        both = depth_planes(torch.tensor([near, 2 * near]), torch.tensor([far, 3 * far]), count, spacing=spacing)
        assert both.shape == (2, count)


@pytest.mark.parametrize("spacing", ["depth", "inverse", "log"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_planes_are_strictly_ascending_as_long_as_there_are_numbers(spacing, dtype):
    step = torch.finfo(dtype).eps
    for near, far, count in (
        (1.0, 1.0 + 8 * step, 9),
        (1.0 - 5 * step, 1.0 + 5 * step, 16),
        (1e3, 1e3 + 1e6 * step, 9),
    ):
        ends = torch.tensor(near, dtype=dtype, requires_grad=True), torch.tensor(far, dtype=dtype)
        planes = depth_planes(*ends, count, spacing)
        assert planes.dtype == dtype
        assert bool((planes.diff() > 0).all()), (near, far, planes)
        torch.testing.assert_close(planes[[0, -1]], torch.stack(ends), rtol=0, atol=0)
        assert bool(torch.autograd.grad(planes.sum(), ends[0])[0] > 0)
    far = torch.tensor([2.0, 1.0 + 8 * step], dtype=dtype)
    rows = depth_planes(torch.ones(2, dtype=dtype), far, 9, spacing)
    assert bool((rows.diff(dim=-1) > 0).all())
    with pytest.raises(GridError, match="10 different numbers"):
        depth_planes(torch.ones(2, dtype=dtype), far, 10, spacing)


def test_depth_planes_are_differentiable():
    ends = (torch.tensor([1.0, 2.0], dtype=torch.float64), torch.tensor([3.0, 5.0], dtype=torch.float64))
    for spacing in ("depth", "inverse", "log"):
        arguments = [end.clone().requires_grad_() for end in ends]
        assert torch.autograd.gradcheck(lambda near, far, s=spacing: depth_planes(near, far, 4, s), arguments)


@given(scenes())
def test_rays_run_from_the_centre_through_the_pixels(scene):
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        origins, directions = camera_rays(support.cameras(exact, dtype), size=(3, 4))
        intrinsics = support.feature_intrinsics(exact, (3, 4))
        for b, v in np.ndindex(exact.batch, exact.views):
            pose = exact.rotations[b, v], exact.translations[b, v]
            tolerance = tolerances.length_error(dtype, 10 * (1 + np.linalg.norm(pose[1])))
            support.assert_within(support.array(origins[b, v]), oracle.camera_center(*pose), tolerance)
            points = oracle.backproject(intrinsics[b, v], *pose, oracle.pixel_lattice((3, 4)), np.full(12, 2.0))
            expected = oracle.ray_direction(*pose, points).reshape(3, 4, 3)
            spread = np.abs(np.linalg.inv(intrinsics[b, v])).sum(-1).max() * 4
            support.assert_within(
                support.array(directions[b, v]), expected, tolerances.length_error(dtype, 4 * spread + 8)
            )


@support.FEWER
@given(vectors(), vectors())
def test_look_at_puts_the_target_on_the_optical_axis(eye, target):
    if np.linalg.norm(np.cross(target - eye, [0.0, 1.0, 0.0])) < 0.1:
        return
    pose = support.array(look_at(torch.from_numpy(eye), torch.from_numpy(target)))
    R, t = oracle.look_at(eye, target, np.array([0.0, 1.0, 0.0]))
    support.assert_within(pose[:3, :3], R, 1e-12)
    support.assert_within(pose[:3, 3], t, 1e-12)
    support.assert_within(R @ target + t, np.array([0.0, 0.0, np.linalg.norm(target - eye)]), 1e-12)


@support.FEWER
@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(0.5, 4.0), vectors())
def test_orbit_stands_where_azimuth_and_elevation_say(azimuth, elevation, distance, target):
    angle = torch.tensor(azimuth, dtype=torch.float64)
    camera = orbit(angle, elevation, distance, focal_length=50.0, height=5, width=8, target=torch.from_numpy(target))
    a, e = np.radians(azimuth), np.radians(elevation)
    expected = target + distance * np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])
    R, t = support.array(camera.cam_from_world)[:3, :3], support.array(camera.cam_from_world)[:3, 3]
    support.assert_within(oracle.camera_center(R, t), expected, 1e-10)
    pixels, depth = oracle.project(support.array(camera.intrinsics), R, t, target[None])
    support.assert_within(pixels[0], np.array([3.5, 2.0]), 1e-9)
    support.assert_within(depth[0], np.array(distance), 1e-10)
    above, _ = oracle.project(support.array(camera.intrinsics), R, t, (target + np.array([0.0, 0.01, 0.0]))[None])
    assert above[0, 1] < pixels[0, 1], "y is up in the world, down in the image"


@support.FEWER
@given(scenes(), vectors(), st.integers(0, 100))
def test_perturbed_cameras_keep_the_target_in_place_and_stay_rigid(scene, target, seed):
    cameras = support.cameras(scene)
    generator = torch.Generator().manual_seed(seed)
    noisy = perturb(cameras, 7.0, target=torch.from_numpy(target), generator=generator)
    before, after = support.array(cameras.cam_from_world), support.array(noisy.cam_from_world)
    homogeneous = np.append(target, 1.0)
    support.assert_within(after @ homogeneous, before @ homogeneous, 1e-10)
    turn = np.swapaxes(before[..., :3, :3], -1, -2) @ after[..., :3, :3]
    identity = np.swapaxes(turn, -1, -2) @ turn
    support.assert_within(identity, np.broadcast_to(np.eye(3), identity.shape), 1e-10)
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))
    assert angle.max() <= 7.0 + 1e-6
    assert angle.max() > 1e-3


@support.FEWER
@given(scenes(placements=("facing", "on_pixel"), least=7))
def test_cropped_camera_sees_what_the_window_holds(scene):
    top, left, size = 1, 2, (4, 5)
    cameras = support.cameras(scene)
    window = torch.from_numpy(scene.features[..., top : top + size[0], left : left + size[1]].copy())
    cropped = crop(cameras._replace(**same_size(scene, scene.size)), top, left, *size)
    expected = support.array(cameras.intrinsics)
    expected[..., :2, 2] -= (left, top)
    support.assert_within(support.array(cropped.intrinsics), expected, 1e-12)
    whole = oracle.unproject(
        np.asarray(window), expected, scene.rotations, scene.translations,
        np.full((scene.batch, scene.views, 2), size), scene.sites, padding_mode="border",
    )  # fmt: skip
    border, _ = functional.unproject(window, cropped, support.grid(scene), padding_mode="border")
    support.assert_within(support.array(border.flatten(3)), whole.values, 1e-7)


def same_size(scene, size):
    full = torch.full((scene.batch, scene.views), size[0]), torch.full((scene.batch, scene.views), size[1])
    return {"height": full[0], "width": full[1]}


def swept(seed, shape=(2, 3, 5, 4, 6)):
    """Random maps (B, C, P, h, w) and visibility (B, P, h, w) with some blind rays."""
    rng = np.random.default_rng(seed)
    visible = rng.uniform(size=(shape[0], *shape[2:])) < 0.6
    visible[:, :, 0, 0] = False
    return rng.normal(size=shape), visible


@support.FEWER
@given(st.integers(0, 2**20), st.booleans())
def test_along_ray_reductions_are_their_definitions(seed, with_visible):
    values, visible = swept(seed)
    depths = np.cumsum(np.random.default_rng(seed + 1).uniform(0.1, 1.0, (2, 5)), axis=-1)
    if not with_visible:
        visible = np.ones_like(visible)
    mask = torch.from_numpy(visible) if with_visible else None
    scores, alpha = values[:, 0], 1 / (1 + np.exp(-values[:, 1]))
    found = rays.expected_depth(torch.from_numpy(scores), torch.from_numpy(depths), mask)
    largest = rays.max_along_rays(torch.from_numpy(scores), mask)
    blended = rays.composite(torch.from_numpy(alpha), torch.from_numpy(values), torch.from_numpy(depths), mask)
    for b, j, i in np.ndindex(2, 4, 6):
        seen = visible[b, :, j, i]
        weight = np.where(seen, np.exp(scores[b, :, j, i]), 0.0)
        expected = (weight * depths[b]).sum() / weight.sum() if seen.any() else 0.0
        support.assert_within(support.array(found[b, j, i]), np.array(expected), 1e-12)
        expected = scores[b, seen, j, i].max() if seen.any() else 0.0
        support.assert_within(support.array(largest[b, j, i]), np.array(expected), 0.0)
        light, color, depth = 1.0, np.zeros(3), 0.0
        for k in range(5):
            opacity = alpha[b, k, j, i] if seen[k] else 0.0
            color += light * opacity * values[b, :, k, j, i]
            depth += light * opacity * depths[b, k]
            light *= 1 - opacity
        support.assert_within(support.array(blended.values[b, :, j, i]), color, 1e-12)
        support.assert_within(support.array(blended.depth[b, j, i]), np.array(depth), 1e-12)
        support.assert_within(support.array(blended.transmittance[b, j, i]), np.array(light), 1e-12)


def test_rays_may_have_depths_of_their_own():
    values, visible = (torch.from_numpy(array) for array in swept(3))
    scores, alpha = values[:, 0], values[:, 1].sigmoid()
    depths = 1.0 + torch.rand(2, 5, 4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(4)).cumsum(1)
    found, blended = rays.expected_depth(scores, depths, visible), rays.composite(alpha, values, depths, visible)
    for j, i in np.ndindex(4, 6):
        at = (..., slice(j, j + 1), slice(i, i + 1))
        own = depths[..., j, i]  # (B, P)
        support.assert_within(
            support.array(found[at]), rays.expected_depth(scores[at], own, visible[at]).numpy(), 1e-12
        )
        expected = rays.composite(alpha[at], values[at], own, visible[at])
        support.assert_within(support.array(blended.depth[at]), expected.depth.numpy(), 1e-12)
    order = torch.tensor([3, 0, 4, 1, 2])
    moved = rays.expected_depth(scores[:, order], depths[:, order], visible[:, order])
    support.assert_within(support.array(moved), found.numpy(), 1e-12)
    for shuffled in (depths[:, order], depths[0, order, 0, 0]):
        with pytest.raises(GridError, match="composite: depths must ascend along each ray, from front to back"):
            rays.composite(alpha, values, shuffled, visible)
    with pytest.raises(ShapeError, match=re.escape("(P, h, w) = (5, 4, 6); got (5, 4, 6)")):
        rays.expected_depth(scores, depths[0])


@support.FEWER
@given(scenes(placements=("facing", "inside", "grazing")), st.sampled_from(((), ("depth", "direction"))), st.booleans())
def test_projecting_and_reducing_is_a_1x1_convolution_of_the_sweep(scene, augment, masked):
    volume, cameras, grid = torch.from_numpy(scene.volume), support.cameras(scene), support.grid(scene)
    depths = depth_planes(torch.tensor(0.5, dtype=torch.float64), 3.0, 4)
    mask = torch.from_numpy(scene.view_mask) if masked else None
    maps, visible = functional.plane_sweep_project(
        volume, cameras, grid, depths, (3, 4), augment=augment, view_mask=mask
    )
    weight = torch.linspace(-1, 1, 2 * maps.shape[2], dtype=torch.float64).reshape(2, -1)
    bias = torch.tensor([0.5, -1.5], dtype=torch.float64)
    expected = np.einsum("oc,bvchw->bvohw", weight.numpy(), maps.numpy()) + bias.numpy()[:, None, None]
    reduced, seen = rays.project_reduce(
        volume, cameras, grid, depths, weight, bias, (3, 4), augment=augment, view_mask=mask
    )
    support.assert_within(support.array(reduced), expected, 1e-10)
    support.assert_same(seen, visible)


@support.FEWER
@given(scenes(placements=("facing", "inside", "grazing")), st.sampled_from((None, "mean", ("variance", "max"))))
def test_layers_are_their_functions(scene, reduce):
    features, cameras, grid = support.inputs(scene)
    layer = Unproject(grid, mode="nearest", padding_mode="border", augment="depth", reduce=reduce, near=0.2)
    expected = functional.unproject(
        features, cameras, grid, mode="nearest", padding_mode="border", augment="depth", reduce=reduce, near=0.2
    )
    for actual in (layer(features, cameras), Unproject(**vars_of(layer))(features, cameras, grid=grid)):
        support.assert_same(actual.volume, expected.volume)
        support.assert_same(actual.visible, expected.visible)
    assert not list(layer.state_dict())
    depths = torch.tensor([0.7, 2.0], dtype=torch.float64)
    sweep = PlaneSweepProject(grid, depths, (3, 4), padding_mode="border", flatten=False)
    volume = torch.from_numpy(scene.volume)
    expected = functional.plane_sweep_project(
        volume, cameras, grid, depths, (3, 4), padding_mode="border", flatten=False
    )
    support.assert_same(sweep(volume, cameras).maps, expected.maps)
    assert not list(sweep.state_dict())


def vars_of(layer):
    """The options of an ``Unproject``, without its grid."""
    names = ("mode", "padding_mode", "augment", "direction_frame", "reduce", "near", "backend")
    return {name: getattr(layer, name) for name in names}


@pytest.mark.parametrize("name", ["mean", "variance", "max"])
def test_fusion_modules_are_the_statistics(name):
    from lsmgeo import fusion

    module = {"mean": fusion.Mean, "variance": fusion.Variance, "max": fusion.Max}[name]()
    rng = np.random.default_rng(0)
    values, visible = (
        torch.from_numpy(rng.normal(size=(2, 3, 4, 5, 6, 7))),
        torch.from_numpy(rng.uniform(size=(2, 3, 5, 6, 7)) < 0.5),
    )
    expected = oracle.view_statistics(values.flatten(3).numpy(), visible.flatten(2).numpy(), (name,))
    support.assert_within(support.array(module(values, visible).flatten(2)), expected, 1e-12)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::torch.jit.TracerWarning", "ignore::DeprecationWarning")
def test_depth_planes_can_be_traced():
    traced = torch.jit.trace(lambda far: depth_planes(1.0, far, 5, spacing="inverse"), torch.tensor(4.0))
    torch.testing.assert_close(traced(torch.tensor(8.0)), depth_planes(1.0, 8.0, 5, spacing="inverse"))
