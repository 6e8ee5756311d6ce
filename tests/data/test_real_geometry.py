"""Real images with measured geometry: each set's figure is reached through our readers and converters.

The folder is named by ``LSMGEO_TEST_DATA``; the sets themselves cannot be distributed.
"""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import cli, data
from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import reconstruct_view
from lsmgeo.functional import sample_views
from tests.data.real_sets import real_set
from tests.data.test_stereo_pairs import write_pair


def fundamental(cameras: CameraTensors, first: int, second: int) -> np.ndarray:
    """F with ``x2^T F x1 = 0``, from K and the relative pose."""
    K, E = cameras.intrinsics.double().numpy(), cameras.cam_from_world.double().numpy()
    relative = E[second] @ np.linalg.inv(E[first])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(K[second]).T @ cross @ relative[:3, :3] @ np.linalg.inv(K[first])


def epipolar_errors(cameras, images, pairs, *, sampson=False):
    """Distances in pixels of SIFT matches from their epipolar lines: the mean of both images, or Sampson's."""
    sift = cv2.SIFT_create()
    found = {}
    for index in {index for pair in pairs for index in pair}:
        found[index] = sift.detectAndCompute(cv2.cvtColor(images[index], cv2.COLOR_RGB2GRAY), None)
    errors = []
    for first, second in pairs:
        (keys1, words1), (keys2, words2) = found[first], found[second]
        matches = cv2.BFMatcher().knnMatch(words1, words2, k=2)
        good = [best for best, other in matches if best.distance < 0.7 * other.distance]
        a = np.array([(*keys1[match.queryIdx].pt, 1.0) for match in good])
        b = np.array([(*keys2[match.trainIdx].pt, 1.0) for match in good])
        F = fundamental(cameras, first, second)
        residual = np.abs((b @ F * a).sum(1))
        normal1, normal2 = np.hypot(*(b @ F)[:, :2].T), np.hypot(*(a @ F.T)[:, :2].T)
        distance = residual / np.hypot(normal1, normal2) if sampson else 0.5 * residual * (1 / normal1 + 1 / normal2)
        errors.append(distance[distance < 3.0])  # beyond that a match is wrong, not inexact
    return np.concatenate(errors)


def test_temple_epipolar_error():
    scene = data.open(real_set("middlebury_temple"))
    images = [data.read_image(path) for path in scene.paths]
    assert len(scene) == 16
    errors = epipolar_errors(scene.cameras, images, [(0, 1), (2, 3), (3, 4), (5, 6), (6, 7), (7, 8), (8, 9), (11, 12)])
    assert len(errors) > 500
    assert np.median(errors) < 0.18


def test_fountain_epipolar_error():
    scene = data.open(real_set("strecha_fountain_quarter"))
    images = [data.read_image(path) for path in scene.paths]
    errors = epipolar_errors(scene.cameras, images, [(index, index + 1) for index in range(0, 10, 2)])
    assert len(errors) > 500
    assert np.median(errors) < 0.10


def test_nerf_epipolar_error():
    scene = data.open(real_set("nerf_lego"))
    # On white: cut out against the black of transparent pixels, the edges would move.
    images = [(255 * scene.load(view)).round().byte().permute(1, 2, 0).numpy() for view in range(len(scene))]
    # The two frames 7 degrees apart; all others are too far from each other to match.
    pair = [scene.names.index(f"./train/r_{number}") for number in (70, 55)]
    errors = epipolar_errors(scene.cameras, images, [pair], sampson=True)
    assert len(errors) > 100
    assert np.median(errors) < 0.17


def test_colmap_reprojection_error():
    scene = data.open(real_set("colmap_scene"))
    assert len(scene) == 23
    assert len(scene.points.positions) == 1443
    errors = []
    for view, observed in enumerate(scene.points.observations):
        E = scene.cameras.cam_from_world[view].numpy()
        pixels, _ = cv2.projectPoints(
            scene.points.positions[observed.points], E[:3, :3], E[:3, 3], scene.cameras.intrinsics[view].numpy(), None
        )
        errors.append(np.linalg.norm(pixels[:, 0] - observed.pixels, axis=1))
    errors = np.concatenate(errors)
    assert len(errors) == 5931
    np.testing.assert_allclose(np.median(errors), 0.245, atol=0.005)
    np.testing.assert_allclose(np.sqrt(np.mean(errors**2)), 0.366, atol=0.005)


