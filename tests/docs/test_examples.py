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


def test_a_sweep_of_photographs_is_right_to_a_thousandth_and_knows_where(run):
    names = run("plane_sweep_stereo")
    assert float(names["relative"].median()) < 1e-3
    rates = names["curve"].error
    assert float(rates[:3].max()) < 1e-3
    assert float((names["relative"] > 0.02).float().mean()) > 0.01
    # The camera that cannot see the place disagrees at its depth, and the better half does not mind.
    place = (int((names["planes"] - names["truth"][names["row"], names["column"]]).abs().argmin()), 60, 115)
    assert float(names["costs"][1][place]) > 1
    assert float(names["cost"][place]) < 0.05


def test_planes_a_pixel_apart_are_nearly_enough_and_depths_out_of_range_are_lost(run):
    names = run("depth_range")
    inverse, depth = names["curves"]["inverse"], names["curves"]["depth"]
    assert 16 < names["pixel_planes"] < 32
    assert inverse[0] > 0.5 > 2 * inverse[2]
    assert inverse[2] - inverse[4] < 0.03
    assert all(even < uneven for even, uneven in zip(inverse[:4], depth[:4], strict=True))
    lost = {name: names["off_by"](found, 0.05) for name, found in names["maps"].items()}
    least = lost["as it is"]
    assert least < 0.1
    assert lost["near too far"] > 0.5
    assert lost["far too near"] > 0.25
    assert lost["ten times too wide"] > 2 * least
    assert lost["ten times too wide, 75 planes"] < 1.2 * least


def test_splatted_cars_stay_where_they_are_while_the_depth_is_known(run):
    names = run("birds_eye_view")
    assert names["scores"]["splatted"] > 0.55 > 0.3 > names["scores"]["lifted"]
    assert names["hidden"] > 0.8
    overlaps = names["overlaps"]
    assert overlaps[1:] == sorted(overlaps[1:], reverse=True)
    assert overlaps[3] > 2 * names["scores"]["lifted"] > 2 * overlaps[-1]


def test_a_hull_nears_the_filled_cup_and_never_the_cup(run):
    names = run("visual_hull")
    hollow = names["filled"] & ~names["solid"]
    overlaps = [float(names["metrics"].voxel_iou(hull.occupancy, names["filled"])) for hull in names["hulls"].values()]
    assert overlaps == sorted(overlaps)
    assert overlaps[-1] > 0.98
    assert all(bool(hull.occupancy[hollow].all()) for hull in names["hulls"].values())
    assert float(names["metrics"].voxel_iou(names["hulls"][24].occupancy, names["solid"])) < 0.4


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
    assert names["overlap"](names["whole"], names["voted"]) > 0.98


def test_two_shapes_of_a_category_share_less_than_a_third(run):
    names = run("synthetic13")
    assert 0 < names["overlap"] < 1 / 3
    assert max(names["found"], key=names["found"].get) == "car"
