"""Scenes known in closed form, from images to depth maps that agree, points and a surface."""

import numpy as np
import pytest
import torch

from lsmgeo import data
from lsmgeo.cameras import CameraTensors, project
from lsmgeo.classical import default_depth_range, reconstruct_scene, reconstruct_view, select_neighbours
from lsmgeo.errors import OptionError
from tests.data.writers import make_scene, write_colmap, write_middlebury

NORMAL = np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])
OPTIONS = {"planes": 64, "near": 1.5, "far": 2.6}


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(scope="module")
def read(scene, tmp_path_factory):
    return data.open(write_middlebury(scene, tmp_path_factory.mktemp("scene")))


@pytest.fixture(scope="module")
def whole(read):
    return reconstruct_scene(read, resolution=48, min_support=2, **OPTIONS)


def test_pixels_kept_lie_where_the_scene_does(scene, whole):
    assert [one.view for one in whole.views] == [0, 1, 2, 3, 4]
    for one in whole.views:
        expected = scene.depth[one.view]
        use = one.mask.numpy()
        assert use.mean() > 0.4
        errors = np.abs(one.depth_map.depth.numpy() - expected)[use] / expected[use]
        assert np.median(errors) < 1e-3
        assert np.quantile(errors, 0.95) < 1e-2


def test_points_and_surface_lie_on_the_plane(whole):
    assert len(whole.points) == len(whole.colours) == sum(int(one.mask.sum()) for one in whole.views)
    assert whole.points.dtype == np.float32
    assert whole.colours.dtype == np.uint8
    assert np.median(np.abs(whole.points @ NORMAL)) < 2e-3
    assert len(whole.mesh.faces) > 100
    assert np.median(np.abs(np.asarray(whole.mesh.vertices) @ NORMAL)) < 5e-3


def test_views_that_do_not_exist_are_named(read):
    for view in (-1, len(read), 1.5):
        with pytest.raises(OptionError, match="view must be a whole number from 0 to"):
            select_neighbours(read, view, 2)
        with pytest.raises(OptionError, match="view must be a whole number from 0 to"):
            default_depth_range(read, view)
    with pytest.raises(OptionError, match="count must be a whole number, at least 1; got int 0"):
        select_neighbours(read, 0, 0)


def test_points_at_one_place_have_no_surface():
    from lsmgeo.classical.stereo import surface_of

    assert len(surface_of([], np.ones((3, 3), np.float32), 16).faces) == 0


def test_support_counts_the_views_that_agree(whole):
    for one in whole.views:
        assert one.support.shape == one.mask.shape
        assert int(one.support.max()) <= 4
        assert bool((one.support[one.mask] >= 2).all())
        confidence = one.depth_map.confidence
        assert 0 <= float(confidence.min()) <= float(confidence.max()) <= 1
        # Agreement comes first.
        two, one_alone = (confidence[(one.support == n) & (one.depth_map.depth > 0)] for n in (2, 1))
        if len(two) and len(one_alone):
            assert float(two.min()) >= float(one_alone.max()) - 1e-6


def test_a_wrong_depth_map_finds_no_support(scene, read, monkeypatch):
    """One view's image is another's: what it seems to show agrees with nobody."""
    honest = type(read).load

    def load(self, view):
        return honest(self, 0).flip(-1) if view == 4 else honest(self, view)

    monkeypatch.setattr(type(read), "load", load)
    result = reconstruct_scene(read, mesh=False, **OPTIONS)
    assert float(result.views[4].mask.float().mean()) < 0.05
    assert float(result.views[0].mask.float().mean()) > 0.3


def test_a_view_alone_is_what_the_sweep_of_one_view_gives(read):
    alone = reconstruct_view(read, 1, **OPTIONS)
    single = reconstruct_scene(read, [1], mesh=False, density=0.4, **OPTIONS)
    assert alone.support is None
    assert single.mesh is None
    torch.testing.assert_close(single.views[0].depth_map.depth, alone.depth_map.depth, rtol=0, atol=0)
    assert torch.equal(single.views[0].mask, alone.mask)
    np.testing.assert_array_equal(single.points, alone.points)


