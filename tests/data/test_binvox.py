"""Binvox files: any grid comes back where the format's definition puts it, and files that lie are refused."""

from pathlib import Path

import hypothesis.extra.numpy as npst
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import data
from lsmgeo.errors import DataError, OptionError
from tests.data.hostile import TRIALS, judged, mutated
from tests.data.real_sets import real_set
from tests.data.release_writers import CENTRE, RADIUS, ball_voxels, binvox_bytes
from tests.fuzz.forked import outcomes

HEADER = b"#binvox 1\ndim 2 2 2\ntranslate 0 0 0\nscale 1\ndata\n"
GRIDS = st.integers(1, 9).flatmap(lambda side: npst.arrays(bool, (side,) * 3))


def write(folder, content):
    path = Path(folder) / "solid.binvox"
    path.write_bytes(content)
    return path


@given(solid=GRIDS, translate=st.tuples(*[st.floats(-10, 10)] * 3), scale=st.floats(0.01, 100))
def test_any_grid_comes_back(tmp_path_factory, solid, translate, scale):
    side = len(solid)
    path = write(tmp_path_factory.getbasetemp(), binvox_bytes(solid, translate, scale))
    voxels = data.read_binvox(path)
    np.testing.assert_array_equal(voxels.occupancy.numpy().transpose(2, 1, 0), solid)
    index = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1)
    expected = np.array(translate) + scale * (index + 0.5) / side
    centers = voxels.grid.centers().double().numpy().transpose(2, 1, 0, 3)
    np.testing.assert_allclose(centers, expected, rtol=0, atol=1e-5 * (10 + scale))
    centred = data.read_binvox(path, placement="centred")
    assert torch.equal(centred.occupancy, voxels.occupancy)
    expected = ((index + 0.5) / side - 0.5) * scale
    centers = centred.grid.centers().double().numpy().transpose(2, 1, 0, 3)
    np.testing.assert_allclose(centers, expected, rtol=0, atol=1e-5 * scale)


def test_the_order_of_the_axes(tmp_path):
    """By hand: of eight voxels the second is at y = 1, the third at z = 1, the fifth at x = 1."""
    for place, where in ((1, (0, 1, 0)), (2, (1, 0, 0)), (4, (0, 0, 1))):  # z, y, x
        runs = bytes((0, place, 1, 1, 0, 7 - place))
        occupancy = data.read_binvox(write(tmp_path, HEADER + runs)).occupancy
        assert torch.nonzero(occupancy).tolist() == [list(where)]


def test_long_runs(tmp_path):
    solid = ball_voxels(40)
    path = write(tmp_path, binvox_bytes(solid, (-0.5, -0.5, -0.5), 1.0))
    voxels = data.read_binvox(path)
    inside = torch.linalg.norm(voxels.grid.centers().double() - torch.from_numpy(CENTRE), dim=-1) <= RADIUS
    assert torch.equal(voxels.occupancy, inside)


@pytest.mark.parametrize(
    "header",
    [
        "#binvox 1\r\ndim 2 2 2\r\ntranslate 1 2 3\r\nscale 4\r\n",
        "#binvox 1\n# made by hand\n\n   scale\t4   # units\n dim  2  2 2 \ntranslate 1.0 2e0 +3 # x y z\n#end\n ",
    ],
)
def test_legal_headers(tmp_path, header):
    voxels = data.read_binvox(write(tmp_path, binvox_bytes(np.ones((2, 2, 2)), (0, 0, 0), 0, header)))
    assert voxels.grid.lower == (1.0, 2.0, 3.0)
    assert voxels.grid.upper == (5.0, 6.0, 7.0)
    assert bool(voxels.occupancy.all())


def test_trimesh_reads_the_same(tmp_path):
    solid = ball_voxels(24)
    path = write(tmp_path, binvox_bytes(solid, (0.0, 0.0, 0.0), 1.0))
    expected = trimesh.load(path).matrix
    np.testing.assert_array_equal(data.read_binvox(path).occupancy.numpy().transpose(2, 1, 0), expected)


def test_a_folder_with_one_solid(tmp_path):
    path = write(tmp_path, binvox_bytes(np.ones((2, 2, 2)), (0, 0, 0), 1.0))
    assert data.detect(tmp_path).name == data.detect(path).name == "binvox"
    assert bool(data.read_binvox(tmp_path).occupancy.all())
    (tmp_path / "renamed").write_bytes(path.read_bytes())
    assert data.detect(tmp_path / "renamed").name == "binvox"
    with pytest.raises(DataError, match="but no posed images"):
        data.open(path)
    (tmp_path / "other.binvox").write_bytes(path.read_bytes())
    with pytest.raises(DataError, match="expected one"):
        data.read_binvox(tmp_path)
    with pytest.raises(OptionError, match="placement"):
        data.read_binvox(path, placement="center")


