"""Depth ranges inferred from cameras, and found by sweeping where these are wrong."""

import numpy as np
import pytest
from PIL import Image

from lsmgeo import data
from lsmgeo.classical import default_depth_range, find_depth_range, reconstruct_view
from lsmgeo.errors import OptionError
from tests.classical.analytic import texture
from tests.data.writers import make_scene, write_colmap
from tests.oracle import hit_plane, look_at

SIZE, FOCAL = (120, 160), 180.0
EYES = np.array([[0.0, 0.0, -2.0], [0.3, 0.0, -2.0], [-0.25, 0.1, -2.0], [0.05, -0.3, -2.0]])


def write_images(folder, focus):
    """Images of a steep plane by cameras that look at a point, or straight ahead; and the first one's depth."""
    height, width = SIZE
    v, u = np.mgrid[:height, :width].astype(float)
    K = np.array([[FOCAL, 0, width / 2 - 0.5], [0, FOCAL, height / 2 - 0.5], [0, 0, 1]])
    rays = np.stack((u, v, np.ones_like(u)), -1).reshape(-1, 3) @ np.linalg.inv(K).T
    lines, depths = [str(len(EYES))], []
    for view, eye in enumerate(EYES):
        R, t = (np.eye(3), -eye) if focus is None else look_at(eye, np.array(focus), np.array([0.0, -1.0, 0.0]))
        directions = rays @ R
        depth = hit_plane(np.broadcast_to(eye, directions.shape), directions, np.array([1.0, 0.2, 1.0]), 0.0)
        grey = texture(eye + depth[:, None] * directions, 0, 0.09).reshape(height, width)
        Image.fromarray(np.round(255 * np.repeat(grey[..., None], 3, -1)).astype(np.uint8)).save(
            folder / f"v{view}.png"
        )
        lines.append(" ".join([f"v{view}.png", *(repr(float(x)) for x in (*K.ravel(), *R.ravel(), *t))]))
        depths.append(depth)
    (folder / "scene_par.txt").write_text("\n".join(lines) + "\n")
    return data.open(folder), depths[0]


def check_found(scene, depth):
    near, far = find_depth_range(scene, 0)
    low, high = np.percentile(depth, (5, 95))
    assert 0.5 * depth.min() < near < low
    assert high < far < 2 * depth.max()


def test_parallel_cameras_tell_depth_by_disparity(tmp_path):
    scene, depth = write_images(tmp_path, None)
    closest = np.linalg.norm(EYES[1:] - EYES[0], axis=1).min()
    expected = [FOCAL * closest / (fraction * SIZE[1]) for fraction in (0.3, 0.01)]
    np.testing.assert_allclose(default_depth_range(scene, 0), expected)
    assert expected[1] > 4 * depth.max()
    check_found(scene, depth)


def test_what_lies_elsewhere_than_the_cameras_look_is_found(tmp_path):
    scene, depth = write_images(tmp_path, (0.0, 0.0, -0.9))
    _, far = default_depth_range(scene, 0)
    assert far < np.median(depth)
    check_found(scene, depth)


def test_measured_points_decide(tmp_path):
    scene = make_scene()
    read = data.open(write_colmap(scene, tmp_path, form="text"))
    assert find_depth_range(read, 1) == default_depth_range(read, 1)


def test_images_without_texture_leave_the_range_of_the_cameras(tmp_path):
    scene, _ = write_images(tmp_path, (0.0, 0.0, 0.0))
    for path in scene.paths:
        Image.new("RGB", SIZE[::-1], (90, 90, 90)).save(path)
    assert find_depth_range(scene, 0) == default_depth_range(scene, 0)


def test_cameras_in_one_place_tell_nothing(tmp_path):
    scene, _ = write_images(tmp_path, None)
    E = scene.cameras.cam_from_world.clone()
    E[:, :3, 3] = E[:1, :3, 3]
    same = data.PosedImages(scene.names, scene.paths, scene.cameras._replace(cam_from_world=E), None, scene.source)
    with pytest.raises(OptionError, match="view 0: the cameras look at no common point; give near and far"):
        default_depth_range(same, 0)


def test_a_given_end_beyond_the_found_range_falls_back_on_the_cameras(tmp_path, monkeypatch):
    scene, _ = write_images(tmp_path, (0.0, 0.0, 0.0))
    near, far = default_depth_range(scene, 0)
    monkeypatch.setattr("lsmgeo.classical.stereo.find_depth_range", lambda *_, **__: (0.1 * near, 0.2 * near))
    one = reconstruct_view(scene, 0, near=near, planes=8, size=32)
    np.testing.assert_allclose([one.depths[0], one.depths[-1]], [near, far])
