"""Plane-sweep projection against the oracle and against fields whose value is known (P20 to P23)."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import functional
from tests import oracle, tolerances
from tests.property import support
from tests.strategies import rotations, scenes, sweep_depths, vectors

SIZE = (5, 4)


@st.composite
def sweeps(draw, **options):
    scene = draw(scenes(placements=("facing", "grazing", "inside", "on_site"), **options))
    return scene, draw(sweep_depths(scene))


def sweep(scene, depths, dtype=torch.float64, volume=None, size=SIZE, **options):
    """``functional.plane_sweep_project`` as arrays (B, V, C, P, h, w), (B, V, P, h, w)."""
    source = torch.from_numpy(scene.volume if volume is None else volume).to(dtype)
    planes = torch.from_numpy(depths).to(support.camera_dtype(dtype))
    maps, visible = functional.plane_sweep_project(
        source, support.cameras(scene, dtype), support.grid(scene), planes, size, flatten=False, **options
    )
    return support.array(maps), visible.numpy()


def expected_sweep(scene, depths, volume=None, size=SIZE, **options):
    return oracle.plane_sweep(
        scene.volume if volume is None else volume, scene.intrinsics, scene.rotations, scene.translations,
        scene.image_sizes, scene.lattice, depths, size, **options,
    )  # fmt: skip


def swept_points(scene, depths, size=SIZE):
    """World points (B, V, P*h*w, 3) of the swept pixels, their lattice index, and the bound of its error."""
    pixels = oracle.pixel_lattice(size)
    batch, views, planes = depths.shape
    points = np.empty((batch, views, planes * len(pixels), 3))
    intrinsics = support.feature_intrinsics(scene, size)
    for b, v in np.ndindex(batch, views):
        camera = intrinsics[b, v], scene.rotations[b, v], scene.translations[b, v]
        points[b, v] = np.concatenate(
            [oracle.backproject(*camera, pixels, np.full(len(pixels), d)) for d in depths[b, v]]
        )
    inverse = np.linalg.inv(scene.lattice)
    index = np.einsum("bij,bvnj->bvni", inverse[:, :3, :3], points) + inverse[:, None, None, :3, 3]
    return points, index, inverse


def index_error(scene, depths, dtype, size=SIZE):
    points, index, inverse = swept_points(scene, depths, size)
    intrinsics = support.feature_intrinsics(scene, size)
    rays = np.abs(np.linalg.inv(intrinsics)).sum(-1).max(-1) * max(size)
    magnitude = depths * rays[..., None] + np.linalg.norm(scene.translations, axis=-1)[..., None]
    magnitude = magnitude + np.linalg.norm(scene.lattice[:, :3, 3], axis=-1)[:, None, None]
    magnitude = np.repeat(magnitude, size[0] * size[1], axis=-1)
    norm = np.abs(inverse[:, :3, :3]).sum(-1).max(-1)[:, None, None]
    # Each index is divided by its own plane's inverse depth, which is exact to one rounding: no cancellation there.
    terms = norm * magnitude + np.abs(index).max(-1)
    return points, index, tolerances.length_error(dtype, terms)


def is_far_from(index, positions, error):
    """Whether no axis of ``index`` lies within ``error`` of ``positions``, a function of the index."""
    return np.all(np.abs(index - positions) > error[..., None], axis=-1)


@given(
    sweeps(),
    st.sampled_from(("trilinear", "nearest")),
    st.sampled_from(("zeros", "border")),
    st.sampled_from(((), ("depth",), ("direction", "depth"))),
    st.sampled_from(("world", "camera")),
    st.booleans(),
)
def test_sweep_is_the_oracle(drawn, mode, padding_mode, augment, frame, masked):
    scene, depths = drawn
    options = {"mode": mode, "padding_mode": padding_mode, "augment": augment, "direction_frame": frame}
    counts = np.array(scene.shape[::-1])
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        mask = scene.view_mask if masked else None
        actual, visible = sweep(
            exact, depths, dtype, view_mask=None if mask is None else torch.from_numpy(mask), **options
        )
        expected, expected_visible = expected_sweep(exact, depths, view_mask=mask, **options)
        _, index, error = index_error(exact, depths, dtype)
        certain = is_far_from(index, -0.5, error) & is_far_from(index, counts - 0.5, error)
        certain = certain.reshape(visible.shape)
        np.testing.assert_array_equal(visible[certain], expected_visible[certain])
        if mode == "nearest":
            steady = is_far_from(index, np.round(index + 0.5) - 0.5, error)
            bound = np.where(steady, tolerances.termwise(dtype, 0.0), 2.0)
        else:
            bound = tolerances.value_error(dtype, error, 1.0, axes=3)
        bound = np.broadcast_to(bound.reshape(visible.shape)[:, :, None], expected.shape).copy()
        bound[:, :, scene.channels :] = tolerances.termwise(dtype, 4 * float(depths.max()))
        if masked:
            bound[~mask] = 0.0
        support.assert_within(actual, expected, bound)


@given(sweeps(least=7), vectors())
def test_linear_field_is_read_at_the_swept_point(drawn, slope):
    """P20: a volume that holds a . X + b returns a . X + b wherever all taps exist."""
    scene, depths = drawn
    batch = scene.batch
    sites = scene.sites.reshape(batch, *scene.shape, 3)
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        volume = (sites @ slope + 0.7)[:, None].astype(np.float32 if dtype == torch.float32 else np.float64)
        actual, visible = sweep(exact, depths, dtype, volume.astype(np.float64))
        points, index, error = index_error(exact, depths, dtype)
        inside = np.all((index >= error[..., None]) & (index <= np.array(scene.shape[::-1]) - 1 - error[..., None]), -1)
        assert bool(visible.reshape(inside.shape)[inside].all())
        expected = (points @ slope + 0.7)[inside]
        largest = float(np.abs(volume).max()) + 1.0
        bound = tolerances.value_error(dtype, error[inside], largest, axes=3)
        support.assert_within(actual[:, :, 0].reshape(inside.shape)[inside], expected, bound)


@given(sweeps())
def test_constant_is_kept_inside_and_lost_outside(drawn):
    """P21: with "zeros" the constant inside, 0 beyond the outermost cells, and visible says which."""
    scene, depths = drawn
    volume = np.full((scene.batch, 1, *scene.shape), 2.0)
    counts = np.array(scene.shape[::-1])
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        actual, visible = sweep(exact, depths, dtype, volume)
        _, index, error = index_error(exact, depths, dtype)
        values, error = actual[:, :, 0].reshape(index.shape[:-1]), error[..., None]
        inside = np.all((index >= error) & (index <= counts - 1 - error), axis=-1)
        beyond = np.any((index < -1 - error) | (index > counts + error), axis=-1)
        support.assert_within(values[inside], np.full(inside.sum(), 2.0), tolerances.termwise(dtype, 2.0))
        np.testing.assert_array_equal(values[beyond], 0.0)
        outside = np.any((index < -0.5 - error) | (index > counts - 0.5 + error), axis=-1)
        held = np.all((index > -0.5 + error) & (index < counts - 0.5 - error), axis=-1)
        assert not bool(visible.reshape(index.shape[:-1])[outside].any())
        assert bool(visible.reshape(index.shape[:-1])[held].all())


@given(sweeps(least=7))
def test_volume_of_homogeneous_pixels_reads_back_the_pixel(drawn):
    """P22: the volume holds h = K (R X + t); the sweep reads d (u, v, 1) at plane d of pixel (u, v)."""
    scene, depths = drawn
    b, v = scene.seed % scene.batch, scene.seed % scene.views
    K = support.feature_intrinsics(scene, SIZE)[b, v]
    homogeneous = (scene.sites[b] @ scene.rotations[b, v].T + scene.translations[b, v]) @ K.T
    volume = np.zeros((scene.batch, 3, *scene.shape))
    volume[b] = homogeneous.T.reshape(3, *scene.shape)
    actual, _ = sweep(scene, depths, volume=volume)
    _, index, _ = index_error(scene, depths, torch.float64)
    inside = np.all((index[b, v] > 1e-9) & (index[b, v] < np.array(scene.shape[::-1]) - 1 - 1e-9), axis=-1)
    pixels = np.concatenate([oracle.pixel_lattice(SIZE), np.ones((SIZE[0] * SIZE[1], 1))], 1)
    expected = np.concatenate([d * pixels for d in depths[b, v]])
    values = actual[b, v].reshape(3, -1).T
    support.assert_within(values[inside], expected[inside], 1e-8 * max(1.0, float(np.abs(homogeneous).max())))


@given(sweeps(), rotations(), vectors())
def test_moving_grid_and_cameras_together_changes_nothing(drawn, turn, shift):
    """P23."""
    scene, depths = drawn
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    rotated = scene.rotations @ turn.T
    moved = dataclasses.replace(
        scene, rotations=rotated, translations=scene.translations - rotated @ shift, pose=motion @ scene.pose
    )
    values, _ = sweep(scene, depths, padding_mode="border")
    moved_values, _ = sweep(moved, depths, padding_mode="border")
    support.assert_within(moved_values, values, 1e-7)


@support.FEWER
@given(sweeps())
def test_flattened_channel_is_c_times_planes_plus_k(drawn):
    scene, depths = drawn
    volume = torch.from_numpy(scene.volume)
    arguments = (volume, support.cameras(scene), support.grid(scene), torch.from_numpy(depths), SIZE)
    flat, _ = functional.plane_sweep_project(*arguments, augment=("depth",))
    stacked, _ = functional.plane_sweep_project(*arguments, augment=("depth",), flatten=False)
    planes = depths.shape[-1]
    assert flat.shape == (scene.batch, scene.views, (scene.channels + 1) * planes, *SIZE)
    for c, k in np.ndindex(scene.channels + 1, planes):
        support.assert_same(flat[:, :, c * planes + k], stacked[:, :, c, k])
    expected = torch.from_numpy(depths)[..., None, None].expand(*depths.shape, *SIZE)
    torch.testing.assert_close(flat[:, :, scene.channels * planes :], expected)


@pytest.mark.parametrize("form", ["shared", "scene", "view"])
def test_depths_are_shared_or_per_scene_or_per_view(form):
    @support.FEWER
    @given(scenes(placements=("facing",)))
    def check(scene):
        leading = {"shared": (), "scene": (scene.batch,), "view": (scene.batch, scene.views)}[form]
        steps = np.array([1.0, 2.0, 3.5])
        scale = 1.0 + 0.1 * np.arange(np.prod(leading, dtype=int)).reshape(leading)
        depths = steps * scale[..., None]
        full = np.broadcast_to(depths if form != "scene" else depths[:, None], (scene.batch, scene.views, 3)).copy()
        actual, _ = sweep(scene, depths, padding_mode="border")
        expected, _ = sweep(scene, full, padding_mode="border")
        np.testing.assert_array_equal(actual, expected)
        support.assert_within(actual, expected_sweep(scene, full, padding_mode="border").values, 1e-8)

    check()


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_lattice_edges_are_half_open_on_every_axis(dtype):
    """Rays of x = -0.5 and x = n - 0.5: the first is in the volume, the second is not; near excludes a plane."""
    eye = torch.eye(4, dtype=dtype)[None, None]
    intrinsics = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=dtype)[None, None]
    for axis, pixel in ((0, (1, 8)), (1, (8, 1))):
        cameras = support.CameraTensors(intrinsics, eye, torch.tensor([[pixel[0]]]), torch.tensor([[pixel[1]]]))
        # Along the tested axis the lattice index at depth 1 is pixel - 0.5: -0.5 is inside, 2.5 of 3 outside.
        shape = (1, 1, 3) if axis == 0 else (1, 3, 1)
        lower = [-0.5, -0.5, 0.5]
        lower[axis] = 0.0
        upper = [0.5, 0.5, 1.5]
        upper[axis] = 3.0
        grid = support.VoxelGrid(shape, lower=tuple(lower), upper=tuple(upper))
        volume = torch.ones(1, 1, *shape, dtype=dtype)
        _, visible = functional.plane_sweep_project(volume, cameras, grid, torch.ones(1, dtype=dtype), pixel)
        assert visible.flatten().tolist() == [True, True, True, False, False, False, False, False]
    camera = support.CameraTensors(intrinsics, eye, torch.tensor([[1]]), torch.tensor([[1]]))
    grid = support.VoxelGrid((4, 1, 1), lower=(-0.5, -0.5, 0.0), upper=(0.5, 0.5, 4.0))
    depths = torch.tensor([0.5, 1.0, 3.9, 4.0, 5.0], dtype=dtype)
    volume = torch.ones(1, 1, 4, 1, 1, dtype=dtype)
    maps, visible = functional.plane_sweep_project(
        volume, camera, grid, depths, (1, 1), near=0.5, mode="nearest", padding_mode="border"
    )
    assert visible.flatten().tolist() == [False, True, True, False, False]
    assert maps.flatten().tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]


def test_nearest_voxel_takes_the_cell_that_contains_the_sample():
    cameras = support.CameraTensors(
        torch.eye(3)[None, None], torch.eye(4)[None, None], torch.tensor([[1]]), torch.tensor([[5]])
    )
    grid = support.VoxelGrid((1, 1, 6), lower=(0.0, -0.5, 0.5), upper=(6.0, 0.5, 1.5))  # index = pixel - 0.5
    volume = torch.arange(1.0, 7.0).reshape(1, 1, 1, 1, 6)
    maps, _ = functional.plane_sweep_project(volume, cameras, grid, torch.ones(1), (1, 5), mode="nearest")
    assert maps.flatten().tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
