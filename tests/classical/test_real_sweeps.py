"""Real images at a quarter of the work: the figures that ``python -m benchmarks classical`` prints in full.

The folder is named by ``LSMGEO_TEST_DATA``; the sets themselves cannot be distributed.
"""

import numpy as np
import pytest

from benchmarks import classical
from benchmarks.classical_rivals import bad_at, winners
from lsmgeo import data
from lsmgeo.classical import reconstruct_scene
from tests.data.real_sets import real_set


def test_the_motorcycle_is_swept_better_than_by_the_plainest_sweep():
    methods, true, agreed = classical.motorcycle(real_set("middlebury_motorcycle").parent, planes=61, unfiltered=False)
    ours, plain, rival = (methods[name] for name in ("ours, filtered", "plain ZNCC", "StereoSGBM"))
    for density in classical.DENSITIES:
        assert bad_at(ours, true, density, 2.0) < bad_at(plain, true, density, 2.0)
    assert agreed >= 0.7
    both = winners(ours, agreed) & np.isfinite(rival.value) & np.isfinite(true)
    mine, theirs = ((np.abs(method.value - true)[both] > 2.0).mean() for method in (ours, rival))
    assert mine <= 1.5 * theirs


@pytest.mark.long
def test_depth_of_a_room_is_twice_as_good_as_the_plainest_sweeps():
    found = classical.walk(real_set("hololens_rgbd").parent, [21])
    assert found["ours"].shape == (1, 3)
    assert (found["ours"] <= 0.5 * found["plain ZNCC"]).all()


@pytest.mark.parametrize("name", [pytest.param("fountain", marks=pytest.mark.long), "temple", "COLMAP scene"])
def test_depth_agrees_with_triangulated_features(name):
    scene = data.open(real_set(classical.POSED[name]))
    swept = reconstruct_scene(scene, [1], size=256, planes=96, density=1.0, mesh=False, neighbours=3).views[0]
    assert float((swept.depth_map.depth > 0).float().mean()) >= 0.4
    if scene.points is not None:
        truth = classical.sparse_of(scene, 1)
    else:
        near = [1, *swept.neighbours]
        truth = classical.triangulated_of(scene, [1], near)[0]
    errors = classical.errors_at(swept, truth, scene.size(1), 0.4)
    assert len(errors) > 50
    assert np.median(errors) < 0.005
