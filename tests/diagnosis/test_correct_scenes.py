"""Difficult scenes: correct ones are good, and errors that cannot be detected are remarked."""

from dataclasses import replace

import numpy as np
import pytest

from lsmgeo.diagnosis.check_images import examine_images
from lsmgeo.diagnosis.find_cause import is_decisive, is_suspicious
from lsmgeo.diagnosis.findings import Check
from lsmgeo.diagnosis.half_pixel import Shift, is_half_a_pixel, is_large, nearer_half
from tests.diagnosis.textured import planted, trace, with_depth, write


def around(count, distance=2.2):
    """Eyes on a circle, in even steps."""
    angles = 2 * np.pi * np.arange(count) / count
    return [(distance * np.sin(angle), 0.5, -distance * np.cos(angle)) for angle in angles], [0.0] * count


@pytest.fixture
def turntable(tmp_path):
    """Depth of an object from all around, with nothing behind it: every view sees the object whole."""
    traced = trace(*around(12), texture=False)
    traced = replace(traced, depth=np.where(traced.mask, traced.depth, 0))
    return with_depth(write(traced, tmp_path), traced)


def test_depth_all_around_an_object_is_compared_with_views_of_the_same_side(turntable):
    findings = examine_images(turntable).findings
    assert findings.verdict == "good"
    (check,) = findings.checks
    assert check.name == "depth of one view in another"
    assert check.value < 0.5


def test_what_leaves_no_trace_is_said(tmp_path):
    """Level cameras at one height see the same epipolar geometry whether y points up or down."""
    angles = np.radians([-20.0, -8, 3, 15])
    eyes = [(2.2 * np.sin(angle), -0.02, -2.2 * np.cos(angle)) for angle in angles]
    scene = write(trace(eyes, [0.0] * 4), tmp_path)
    for each in (scene, planted(scene, "y flipped")):
        findings = examine_images(each).findings
        assert findings.verdict == "good"
        (remark,) = [remark for remark in findings.remarks if "cannot be detected in this data" in remark]
        assert remark.endswith(": y flipped")
    cause = examine_images(planted(scene, "OpenGL axes")).findings.cause
    assert cause is not None
    assert cause.name == "OpenGL axes"


def test_inverted_poses_are_inferred_from_rotations_only(tmp_path):
    """Correct cameras in one place have no parallax, wrong ones do: its absence is no reason against a correction."""
    scene = write(trace([(0.3, 0.2, -2.2)] * 4, [0.0, 0.25, 0.5, 0.8]), tmp_path)
    cause = examine_images(planted(scene, "poses inverted")).findings.cause
    assert cause is not None
    assert "poses inverted" in (
        cause.name,
        *cause.evidence.rpartition("cannot distinguish it from: ")[2].rstrip(")").split(", "),
    )


def checks(pairs, bad, error):
    share = 100 * (1 - bad / pairs)
    return [
        Check("epipolar error of matched features", error, "px", 1.0, 5000, "matches"),
        Check("pairs of images that agree", share, "%", 90.0, pairs, "pairs", at_least=True),
    ]


def test_one_bad_pair_of_few_is_not_suspicious():
    assert not is_suspicious(checks(14, 1, 0.1))
    assert not is_decisive(checks(14, 1, 0.1), checks(14, 0, 0.1))
    assert is_suspicious(checks(40, 3, 0.1))
    assert is_suspicious(checks(14, 2, 0.1))
    assert is_decisive(checks(14, 2, 0.1), checks(14, 0, 0.1))


def test_large_shifts_are_no_half_pixels():
    assert is_half_a_pixel(Shift("matched features", 0.5, 0.6, 0.05, 0.05))
    assert not is_large(Shift("matched features", 0.5, 0.6, 0.05, 0.05))
    large = Shift("matched features", 0.05, 5.9, 0.02, 0.03)
    assert is_large(large)
    assert not is_half_a_pixel(large)
    assert not is_large(large._replace(error_y=2.0))


def test_the_sign_is_inferred_from_the_axis_that_is_certain():
    assert nearer_half(Shift("matched features", -0.1, 0.5, 0.3, 0.05)) == 0.5
    assert nearer_half(Shift("matched features", -0.5, 0.1, 0.05, 0.3)) == -0.5
