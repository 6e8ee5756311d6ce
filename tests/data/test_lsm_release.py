"""The LSM release: what is read is the ball that was written, to a step of depth; and the real sample's figures."""

import io
import shutil
import struct
import zlib

import numpy as np
import pytest
import torch
from scipy.io import savemat

from lsmgeo import data
from lsmgeo.data.formats import format_lsm
from lsmgeo.data.formats.format_lsm import read_mat_files
from lsmgeo.errors import DataError, OptionError
from tests.data.hostile import mutated
from tests.data.release_writers import CENTRE, MODEL, RADIUS, SYNSET, ball_voxels, lsm_pose, write_lsm


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_lsm(tmp_path_factory.mktemp("release"))


@pytest.fixture
def folder(written, tmp_path):
    """A copy to damage."""
    shutil.copytree(written.parents[2], tmp_path / "release")
    return tmp_path / "release" / written.relative_to(written.parents[2])


@pytest.fixture(scope="module")
def scene(written):
    return data.open(written)


def read_all(folder):
    scene = data.read_lsm(folder)
    for view in range(len(scene)):
        scene.load(view)
        scene.load_depth(view)


def refused(folder, match, file=None):
    with pytest.raises(DataError, match=match) as caught:
        read_all(folder)
    if file is not None:
        assert str(caught.value.path).endswith(file)


def test_views_come_in_the_order_of_their_numbers(scene):
    assert scene.source == "lsm"
    assert scene.category == "chair"
    assert scene.names == tuple(f"render_{view}.png" for view in range(12))
    for view in range(12):
        np.testing.assert_allclose(scene.cameras.cam_from_world[view].numpy(), lsm_pose(view), atol=1e-12)
    assert scene.cameras.intrinsics[0].tolist() == [[105.0, 0.0, 27.5], [0.0, 105.0, 27.5], [0.0, 0.0, 1.0]]


def test_depth_lies_on_the_ball(scene):
    """Half a pixel would move the points by 0.01."""
    for view in range(len(scene)):
        depth, E = scene.load_depth(view).double(), scene.cameras.cam_from_world[view]
        v, u = torch.nonzero(depth, as_tuple=True)
        assert len(v) > 300
        assert torch.equal(scene.load_mask(view), depth > 0)
        rays = torch.linalg.solve(scene.cameras.intrinsics[view], torch.stack([u, v, torch.ones_like(u)]).double())
        points = ((rays * depth[v, u]).T - E[:3, 3]) @ E[:3, :3]
        distances = torch.linalg.norm(points - torch.from_numpy(CENTRE), dim=1)
        # Half a step of depth is 7.6e-5, seen along a ray that may graze.
        np.testing.assert_allclose(distances.numpy(), RADIUS, atol=1e-4)


def test_images_lie_before_white(scene):
    image, mask = scene.load(0), scene.load_mask(0)
    assert bool((image[:, ~mask] == 1).all())
    assert not bool((image[:, mask] == 1).any())


@pytest.mark.parametrize("side", [32, 64])
def test_voxels_are_the_ball(written, side):
    voxels = data.read_lsm(written, voxels=side).voxels
    assert voxels.occupancy.shape == (side,) * 3
    inside = torch.linalg.norm(voxels.grid.centers().double() - torch.from_numpy(CENTRE), dim=-1) <= RADIUS
    assert torch.equal(voxels.occupancy, inside)
    np.testing.assert_array_equal(voxels.occupancy.numpy().transpose(2, 1, 0), ball_voxels(side))


def test_a_sample_has_it_all(scene):
    sample = scene.sample([3, 1])
    assert (sample.category, sample.name) == ("chair", MODEL)
    assert sample.occupancy is scene.voxels.occupancy
    assert torch.equal(sample.cameras.cam_from_world, scene.cameras.cam_from_world[[3, 1]])
    assert torch.equal(sample.depth[0], scene.load_depth(3))


def test_what_may_be_missing(folder):
    (folder / "depth_3.png").unlink()
    shutil.rmtree(folder.parents[2] / "voxels")
    scene = data.open(folder)
    assert scene.voxels is None
    assert scene.load_depth(3) is None
    assert scene.load_depth(4) is not None
    for file in folder.glob("depth_*.png"):
        file.unlink()
    assert data.open(folder).depths is None
    other = folder.parent.parent / "chairs" / MODEL
    other.parent.mkdir()
    folder.rename(other)
    assert data.open(other).category is None


