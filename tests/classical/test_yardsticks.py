"""What classical reconstruction is measured against: triangulated features, and the plainest sweep."""

import numpy as np
import torch

from benchmarks.classical_rivals import luminance, plain_sweep
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
