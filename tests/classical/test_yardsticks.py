"""What classical reconstruction is measured against: triangulated features, and the plainest sweep."""

import numpy as np
import torch

from benchmarks.classical_rivals import Found, bad_at, luminance, median_at, plain_sweep, winners
from benchmarks.triangulated import Features, triangulate
from lsmgeo.cameras import CameraTensors
from lsmgeo.grids import depth_planes
from tests.data.writers import make_scene, project


def matrices(scene):
    E = np.tile(np.eye(4), (len(scene.R), 1, 1))
    E[:, :3, :3], E[:, :3, 3] = scene.R, scene.t
    return scene.K, E


def test_matched_features_give_the_depth_of_their_points():
    scene = make_scene()
    words = np.random.default_rng(0).random((len(scene.points), 128)).astype(np.float32)
    features = [Features(project(scene, view), words) for view in range(5)]
    found = triangulate(features, *matrices(scene), 1)
    expected = scene.points @ scene.R[1][2] + scene.t[1][2]
    assert len(found.depth) == len(expected)
    np.testing.assert_allclose(found.pixels, project(scene, 1), atol=1e-9)
    np.testing.assert_allclose(found.depth, expected, rtol=1e-9)


def test_matches_off_their_epipolar_lines_do_not_count():
    scene = make_scene()
    words = np.random.default_rng(0).random((len(scene.points), 128)).astype(np.float32)
    generator = np.random.default_rng(1)
    wrong = [project(scene, view) + generator.choice([-7.0, 7.0], (len(words), 2)) * (view != 0) for view in range(5)]
    assert len(triangulate([Features(pixels, words) for pixels in wrong], *matrices(scene), 0).depth) <= 3


def test_the_plainest_sweep_finds_the_plane():
    scene = make_scene()
    K, E = (torch.from_numpy(value) for value in matrices(scene))
    depths = depth_planes(1.5, 2.6, 48, spacing="inverse").numpy()
    order = [0, 1, 3, 4]
    images = [luminance(scene.images[view].transpose(2, 0, 1) / 255) for view in order]
    found = plain_sweep(images, CameraTensors(K[order], E[order], *scene.size), depths)
    step = 1 / depths[0] - 1 / depths[1]
    off = np.abs(1 / found.value - 1 / scene.depth[0])[3:-3, 3:-3] / step
    assert (off <= 1.0).mean() > 0.9


def test_densities_are_of_all_pixels_in_the_order_of_confidence():
    value = np.array([[1.0, 2.0, np.nan, 4.0], [5.0, 6.0, 7.0, 8.0]])
    found = Found(value, np.array([[0.9, 0.1, 1.0, 0.8], [0.7, 0.6, 0.5, 0.4]]))
    np.testing.assert_array_equal(winners(found, 0.25), [[True, False, False, True], [False] * 4])
    assert int(winners(found, 1.0).sum()) == 7
    true = np.array([[1.0, 5.0, 3.0, np.nan], [5.0, 9.0, 7.0, 8.0]])
    np.testing.assert_allclose(bad_at(found, true, 0.5, 2.0), 1 / 3)
    assert median_at(found, true, 0.375) == 0.0