def header(**changes):
    lines = {"dim": "2 2 2", "translate": "0 0 0", "scale": "1", **changes}
    return ("#binvox 1\n" + "".join(f"{name} {value}\n" for name, value in lines.items()) + "data\n").encode()


FULL = bytes((1, 8))


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "no binvox header"),
        (b"#binvox 1", "no binvox header"),
        (b"#binvox 2" + HEADER[9:] + FULL, "not a binvox file"),
        (b"#binvox 1\n" + b"# talk\n" * 200 + HEADER[10:] + FULL, "no binvox header.* in its first 1024 bytes"),
        (b"#binvox 1\n" + b"x" * 100_000, "no binvox header"),
        (HEADER[:-6] + b"\n" + FULL, "no binvox header|not ASCII text|invalid or repeated"),
        (HEADER[:20] + b"\xff" + HEADER[20:] + FULL, "not ASCII text|invalid or repeated"),
        (header(dim="0 0 0") + FULL, "expected 1 to 645"),
        (header(dim="-2 -2 2") + FULL, "expected 1 to 645"),
        (header(dim="1024 1024 1024") + FULL, "expected 1 to 645"),
        (header(dim="1000000000000000 1 1") + FULL, "expected 1 to 645"),
        (header(dim="99999999999999999999999 1 1") + FULL, "number too long"),
        (header(dim="640 640 640") + FULL, "runs of 8 voxels"),
        (header(dim="2 2 4") + bytes((1, 16)), "writers disagree on their order"),
        (header(dim="2 2") + FULL, "invalid or repeated"),
        (header(dim="2.0 2 2") + FULL, "whole numbers"),
        (header(scale="0") + FULL, "not a valid cube"),
        (header(scale="-1") + FULL, "not a valid cube"),
        (header(scale="nan") + FULL, "finite"),
        (header(scale="1e999") + FULL, "finite"),
        (header(scale="1e-30", translate="1e9 0 0") + FULL, "scale too small"),
        (header(translate="1e30 0 0") + FULL, "not a valid cube"),
        (header(colour="red") + FULL, "invalid or repeated"),
        (HEADER[:-5] + b"scale 2\ndata\n" + FULL, "invalid or repeated"),
        (HEADER[:-5].replace(b"scale 1\n", b"") + b"data\n" + FULL, "without scale"),
        (HEADER, "runs of 0 voxels"),
        (HEADER + bytes((1, 7)), "runs of 7 voxels"),
        (HEADER + bytes((1, 9)), "runs of 9 voxels"),
        (HEADER + bytes((1, 4, 7, 4)), "other than 0 and 1"),
        (HEADER + bytes((1, 8, 0, 0)), "an empty run"),
        (HEADER + FULL + b"\n", "ends inside a run"),
        (HEADER + FULL + FULL, "runs of 16 voxels"),
    ],
)
def test_files_that_lie_are_refused(tmp_path, content, match):
    path = write(tmp_path, content)
    with pytest.raises(DataError, match=match) as caught:
        data.read_binvox(path)
    assert caught.value.path == path


def test_damaged_files_are_refused_or_read(tmp_path):
    """In a process whose memory is bounded."""
    original = binvox_bytes(ball_voxels(12), (-0.5, -0.25, -0.5), 1.0)
    rng = np.random.default_rng(0)
    cases = [mutated(rng, original) for _ in range(TRIALS)]
    path = tmp_path / "solid.binvox"

    def judge(content):
        def run():
            path.write_bytes(content)
            voxels = data.read_binvox(path)
            assert voxels.occupancy.numel() <= 1 << 28
            assert bool(voxels.grid.centers().isfinite().all())

        return judged(run)

    results = outcomes(cases, judge)
    assert set(results) == {"read", "refused"}, set(results)
    assert TRIALS // 2 < results.count("refused") < TRIALS
    assert sorted(tmp_path.iterdir()) == [path]


def test_every_sample_of_a_real_surface_falls_in_an_occupied_voxel():
    folder = real_set("binvox")
    (file,) = folder.glob("*.binvox")
    mesh = trimesh.load(file.with_suffix(".obj"), force="mesh")
    samples, _ = trimesh.sample.sample_surface(mesh, 50_000, seed=0)
    for placement, low, high in (("header", 1.0, 1.0), ("centred", 0.0, 0.5)):
        voxels = data.read_binvox(file, placement=placement)
        lower, upper = np.array(voxels.grid.lower), np.array(voxels.grid.upper)
        index = np.floor((samples - lower) / (upper - lower) * len(voxels.occupancy)).astype(int)
        inside = ((index >= 0) & (index < len(voxels.occupancy))).all(1)
        x, y, z = index.clip(0, len(voxels.occupancy) - 1).T
        fraction = (voxels.occupancy.numpy()[z, y, x] & inside).mean()
        assert low <= fraction <= high
    np.testing.assert_array_equal(
        data.read_binvox(file).occupancy.numpy().transpose(2, 1, 0), trimesh.load(file).matrix
    )
