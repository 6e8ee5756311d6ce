"""Mistakes planted in real photographs of measured geometry are named, and the sets as they are are not accused."""

import numpy as np
import pytest

from lsmgeo import data
from lsmgeo.diagnosis.check_images import examine_images
from tests.data.real_sets import real_set
from tests.diagnosis.textured import planted

SETS = {
    "middlebury_temple": ("epipolar", 0.16),
    "strecha_fountain_quarter": ("epipolar", 0.09),
    "colmap_scene": ("reprojection", 0.25),
}


MISTAKES = ["poses inverted", "OpenGL axes", "y flipped", "half a pixel", "K of another resolution", "frames shuffled"]
# Of sets that take longer, these are planted every time and the others in the long run.
QUICK = {"strecha_fountain_quarter": ("half a pixel", "frames shuffled"), "colmap_scene": ("half a pixel",)}


def named(name, mistake):
    cause = examine_images(planted(data.open(real_set(name)), mistake)).findings.cause
    return None if cause is None else cause.name


@pytest.mark.parametrize("name", SETS)  # in one test, so that one worker matches a set and no other does
def test_the_measured_figure_is_reached_and_planted_mistakes_are_named(name):
    kind, expected = SETS[name]
    findings = examine_images(data.open(real_set(name))).findings
    assert findings.verdict == "good"
    check = next(check for check in findings.checks if kind in check.name)
    assert check.measured > 1000
    np.testing.assert_array_less(check.value, expected)
    planted_here = QUICK.get(name, MISTAKES)
    assert {mistake: named(name, mistake) for mistake in planted_here} == {mistake: mistake for mistake in planted_here}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "mistake"), [(name, mistake) for name in QUICK for mistake in MISTAKES if mistake not in QUICK[name]]
)
def test_every_planted_mistake_is_named(name, mistake):
    assert named(name, mistake) == mistake