def test_what_may_not(folder):
    with pytest.raises(OptionError, match="voxels"):
        data.read_lsm(folder, voxels=48)
    (folder / "camera_3.mat").unlink()
    refused(folder, "no such file", "camera_3.mat")
    for file in folder.glob("render_*.png"):
        file.unlink()
    refused(folder, "must hold render_0.png")
    refused(folder / "nowhere", "cannot be read")


def camera(**changes):
    K, E = np.array([[105.0, 0, 28], [0, 105, 28], [0, 0, 1]]), lsm_pose(0)
    return {"K": K, "extrinsic": E, **changes}


def mat(arrays, **options):
    stream = io.BytesIO()
    savemat(stream, {name: value for name, value in arrays.items() if value is not None}, **options)
    return stream.getvalue()


def with_data_type(code):
    """The numbers of K said to be of a type for which SciPy has no size, or no reader."""
    content = mat(camera())
    at = content.index(struct.pack("<II", 9, 72))
    return content[:at] + struct.pack("<I", code) + content[at + 4 :]


def bomb():
    """A compressed variable of a gigabyte of zeros; each 16 MiB compress to the same bytes."""
    rows = 1 << 15
    header = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<IIii", 5, 8, rows, rows) + struct.pack("<II", 1, 6)
    inner = header + b"Volume\0\0" + struct.pack("<II", 2, rows * rows)
    packer = zlib.compressobj(9)
    packed = packer.compress(struct.pack("<II", 14, len(inner) + rows * rows) + inner) + packer.flush(zlib.Z_FULL_FLUSH)
    packed += (packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)) * 64 + packer.flush()
    return mat({})[:128] + struct.pack("<II", 15, len(packed)) + packed


MIRROR = np.diag([1.0, 1, -1, 1])
CAMERAS = [
    (b"", "not a valid MATLAB file"),
    (b"MATLAB", "not a valid MATLAB file"),
    (bytes(1000), "not a valid MATLAB file"),
    (mat(camera())[:300], "not a valid MATLAB file|must hold"),
    (b"MATLAB 7.3 MAT-file" + b" " * 105 + struct.pack("<H", 0x0200) + b"IM" + bytes(512), "not a valid MATLAB file"),
    (with_data_type(8), "crashed its parser"),
    (with_data_type(200), "crashed its parser"),
    (mat(camera(K=None)), "must hold K"),
    (mat(camera(extrinsic=None)), "must hold extrinsic"),
    (mat(camera(K=np.eye(4))), "must hold K, 3 x 3; found"),
    (mat(camera(K="text")), "K is not an array of numbers"),
    (mat(camera(K={"a": 1})), "K is not an array of numbers"),
    (mat(camera(K=np.eye(3) * 1j)), "K is not an array of numbers"),
    (mat(camera(K=np.full((3, 3), np.nan))), "K must hold finite numbers"),
    (mat(camera(K=np.diag([-105.0, 105, 1]))), "positive focal lengths"),
    (mat(camera(K=np.diag([1e9, 105, 1]))), "beyond"),
    (mat(camera(extrinsic=lsm_pose(0) @ MIRROR)), "mirrored"),
    (mat(camera(extrinsic=2 * lsm_pose(0))), "scaled"),
    (mat(camera(extrinsic=np.zeros((4, 4)))), "not a rotation"),
    (mat(camera(extrinsic=lsm_pose(0).T)), "last row"),
    (mat(camera(extrinsic=np.full((4, 4), np.inf))), "finite"),
]
VOLUMES = [
    (mat({"Volume": np.zeros((32, 32, 31), np.uint8)}), "must hold Volume, 32 x 32 x 32"),
    (mat({"Volume": np.zeros((2, 2), np.uint8)}), "must hold Volume, 32 x 32 x 32"),
    (mat({"Volume": np.full((32, 32, 32), 7, np.uint8)}), "not an array of zeros and ones"),
    (mat({"Volume": np.full((32, 32, 32), np.nan)}), "not an array of zeros and ones"),
    (mat({"tsdf": np.zeros((32, 32, 32))}), "must hold Volume"),
    (mat({"Volume": np.zeros((300, 300, 300), bool)}, do_compression=True), "too large"),
    (bomb(), r"needs more than \d+ bytes of memory"),
    (bytes(format_lsm.MAX_MAT_BYTES + 1), "larger than the limit"),
]


