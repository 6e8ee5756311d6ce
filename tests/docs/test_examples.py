"""The examples run as they stand, and their numbers are what their pages say."""

import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def run(monkeypatch):
    """Run one example by its name and return its variables."""
    plt.switch_backend("Agg")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(plt, "show", lambda: None)
    yield lambda name: runpy.run_path(str(EXAMPLES / f"plot_{name}.py"))
    plt.close("all")


def test_one_view_gives_the_surface_its_paint(run):
    assert run("one_view_unprojected")["error"] < 0.003


def test_two_views_agree_at_the_spheres_radius(run):
    assert abs(run("two_views_agreeing")["best"].median() - 0.4) < 0.002


def test_the_half_pixel_mistake_is_as_large_as_computed(run):
    names = run("half_pixel_mistake")
    assert names["right"].abs().max() < 1e-3
    assert abs(names["wrong"].mean() - 3.5) < 1e-3


def test_inverted_poses_are_found_and_mended(run):
    names = run("wrong_poses")
    assert names["findings"].verdict == "bad"
    assert names["findings"].cause.name == "poses inverted"
    assert names["after"].verdict == "good"
    assert names["after"].checks[0].value < 0.2  # px; as features go


def test_the_sweep_meets_the_sphere_within_a_tenth_of_a_plane(run):
    names = run("plane_sweep_sphere")
    assert names["error"][names["surface"]].max() < 0.1 * names["spacing"]


def test_two_degrees_of_pose_noise_fall_below_a_fifth_of_a_degree(run):
    names = run("pose_noise")
    assert abs(names["errors"][0] - 2.0).max() < 1e-3
    assert names["final"].max() < 0.2


def test_pixels_of_an_analytic_ball_lie_on_it_to_rounding(run):
    names = run("analytic_scene")
    assert int(names["on_ball"].sum()) > 10_000
    assert names["worst"] < 1e-14  # of the float64 pass, the last


def test_a_tenth_of_the_faces_matters_little_to_the_vote(run):
    names = run("mesh_voxels")
    assert names["overlap"](names["before"], names["after"]) > 0.98


def test_two_shapes_of_a_category_share_less_than_a_third(run):
    names = run("synthetic13")
    assert 0 < names["overlap"] < 1 / 3
    assert max(names["found"], key=names["found"].get) == "car"
