"""Calibrations of rendered chessboards: the truth passes, and each planted error fails and is reported."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lsmgeo import data
from lsmgeo.data import Board, CalibratedLens, Calibration, Rig
from lsmgeo.diagnosis.check_calibration import examine_calibration
from lsmgeo.diagnosis.chessboards import board_points, find_corners
from lsmgeo.diagnosis.findings import report
from tests.data.real_sets import real_set

HERE = Path("rig.yml")
SIZE = (240, 320)
SQUARE = 0.03
CORNERS = (9, 6)
INTRINSICS = np.array([[[300.0, 0, 163], [0, 302, 118], [0, 0, 1]], [[350.0, 0, 156], [0, 348, 123], [0, 0, 1]]])
COEFFICIENTS = ((-0.15, 0.05, 0.0, 0.0), (-0.2, 0.08, 0.0, 0.0))
R = cv2.Rodrigues(np.array([0.03, -0.08, 0.05]))[0]
T = np.array([-2.0, 0.25, 0.2])
OPENGL, FLIP = np.diag([1.0, -1.0, -1.0]), np.diag([1.0, -1.0, 1.0])


def poses():
    """Board-to-first-camera, lengths in squares: the board in front of the camera, tilted and rotated."""
    rng = np.random.default_rng(3)
    for _ in range(7):
        turn = cv2.Rodrigues(rng.uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.3]))[0]
        middle = np.array([rng.uniform(0.6, 2.0), rng.uniform(-1.0, 1.0), rng.uniform(15, 18)])
        yield turn, middle - turn @ [4, 2.5, 0]


def render(K, coefficients, turn, shift):
    """An image of the board, 3 x 3 rays per pixel; the distortion is inverted by fixed-point iteration."""
    steps = (np.arange(3) - 1) / 3
    v, u = ((np.arange(n)[:, None] + steps).ravel() for n in SIZE)
    x, y = np.meshgrid(((u - K[0, 2]) / K[0, 0]).astype(np.float32), ((v - K[1, 2]) / K[1, 1]).astype(np.float32))
    a, b = x, y
    for _ in range(6):
        square = a * a + b * b
        factor = 1 + coefficients[0] * square + coefficients[1] * square * square
        a, b = x / factor, y / factor
    rays = np.stack([a, b, np.ones_like(a)], -1) @ turn.astype(np.float32)
    origin = -turn.T @ shift
    places = origin[:2] - rays[..., :2] * (origin[2] / rays[..., 2])[..., None]
    columns, rows = np.floor(places[..., 0]), np.floor(places[..., 1])
    inside = (columns >= -1) & (columns < CORNERS[0]) & (rows >= -1) & (rows < CORNERS[1])
    grey = np.where(inside & ((columns + rows) % 2 == 0), 40.0, 215.0)
    grey = grey.reshape(SIZE[0], 3, SIZE[1], 3).mean((1, 3))
    return np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, -1)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    sides = ([], [])
    for number, (turn, shift) in enumerate(poses()):
        for side, pose in enumerate(((turn, shift), (R @ turn, R @ shift + T))):
            sides[side].append(folder / f"{'left' if side == 0 else 'right'}{number}.png")
            Image.fromarray(render(INTRINSICS[side], COEFFICIENTS[side], *pose)).save(sides[side][-1])
    lenses = {
        name: CalibratedLens("perspective", K, D, SIZE, None, HERE)
        for name, K, D in zip(("first", "second"), INTRINSICS, COEFFICIENTS, strict=True)
    }
    rig = Rig(R, T * SQUARE, HERE)
    return Calibration(lenses, rig, Board(CORNERS, SQUARE), tuple(map(tuple, sides)))


def values(findings):
    return {check.name: check.value for check in findings.checks}


def with_rig(truth, rotation, translation):
    return replace(truth, rig=Rig(rotation, translation, HERE))


def with_lenses(truth, change):
    return replace(truth, lenses={name: replace(lens, intrinsics=change(lens)) for name, lens in truth.lenses.items()})


def test_corners_are_where_they_were_rendered(truth):
    for (turn, shift), path in zip(poses(), truth.images[0], strict=True):
        found = find_corners(data.read_image(path), CORNERS)
        expected, _ = cv2.projectPoints(
            board_points(CORNERS), cv2.Rodrigues(turn)[0], shift, INTRINSICS[0], np.array(COEFFICIENTS[0])
        )
        assert np.abs(found - expected[:, 0]).max() < 0.35
    assert find_corners(np.full((240, 320, 3), 128, np.uint8), CORNERS) is None


def test_the_truth_is_good(truth):
    findings = examine_calibration(truth, HERE)
    assert findings.verdict == "good"
    assert findings.remarks == ()
    assert set(values(findings)) == {
        "rms of a stereo calibration from scratch", "rms under the lens first", "rms under the lens second",
        "rms of corners transferred by the rig",
    }  # fmt: skip
    assert max(values(findings).values()) < 0.2
    assert all(check.measured in (7 * 54, 14 * 54) for check in findings.checks)
    facts = dict(findings.facts)
    assert facts["rig"].endswith(f"{np.linalg.norm(T):.3f} squares")
    measured = float(facts["measured baseline"].split()[0])
    np.testing.assert_allclose(measured, np.linalg.norm(T), rtol=0.01)


RIGS = {
    "poses inverted": (R.T, -R.T @ T),
    "OpenGL axes": (OPENGL @ R @ OPENGL, OPENGL @ T),
    "y flipped": (FLIP @ R @ FLIP, FLIP @ T),
    "rotation transposed": (R.T, T),
    "translation negated": (R, -T),
}


@pytest.mark.parametrize("name", RIGS)
def test_an_error_in_the_rig_is_reported(truth, name):
    rotation, translation = RIGS[name]
    findings = examine_calibration(with_rig(truth, rotation, translation * SQUARE), HERE)
    assert findings.verdict == "bad"
    assert findings.cause.name == name
    assert values(findings)["rms of corners transferred by the rig"] > 1
    assert "falls from" in findings.cause.evidence


@pytest.mark.parametrize("scale", [0.5, 2.0, 1.5])
def test_k_of_another_resolution_is_reported(truth, scale):
    wrong = with_lenses(truth, lambda lens: np.diag([scale, scale, 1]) @ lens.intrinsics)
    findings = examine_calibration(wrong, HERE)
    assert findings.verdict == "bad"
    assert findings.cause.name == "K of another resolution"
    stated = float(findings.cause.evidence.split("with K times ")[1].split(",")[0])
    np.testing.assert_allclose(stated, 1 / scale, rtol=0.02)
    # The rig is measured with lenses calibrated from the images.
    assert values(findings)["rms of corners transferred by the rig"] < 1


@pytest.mark.parametrize("order", [(1, 2, 3, 4, 5, 6, 0), (1, 0, 2, 3, 4, 5, 6), (6, 5, 4, 3, 2, 1, 0)])
def test_shuffled_frames_are_reported_and_paired(truth, order):
    first, second = truth.images
    findings = examine_calibration(replace(truth, images=(first, tuple(second[index] for index in order))), HERE)
    assert findings.verdict == "bad"
    assert findings.cause.name == "frames shuffled"
    assert values(findings)["rms of a stereo calibration from scratch"] > 1
    assert "left0.png with right0.png, left1.png with right1.png" in findings.cause.remedy


def test_half_a_pixel_cannot_be_detected_with_a_board(truth):
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    findings = examine_calibration(with_lenses(truth, lambda lens: lens.intrinsics + shift), HERE)
    assert findings.verdict == "good"


def test_another_lens_is_reported(truth):
    other = {name: replace(lens, coefficients=(0.6, -1.0, 0.0, 0.0)) for name, lens in truth.lenses.items()}
    findings = examine_calibration(replace(truth, lenses=other), HERE)
    assert findings.cause.name == "lens of other images"
    assert "the distortion has the opposite sign: k1 is stated as +0.6 and measured as -0." in findings.cause.evidence


def test_both_cameras_have_their_facts(truth):
    findings = examine_calibration(truth, HERE)
    names = [name for name, _ in findings.facts]
    assert len(names) == len(set(names))
    assert {"first camera anew", "second camera anew"} <= set(names)
    assert "good: the lenses fit the images of the board" in report(findings)


def test_exchanged_lenses_are_reported(truth):
    lenses = {"first": truth.lenses["second"], "second": truth.lenses["first"]}
    findings = examine_calibration(replace(truth, lenses=lenses), HERE)
    assert findings.cause.name == "left and right exchanged"


def test_other_units_of_the_rig_are_remarked(truth):
    findings = examine_calibration(with_rig(truth, R, 1000 * SQUARE * T), HERE)
    assert findings.verdict == "good"
    assert "other units" in findings.remarks[0]


def one_camera(truth, change=lambda turn, shift: (turn, shift)):
    rows = []
    for turn, shift in poses():
        turn, shift = change(turn, shift)
        rows.append(np.concatenate([cv2.Rodrigues(turn)[0].ravel(), shift * SQUARE]))
    lens = replace(truth.lenses["first"], views=np.array(rows))
    return Calibration({"left": lens}, None, truth.board, truth.images[:1])


VIEWS = {
    "poses inverted": lambda turn, shift: (turn.T, -turn.T @ shift),
    "OpenGL axes": lambda turn, shift: (OPENGL @ turn, OPENGL @ shift),
    "y flipped": lambda turn, shift: (FLIP @ turn @ FLIP, FLIP @ shift),
}


def test_stated_poses_of_the_board_are_compared(truth):
    findings = examine_calibration(one_camera(truth), HERE)
    assert findings.verdict == "good"
    assert values(findings)["rms under the poses of left"] < 0.2
    for name, change in VIEWS.items():
        findings = examine_calibration(one_camera(truth, change), HERE)
        assert findings.cause.name == name
    shifted = replace(one_camera(truth), images=(truth.images[0][1:] + truth.images[0][:1],))
    assert examine_calibration(shifted, HERE).cause.name == "frames shuffled"


def test_what_cannot_be_measured_is_unknown(truth, tmp_path):
    findings = examine_calibration(replace(truth, images=()), HERE)
    assert (findings.verdict, findings.checks) == ("unknown", ())
    assert "names no image of a board" in findings.gap.reason
    Image.new("RGB", (320, 240)).save(tmp_path / "a.png")
    findings = examine_calibration(replace(truth, images=((tmp_path / "a.png",),)), HERE)
    assert findings.verdict == "unknown"
    assert findings.gap.reason == "no board was found in 1 image of the camera"
    few = replace(truth, images=tuple(side[:2] for side in truth.images))
    findings = examine_calibration(few, HERE)
    assert "too few images" in findings.remarks[0]
    assert set(values(findings)) == {"rms under the lens first", "rms under the lens second"}


def test_opencv_s_chessboards_reach_their_figure():
    folder = real_set("opencv_stereo")
    calibration = data.read_calibration(folder / "stereo_calib.xml")
    findings = examine_calibration(calibration, folder)
    assert findings.verdict == "good"
    np.testing.assert_allclose(values(findings)["rms of a stereo calibration from scratch"], 0.217, atol=0.0005)
    # Two of the stated lenses are those of the images; the first in intrinsics.yml is not.
    findings = examine_calibration(data.read_calibration(folder), folder)
    measured = values(findings)
    np.testing.assert_allclose(measured["rms under the lens left_intrinsics"], 0.206, atol=0.005)
    np.testing.assert_allclose(measured["rms under the lens second"], 0.606, atol=0.01)
    np.testing.assert_allclose(measured["rms under the lens first"], 2.045, atol=0.02)
    assert findings.cause.name == "lens of other images"
