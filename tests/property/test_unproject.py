"""Values and visibility of unprojection against the oracle (laws P02, P03, P09)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import CameraTensors, VoxelGrid, functional
from tests import oracle, tolerances
from tests.property import support
from tests.strategies import scenes

OPTIONS = st.fixed_dictionaries(
    {
        "mode": st.sampled_from(("bilinear", "nearest")),
        "padding_mode": st.sampled_from(("zeros", "border")),
        "augment": st.sampled_from(((), ("depth",), ("direction",), ("direction", "depth"))),
        "direction_frame": st.sampled_from(("world", "camera")),
        "near": st.sampled_from((1e-6, 0.5)),
    }
)


def check_against_oracle(scene, options, masked=False):
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        geometry = support.geometry(exact, dtype)
        mask = torch.from_numpy(scene.view_mask) if masked else None
        actual, visible = support.unproject(exact, dtype, view_mask=mask, **options)
        expected, expected_visible = support.expected_unproject(exact, view_mask=mask, **options)
        certain = support.is_certain(geometry, scene.size, options["near"])
        np.testing.assert_array_equal(visible[certain], expected_visible[certain])

        bound = np.zeros_like(expected)
        bound[:] = tolerances.value_error(dtype, geometry.pixel_error, 1.0)[:, :, None]
        if options["mode"] == "nearest":
            bound[:] = np.where(support.is_off_cell_border(geometry), tolerances.termwise(dtype, 0.0), 2.0)[:, :, None]
        bound = np.where((np.abs(geometry.depth - options["near"]) > geometry.depth_error)[:, :, None], bound, 2.0)
        channel = scene.channels
        if "depth" in options["augment"]:
            bound[:, :, channel] = geometry.depth_error
            channel += 1
        bound[:, :, channel:] = geometry.direction_error[:, :, None]
        if masked:
            bound[~scene.view_mask] = 0.0
        support.assert_within(actual, expected, bound)


@given(scenes(), OPTIONS)
def test_unproject_is_the_oracle(scene, options):
    check_against_oracle(scene, options)


@support.FEWER
@given(scenes(), OPTIONS)
def test_unproject_with_dropped_views_is_the_oracle(scene, options):
    check_against_oracle(scene, options, masked=True)


def pixel_ramp(scene):
    """Feature maps (B, V, 2, h, w) that hold their own pixel coordinates u, v."""
    v, u = np.mgrid[: scene.size[0], : scene.size[1]].astype(np.float64)
    return np.broadcast_to(np.stack([u, v]), (scene.batch, scene.views, 2, *scene.size)).copy()


@given(scenes(placements=("facing", "grazing", "inside", "on_site", "on_pixel", "on_border")))
def test_ramp_reads_the_projected_pixel(scene):
    """P02, P03: a map of its own coordinates tells where each site fell, sub-pixel, in any camera."""
    last = np.array([scene.size[1] - 1, scene.size[0] - 1])
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        geometry = support.geometry(exact, dtype)
        actual, _ = support.unproject(exact, dtype, pixel_ramp(scene), padding_mode="border")
        front = geometry.depth > support.NEAR + geometry.depth_error
        expected = np.where(front[..., None], np.clip(geometry.pixels, 0, last), 0.0)
        decided = front | (geometry.depth < support.NEAR - geometry.depth_error)
        bound = np.minimum(geometry.pixel_error, 100.0) + tolerances.termwise(dtype, 16.0)
        bound = np.where(decided, bound, 100.0)
        support.assert_within(actual.swapaxes(2, 3), expected, bound[..., None])


@given(scenes())
def test_constant_stays_constant_where_all_taps_exist(scene):
    """P09: c in front ("border"), c inside and 0 far outside ("zeros"), 0 behind."""
    constant = np.full((scene.batch, scene.views, 1, *scene.size), 3.0)
    last = np.array([scene.size[1] - 1, scene.size[0] - 1])
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        geometry = support.geometry(exact, dtype)
        tolerance = tolerances.termwise(dtype, 3.0)
        front = geometry.depth > support.NEAR + geometry.depth_error
        behind = geometry.depth < support.NEAR - geometry.depth_error
        border, _ = support.unproject(exact, dtype, constant, padding_mode="border")
        zeros, _ = support.unproject(exact, dtype, constant)
        support.assert_within(border[:, :, 0][front], np.full(front.sum(), 3.0), tolerance)
        for values in (border, zeros):
            np.testing.assert_array_equal(values[:, :, 0][behind], 0.0)
        with np.errstate(invalid="ignore"):
            slack = geometry.pixel_error[..., None]
            inside = front & np.all((geometry.pixels > slack) & (geometry.pixels < last - slack), axis=-1)
            outside = front & np.any((geometry.pixels < -1 - slack) | (geometry.pixels > last + 1 + slack), axis=-1)
        support.assert_within(zeros[:, :, 0][inside], np.full(inside.sum(), 3.0), tolerance)
        np.testing.assert_array_equal(zeros[:, :, 0][outside], 0.0)


def plain_camera(dtype, size):
    """A camera in which the point (x, y, 1) is seen at pixel (x, y)."""
    eye = torch.eye(4, dtype=support.camera_dtype(dtype))[None, None]
    return CameraTensors(eye[..., :3, :3], eye, torch.tensor([[size[0]]]), torch.tensor([[size[1]]]))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_image_is_half_open_and_the_near_plane_is_not_in_front(dtype):
    height, width = 3, 5
    u, v = [-0.5, 0.0, 2.25, 4.4375, 4.5, -0.5625], [-0.5, 0.0, 1.5, 2.4375, 2.5, -0.5625]
    points = torch.tensor([[(x, y, 1.0) for y in v for x in u]], dtype=dtype)
    features = torch.ones(1, 1, 1, height, width, dtype=dtype)
    camera = plain_camera(dtype, (height, width))
    _, visible = functional.unproject_points(features, camera, points, padding_mode="border")
    expected = torch.tensor([[[x <= 4.4375 and x >= -0.5 and y <= 2.4375 and y >= -0.5 for y in v for x in u]]])
    support.assert_same(visible, expected)

    depths = torch.tensor([[(0.0, 0.0, z) for z in (0.25, 0.2500001, 0.2499999, 0.0, -1.0)]], dtype=dtype)
    values, visible = functional.unproject_points(features, camera, depths, near=0.25, padding_mode="border")
    support.assert_same(visible, torch.tensor([[[False, True, False, False, False]]]))
    support.assert_known(values, visible[:, :, None].to(dtype))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_nearest_takes_the_cell_that_contains_the_sample(dtype):
    """At n + 0.5 the cell is n + 1 for even and odd n alike."""
    camera = plain_camera(dtype, (1, 6))
    features = torch.arange(1.0, 7.0, dtype=dtype)[None, None, None, None]
    x = [-0.5, 0.4375, 0.5, 1.5, 2.5, 3.5, 4.5, 5.4375]
    points = torch.tensor([[(value, 0.0, 1.0) for value in x]], dtype=dtype)
    values, _ = functional.unproject_points(features, camera, points, mode="nearest")
    support.assert_known(values[0, 0, 0], torch.tensor([1.0, 1, 2, 3, 4, 5, 6, 6], dtype=dtype))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_feature_map_of_another_size_is_resized_for(dtype):
    """Doubling a map: the image's pixel 1 has its centre at (1 + 0.5) * 2 - 0.5 = 2.5 of the map."""
    camera = plain_camera(dtype, (4, 4))
    ramp = torch.arange(8.0, dtype=dtype).expand(1, 1, 1, 12, 8)
    values, _ = functional.unproject_points(ramp, camera, torch.tensor([[[1.0, 1.0, 1.0]]], dtype=dtype))
    support.assert_known(values, torch.full((1, 1, 1, 1), 2.5, dtype=dtype))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_unproject_on_a_grid_whose_answer_is_known(dtype):
    """Voxel (z, y, x) of a unit grid, seen along z by a camera at depth 0: pixel (x, y) * 1 / z."""
    grid = VoxelGrid((2, 3, 4), lower=(-0.5, -0.5, 0.5), upper=(3.5, 2.5, 2.5))
    v, u = torch.meshgrid(torch.arange(3.0, dtype=dtype), torch.arange(4.0, dtype=dtype), indexing="ij")
    volume, visible = functional.unproject((10 * u + v)[None, None, None], plain_camera(dtype, (3, 4)), grid)
    expected = torch.stack([(10 * u + v) / z for z in (1, 2)])
    support.assert_known(volume[0, 0, 0], expected)
    assert bool(visible.all())


