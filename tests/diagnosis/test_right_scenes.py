"""Right scenes in which it is easy to be mistaken: nothing is said against them."""

from dataclasses import replace

import numpy as np
import pytest

from lsmgeo.diagnosis.photographs import examine_photographs
from tests.diagnosis.textured import trace, with_depth, write


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
    findings = examine_photographs(turntable).findings
    assert findings.verdict == "good"
    (check,) = findings.checks
    assert check.name == "depth of one view in another"
    assert check.value < 0.5