@pytest.mark.parametrize(
    ("first", "second"),
    [("00005.png", "00010.png"), ("00010.png", "00015.png"), ("00055.png", "00060.png"), ("00090.png", "00095.png")],
)
def test_hololens_depth_of_one_frame_is_that_of_another(first, second):
    scene = data.open(real_set("hololens_rgbd"))
    assert len(scene) == 29
    views = [scene.names.index(name) for name in (first, second)]
    cameras = CameraTensors(*(torch.as_tensor(value)[views] for value in scene.cameras))
    depths = [scene.load_depth(view).double() for view in views]
    v, u = torch.nonzero(depths[0] > 0, as_tuple=True)
    rays = torch.linalg.solve(cameras.intrinsics[0], torch.stack([u, v, torch.ones_like(u)]).double())
    camera = rays * depths[0][v, u]
    world = cameras.cam_from_world[0, :3, :3].T @ (camera - cameras.cam_from_world[0, :3, 3:])
    moved = cameras.cam_from_world[1, :3, :3] @ world + cameras.cam_from_world[1, :3, 3:]
    pixels = (cameras.intrinsics[1] @ moved)[:2] / moved[2]
    sampled = sample_views(
        depths[1][None, None, None],
        pixels.T[None, None],
        moved[2][None, None],
        (moved[2] > 0)[None, None],
        mode="nearest",
    )
    there = sampled.volume[0, 0, 0]
    both = sampled.visible[0, 0] & (there > 0)
    errors = ((moved[2] - there).abs() / there)[both]
    assert int(both.sum()) > 30_000
    assert float(errors.median()) < 0.003
    assert float((errors < 0.02).double().mean()) > 0.97


def test_the_motorcycle_s_right_image_becomes_the_left_one(tmp_path):
    path = real_set("middlebury_motorcycle")
    images = [np.asarray(Image.open(path / f"motorcycle_{side}.png").convert("RGB")) for side in ("left", "right")]
    disparity = np.load(path / "motorcycle_disp.npz")["arr_0"].astype(np.float32)
    numbers = (994.978, 311.193, 254.877, 31.086, 193.001)
    written, _ = write_pair(tmp_path, images, [disparity, None], numbers)
    scene = data.open(written)
    depth = scene.load_depth(0).double()
    K, E = scene.cameras.intrinsics, scene.cameras.cam_from_world
    v, u = torch.nonzero(depth > 0, as_tuple=True)
    assert len(u) == np.isfinite(disparity).sum()
    rays = torch.linalg.solve(K[0], torch.stack([u, v, torch.ones_like(u)]).double())
    moved = K[1] @ (E[1, :3, :3] @ (rays * depth[v, u]) + E[1, :3, 3:])
    pixels = np.full((*depth.shape, 2), -1, np.float32)
    pixels[v, u] = (moved[:2] / moved[2]).T.numpy()
    inside = pixels[..., 0] >= 0
    left, right = (scene.load(view).permute(1, 2, 0).numpy() * 255 for view in (0, 1))
    warped = cv2.remap(right, pixels, None, cv2.INTER_LINEAR)
    assert np.median(np.abs(warped - left)[inside]) < 3.05
    assert np.median(np.abs(right - left)[inside]) > 20


def test_colmap_depth_error_at_its_own_points():
    scene = data.open(real_set("colmap_scene"))
    result = reconstruct_view(scene, 5, size=250)
    assert result.error.points > 200
    assert result.error.median < 0.005


def test_the_temple_lies_inside_its_published_box(tmp_path, capsys):
    path = real_set("middlebury_temple")
    arguments = ["reconstruct", str(path), "--view", "6", "--size", "200", "--out", str(tmp_path)]
    assert cli.main(arguments) == 0
    import trimesh

    points = np.asarray(trimesh.load(tmp_path / "points.ply").vertices)
    assert len(points) > 3000
    lower, upper = np.array([-0.073568, 0.021728, -0.012445]), np.array([0.028855, 0.181892, 0.062736])
    inside = ((points > lower - 0.003) & (points < upper + 0.003)).all(1)
    assert inside.mean() > 0.9
