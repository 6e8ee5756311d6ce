"""What measures the classical machine: its truth and its rivals against scenes known in closed form, and its table."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import classical, classical_stereo, timing
from benchmarks.classical_baselines import Found, bad_at, luminance, median_at, plain_sweep, winners
from benchmarks.classical_rows import Row
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


def test_matches_off_their_epipolar_lines_and_small_angles_do_not_count():
    scene = make_scene()
    words = np.random.default_rng(0).random((len(scene.points), 128)).astype(np.float32)
    generator = np.random.default_rng(1)
    wrong = [project(scene, view) + generator.choice([-7.0, 7.0], (len(words), 2)) * (view != 0) for view in range(5)]
    assert len(triangulate([Features(pixels, words) for pixels in wrong], *matrices(scene), 0).depth) <= 3
    K, E = matrices(scene)
    near = np.stack((E[0], E[0]))
    near[1, 0, 3] += 0.02  # half a degree at a distance of two
    pixels = [(p := scene.K[0] @ (e[:3, :3] @ scene.points.T + e[:3, 3:]))[:2].T / p[2][:, None] for e in near]
    assert len(triangulate([Features(places, words) for places in pixels], K[[0, 0]], near, 0).depth) == 0


def test_the_plainest_sweep_finds_the_plane():
    scene = make_scene()
    K, E = matrices(scene)
    cameras = CameraTensors(torch.from_numpy(K), torch.from_numpy(E), *scene.size)
    depths = depth_planes(1.5, 2.6, 48, spacing="inverse").numpy()
    order = [0, 1, 3, 4]
    images = [luminance(scene.images[view].transpose(2, 0, 1) / 255) for view in order]
    chosen = CameraTensors(cameras.intrinsics[order], cameras.cam_from_world[order], *scene.size)
    found = plain_sweep(images, chosen, depths)
    step = 1 / depths[0] - 1 / depths[1]
    off = np.abs(1 / found.value - 1 / scene.depth[0])[3:-3, 3:-3] / step
    assert (off <= 1.0).mean() > 0.9


def test_densities_are_of_all_pixels_in_the_order_of_confidence():
    value = np.array([[1.0, 2.0, np.nan, 4.0], [5.0, 6.0, 7.0, 8.0]])
    confidence = np.array([[0.9, 0.1, 1.0, 0.8], [0.7, 0.6, 0.5, 0.4]])
    found = Found(value, confidence)
    np.testing.assert_array_equal(winners(found, 0.25), [[True, False, False, True], [False] * 4])
    assert int(winners(found, 1.0).sum()) == 7
    true = np.array([[1.0, 5.0, 3.0, np.nan], [5.0, 9.0, 7.0, 8.0]])
    assert bad_at(found, true, 0.5, 2.0) == pytest.approx(1 / 3)
    assert median_at(found, true, 0.375) == 0.0


def test_a_method_without_an_order_has_one_point_and_others_end_where_they_know_no_more():
    true = np.ones((4, 5))
    flat = Found(np.where(np.arange(20).reshape(4, 5) < 16, 1.0, np.nan), np.ones((4, 5)))
    assert classical_stereo.curve(flat, true) == ([0.8], [0.0])
    ordered = flat._replace(confidence=np.arange(20.0).reshape(4, 5))
    assert classical_stereo.curve(ordered, true)[0] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])


def test_disparities_and_depths_are_inverse():
    disparity = np.array([4.0, 33.5, 64.0])
    np.testing.assert_allclose(classical_stereo.disparity_of(classical_stereo.depth_of(disparity)), disparity)
    assert np.isnan(classical_stereo.disparity_of(np.array([0.0]))).all()


@pytest.mark.parametrize(("reached", "status"), [(True, 0), (False, 1), (None, 0)])
def test_the_table_is_printed_and_kept(tmp_path, monkeypatch, capsys, reached, status):
    row = Row("room", "median error", "1.2 %", "at most 1 %", reached)
    module = SimpleNamespace(measure=lambda root: ([row], {"curve": [1.0, 2.0]}), rows=lambda root: [row])
    monkeypatch.setitem(sys.modules, "benchmarks.classical_stub", module)
    monkeypatch.setattr(classical, "SECTIONS", ("stub",))
    monkeypatch.setattr(timing, "RESULTS", tmp_path)
    monkeypatch.setattr(timing.save, "__defaults__", (tmp_path,))
    assert classical.main(["--data", str(tmp_path)]) == status
    assert "room" in capsys.readouterr().out
    kept = json.loads((tmp_path / "classical.json").read_text())["cases"]
    assert kept[0]["rows"] == [row._asdict()]
    assert kept[0]["curve"] == [1.0, 2.0]
