"""Voxels against their mesh: correct ones pass, and every error is reported."""

import re

import numpy as np
import pytest
import torch
import trimesh

from lsmgeo import VoxelGrid, data
from lsmgeo.diagnosis.check_voxels import examine_voxels
from tests.data.real_sets import real_set
from tests.data.release_writers import binvox_bytes

# No symmetry, and off the centre of the grid.
CORNERS = np.array([[0.1, 0.2, 0.1], [0.9, 0.3, 0.2], [0.35, 1.3, 0.15], [0.3, 0.35, 0.7]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
SIDE, LOWER, SCALE = 24, np.array([0.05, 0.1, -0.3]), 1.3


def tetrahedron():
    """(x, y, z) bool: every voxel that the tetrahedron may touch, by the distances to its four planes."""
    line = (np.arange(SIDE) + 0.5) / SIDE * SCALE
    centres = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1) + LOWER
    inside = np.ones((SIDE,) * 3, bool)
    for a, b, c in CORNERS[FACES]:
        normal = np.cross(b - a, c - a)
        inside &= (centres - a) @ normal <= np.abs(normal).sum() * 0.5 * SCALE / SIDE
    return inside


@pytest.fixture
def folder(tmp_path):
    trimesh.Trimesh(CORNERS, FACES, process=False).export(tmp_path / "thing.obj")
    (tmp_path / "thing.binvox").write_bytes(binvox_bytes(tetrahedron(), tuple(LOWER), SCALE))
    return tmp_path


def rewritten(folder, occupied, lower=tuple(LOWER), scale=SCALE):
    path = folder / "thing.binvox"
    path.write_bytes(binvox_bytes(occupied, lower, scale))
    return examine_voxels(data.read_binvox(path), path)


def test_voxels_at_their_mesh_are_good(folder):
    assert tetrahedron().mean() < 0.2
    for path in (folder, folder / "thing.binvox"):
        findings = examine_voxels(data.read_binvox(path), path)
        assert findings.verdict == "good"
        assert [check.value for check in findings.checks] == pytest.approx([100.0, 100.0], abs=0.5)
        facts = dict(findings.facts)
        assert facts["voxels"] == "24 x 24 x 24 (x, y, z)"
        assert facts["occupied"] == f"{tetrahedron().sum():,} ({100 * tetrahedron().mean():.2f} %)"
        assert facts["box of the grid"] == "x 0.05 to 1.35, y 0.1 to 1.4, z -0.3 to 1"
        assert facts["box of the mesh"] == "x 0.1 to 0.9, y 0.2 to 1.3, z 0.1 to 0.7"
        assert facts["mesh"] == "thing.obj, 4 faces"


def test_the_other_placement_is_reported(folder):
    path = folder / "thing.binvox"
    findings = examine_voxels(data.read_binvox(path, placement="centred"), path)
    assert findings.verdict == "bad"
    assert findings.cause.name == "voxels placed otherwise"
    assert "placement='header'" in findings.cause.remedy
    trimesh.Trimesh(CORNERS - LOWER - SCALE / 2, FACES, process=False).export(folder / "thing.obj")
    findings = examine_voxels(data.read_binvox(path), path)
    assert findings.cause.name == "voxels placed otherwise"
    assert "placement='centred'" in findings.cause.remedy
    assert examine_voxels(data.read_binvox(path, placement="centred"), path).verdict == "good"


CHANGES = [
    ((0, 2, 1), ()),
    ((2, 1, 0), ()),
    ((1, 2, 0), ()),
    ((0, 1, 2), (1,)),
    ((0, 1, 2), (0, 2)),
    ((1, 0, 2), (0,)),
]


@pytest.mark.parametrize(("axes", "flips"), CHANGES)
def test_axes_that_are_exchanged_or_flipped_are_reported(folder, axes, flips):
    """The remedy, applied to the damaged grid, gives the correct one."""
    damaged = np.flip(tetrahedron().transpose(axes), flips)
    findings = rewritten(folder, damaged)
    assert findings.verdict == "bad"
    assert findings.cause.name == "axes of the voxels exchanged or flipped"
    stated = re.findall(r"[xyz] is (minus )?([xyz])", findings.cause.remedy)
    assert len(stated) == 3
    fixed = damaged.transpose(["xyz".index(axis) for _, axis in stated])
    fixed = np.flip(fixed, tuple(k for k, (minus, _) in enumerate(stated) if minus))
    np.testing.assert_array_equal(fixed, tetrahedron())


def test_both_errors_at_once(folder):
    path = folder / "thing.binvox"
    path.write_bytes(binvox_bytes(tetrahedron().transpose(0, 2, 1), tuple(LOWER), SCALE))
    findings = examine_voxels(data.read_binvox(path, placement="centred"), path)
    assert findings.cause.name == "axes of the voxels exchanged or flipped"
    assert "placement='header'" in findings.cause.remedy
    assert "y is z, z is y" in findings.cause.remedy


def test_a_full_grid_and_an_empty_one_are_bad(folder):
    full = rewritten(folder, np.ones((SIDE,) * 3, bool))
    assert full.checks[0].passed
    assert not full.checks[1].passed
    assert full.verdict == "bad"
    empty = rewritten(folder, np.zeros((SIDE,) * 3, bool))
    assert [check.value for check in empty.checks] == [0.0, 0.0]
    assert empty.verdict == "bad"
    assert "box of the occupied voxels" not in dict(empty.facts)


def test_another_scale_is_bad_without_a_cause(folder):
    findings = rewritten(folder, tetrahedron(), scale=1.1 * SCALE)
    assert findings.verdict == "bad"
    assert findings.cause is None


def test_without_a_mesh_nothing_is_known(folder):
    path = folder / "thing.binvox"
    voxels = data.read_binvox(path)
    (folder / "thing.obj").rename(folder / "first.obj")
    assert examine_voxels(voxels, path).verdict == "good"  # the only mesh there
    (folder / "first.obj").rename(folder / "model.obj")
    (folder / "other.ply").write_text("no mesh")
    assert examine_voxels(voxels, path).verdict == "good"  # of the usual name
    (folder / "model.obj").write_text("no mesh")
    findings = examine_voxels(voxels, path)
    assert findings.verdict == "unknown"
    assert "cannot be read" in findings.gap.reason
    for file in (folder / "model.obj", folder / "other.ply"):
        file.unlink()
    findings = examine_voxels(voxels, path)
    assert findings.verdict == "unknown"
    assert "there is no mesh beside" in findings.gap.reason
    assert "3D-R2N2" in findings.remarks[0]


def test_other_voxels_than_binvox(folder):
    """A box that is not a cube, in memory order z, y, x."""
    high = np.array([1.35, 1.4, 1.0])
    occupancy = torch.from_numpy(tetrahedron().transpose(2, 1, 0).copy())
    (folder / "thing.binvox").unlink()
    voxels = data.Voxels(occupancy, VoxelGrid(SIDE, tuple(LOWER), tuple(high)))
    assert examine_voxels(voxels, folder / "thing.npz").verdict == "good"
    half = data.Voxels(occupancy[:18], VoxelGrid((18, SIDE, SIDE), tuple(LOWER), (1.35, 1.4, -0.3 + 0.75 * 1.3)))
    assert examine_voxels(half, folder / "thing.npz").checks[0].value > 90
    assert dict(examine_voxels(half, folder).facts)["voxels"] == "24 x 24 x 18 (x, y, z)"


def test_real_voxels_in_both_placements():
    folder = real_set("binvox")
    good = examine_voxels(data.read_binvox(folder), folder)
    assert good.verdict == "good"
    assert good.checks[0].value == 100.0
    bad = examine_voxels(data.read_binvox(folder, placement="centred"), folder / "trimesh_chair_model.binvox")
    assert bad.cause.name == "voxels placed otherwise"