def test_hostile_matlab_files_are_refused_each_for_itself(tmp_path):
    """All in one call, good ones between them: what kills the process is found, and the others are read."""
    good = mat(camera())
    cases = [case for bad in [*CAMERAS, *VOLUMES] for case in ((good, None), bad)]
    paths = [tmp_path / f"{number}.mat" for number in range(len(cases))]
    for path, (content, _) in zip(paths, cases, strict=True):
        path.write_bytes(content)
    survived = []
    for path, (_, match), found in zip(paths, cases, read_mat_files(paths), strict=True):
        if match is None:
            np.testing.assert_array_equal(found["extrinsic"], lsm_pose(0))
        elif isinstance(found, DataError):
            with pytest.raises(DataError, match=match):
                raise found
            assert found.path == path
        else:
            survived.append(match)
    # What is left to the reader of the arrays: see below.
    assert len(survived) == 12
    assert sorted(tmp_path.iterdir()) == sorted(paths)


@pytest.mark.parametrize("number", [7, 9, 14, 15, 16, 17, 18, 19])
def test_hostile_cameras_are_refused(folder, number):
    content, match = CAMERAS[number]
    (folder / "camera_3.mat").write_bytes(content)
    refused(folder, match, "camera_3.mat")


@pytest.mark.parametrize("number", [0, 1, 4])
def test_hostile_volumes_are_refused(folder, number):
    content, match = VOLUMES[number]
    (folder.parents[2] / "voxels" / "modelVoxels32" / SYNSET / f"{MODEL}.mat").write_bytes(content)
    refused(folder, match, f"{MODEL}.mat")


def test_links_and_other_images_are_refused(folder, tmp_path):
    outside = tmp_path / "outside.mat"
    outside.write_bytes(mat(camera()))
    (folder / "camera_3.mat").unlink()
    (folder / "camera_3.mat").symlink_to(outside)
    refused(folder, "outside its folder")
    (folder / "camera_3.mat").unlink()
    outside.rename(folder / "camera_3.mat")
    (folder / "depth_3.png").write_bytes((folder / "render_3.png").read_bytes())
    refused(folder, "bit depth", "depth_3.png")
    (folder / "depth_3.png").unlink()
    (folder / "render_3.png").write_text("no image")
    refused(folder, "not a readable", "render_3.png")


def test_damaged_matlab_files_are_refused_or_read(tmp_path):
    count = 300
    rng = np.random.default_rng(0)
    originals = [mat(camera()), mat({"Volume": ball_voxels(32).astype(np.uint8)}, do_compression=True)]
    paths = []
    for number in range(count):
        paths.append(tmp_path / f"{number}.mat")
        # Behind the free text of the header.
        content = originals[number % 2]
        paths[-1].write_bytes(content[:116] + mutated(rng, content[116:]))
    outcomes = read_mat_files(paths)
    assert len(outcomes) == count
    refusals = [found for found in outcomes if isinstance(found, DataError)]
    assert count // 20 < len(refusals) < count
    for found, path in zip(outcomes, paths, strict=True):
        if isinstance(found, DataError):
            assert found.path == path
            assert found.reason.isprintable()
        else:
            assert all(np.isfinite(array).all() and array.size <= 64**3 for array in found.values())
    assert sorted(tmp_path.iterdir()) == sorted(paths)


@pytest.mark.parametrize("array", [np.array([np.nan]), np.array(["text"]), np.array([7], np.uint8)])
def test_the_answer_of_a_process_is_checked(tmp_path, monkeypatch, array):
    monkeypatch.setattr(format_lsm, "parse_isolated", lambda *_, **__: [{"K": array}])
    (found,) = read_mat_files([tmp_path / "camera.mat"])
    assert isinstance(found, DataError)
    assert found.path == tmp_path / "camera.mat"