def test_two_views_are_checked_against_each_other(scene, read):
    result = reconstruct_scene(read, [0, 1], neighbours=1, mesh=False, **OPTIONS)
    for one in result.views:
        assert len(one.neighbours) == 1
        assert bool((one.support[one.mask] == 1).all())
        errors = np.abs(one.depth_map.depth.numpy() / scene.depth[one.view] - 1)[one.mask.numpy()]
        assert len(errors) > 0.2 * one.mask.numel()
        assert np.median(errors) < 2e-3


def test_images_without_texture_give_nothing(scene, tmp_path):
    grey = scene._replace(images=np.full_like(scene.images, 119))
    read = data.open(write_middlebury(grey, tmp_path))
    result = reconstruct_scene(read, [0, 1], **OPTIONS)
    assert not any(bool(one.mask.any()) for one in result.views)
    assert result.points.shape == result.colours.shape == (0, 3)
    assert result.mesh is None
    assert not bool(reconstruct_view(read, 0, **OPTIONS).mask.any())


def test_neighbours_share_the_frustum(scene, read):
    chosen = select_neighbours(read, 0, 4, near=1.5, far=2.6)
    assert sorted(chosen) == [1, 2, 3, 4]
    # A view that looks away shares nothing.
    turned = read.cameras.cam_from_world.clone()
    turned[3, :3] = torch.tensor([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]], dtype=torch.float64) @ turned[3, :3]
    from dataclasses import replace

    away = replace(read, cameras=read.cameras._replace(cam_from_world=turned))
    assert sorted(select_neighbours(away, 0, 4, near=1.5, far=2.6)) == [1, 2, 4]


def test_the_range_is_told_by_points_that_the_view_sees(scene, tmp_path):
    read = data.open(write_colmap(scene, tmp_path, form="binary"))
    result = reconstruct_scene(read, [0, 1], planes=32, mesh=False)
    depth = scene.points @ scene.R[0][2] + scene.t[0][2]
    assert float(result.views[0].depths[0]) < depth.min()
    assert float(result.views[0].depths[-1]) > depth.max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"views": []}, r"views must name at least one view, none twice; got \[\]"),
        ({"views": [0, 0]}, "none twice"),
        ({"views": [5]}, r"view must lie in 0\.\.4; got 5"),
        ({"min_support": 2, "views": [0, 1]}, "min_support must be a whole number from 0 to 1; got int 2"),
        ({"resolution": 2}, "resolution must be a whole number, at least 8; got int 2"),
        ({"density": 0.0}, "density must lie in"),
        ({"near": 3.0, "far": 2.0}, "near and far must be positive, finite and ascending"),
    ],
)
def test_wrong_options_are_named(read, options, message):
    with pytest.raises(OptionError, match=message):
        reconstruct_scene(read, **options)


def test_what_lies_on_the_border_of_a_picture_is_seen_where_the_picture_begins():
    """Pixels -0.5 belong to a picture of 8 x 6, pixels 7.5 and 5.5 no longer do, as for the operators."""
    camera = CameraTensors(torch.eye(3).double()[None], torch.eye(4).double()[None], 6, 8)
    x, y = np.array([(-0.5, 0), (0, -0.5), (7.4, 5.4), (7.5, 0), (0, 5.5), (-0.6, 0)]).T
    points = torch.from_numpy(np.stack([2 * x, 2 * y, np.full(len(x), 2.0)], -1))
    pixels, depth, visible = (part[0] for part in project(camera, points[None]))
    np.testing.assert_allclose(pixels[0], np.stack([x, y], -1), rtol=1e-12)
    np.testing.assert_array_equal(depth, 2.0)
    assert visible.tolist() == [[True, True, True, False, False, False]]
    assert not project(camera, torch.tensor([[[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]])).visible.any()