@support.FEWER
@given(scenes(), OPTIONS)
def test_points_are_the_grid_and_any_order_of_sites(scene, options):
    points = torch.from_numpy(scene.sites)
    given_ = support.inputs(scene)
    expected, expected_visible = functional.unproject(*given_, **options)
    order = torch.randperm(points.shape[1], generator=torch.Generator().manual_seed(scene.seed))
    values, visible = functional.unproject_points(given_.features, given_.cameras, points[:, order], **options)
    geometry = support.geometry(scene, torch.float64)
    steady = support.is_certain(geometry, scene.size, options["near"])
    if options["mode"] == "nearest":
        steady &= support.is_off_cell_border(geometry)
    steady = torch.from_numpy(steady)[:, :, order]
    support.assert_same(visible[steady], expected_visible.flatten(2)[:, :, order][steady])
    channels = slice(None) if "direction" not in options["augment"] else slice(0, scene.channels)
    bound = tolerances.value_error(torch.float64, geometry.pixel_error, 1.0)[:, :, order][:, :, None]
    bound = np.where(steady.numpy()[:, :, None], bound + geometry.depth_error[:, :, order][:, :, None], np.inf)
    difference = (values - expected.flatten(3)[..., order])[:, :, channels]
    support.assert_within(support.array(difference), np.zeros(difference.shape), np.minimum(bound, 1e3))


def test_oracle_sees_something():
    """The scenes are not vacuous: sites are visible, invisible, behind and on borders."""
    seen = {"visible": 0, "outside": 0, "behind": 0}

    @given(scenes())
    def count(scene):
        _, visible = support.expected_unproject(scene)
        front = support.geometry(scene, torch.float64).depth > 0
        seen["visible"] += int(visible.sum())
        seen["outside"] += int((front & ~visible).sum())
        seen["behind"] += int((~front).sum())

    count()
    assert min(seen.values()) > 0.1 * sum(seen.values()), seen
    assert oracle.camera_center(np.eye(3), np.array([1.0, 2.0, 3.0])).tolist() == [-1.0, -2.0, -3.0]
