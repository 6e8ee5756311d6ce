"""RGB-D folders read back in our conventions; frames that are missing or lost are left out by name."""

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.errors import DataError, OptionError
from tests.data.writers import make_scene

SCENE = make_scene(24, 32)


def poses_of(scene):
    """Camera-to-world, by inverting the whole matrix."""
    E = np.tile(np.eye(4), (len(scene.R), 1, 1))
    E[:, :3, :3], E[:, :3, 3] = scene.R, scene.t
    return np.linalg.inv(E)


def millimetres(depth):
    return np.round(depth * 1000).astype(np.uint16)


def write_rgbd(scene, folder, *, absent=3, digits=9):
    """The form of HoloLens recordings, its poses rounded; ``absent`` further rows, without images, come between."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "K.txt", scene.K[0])
    names, rows = [], []
    for view, pose in enumerate(poses_of(scene)):
        for extra in range(absent):
            names.append(f"absent{view}{extra}.png")
            rows.append(np.eye(4).ravel())
        names.append(f"{view:05d}.png")
        rows.append(pose.ravel())
        Image.fromarray(scene.images[view]).save(folder / "images" / names[-1])
        Image.fromarray(millimetres(scene.depth[view])).save(folder / "depth" / names[-1])
    (folder / "frame_index.txt").write_text("\n".join(names) + "\n")
    (folder / "poses.txt").write_text("\n".join(" ".join(f"{x:.{digits}g}" for x in row) for row in rows) + "\n")
    return folder


def write_seven_scenes(scene, folder):
    folder.mkdir(parents=True, exist_ok=True)
    for view, pose in enumerate(poses_of(scene)):
        stem = folder / f"frame-{view:06d}"
        rows = ("\t ".join(f"{x:.9e}" for x in row) + "\t \r\n" for row in pose)
        stem.with_suffix(".pose.txt").write_text("".join(rows))
        Image.fromarray(scene.images[view]).save(stem.with_suffix(".color.png"))
        Image.fromarray(millimetres(scene.depth[view])).save(stem.with_suffix(".depth.png"))
    return folder


def check(read, scene, K, views):
    assert len(read) == len(views)
    for index, view in enumerate(views):
        np.testing.assert_allclose(read.cameras.intrinsics[index].numpy(), K, rtol=1e-12)
        np.testing.assert_allclose(read.cameras.cam_from_world[index, :3, :3].numpy(), scene.R[view], atol=1e-8)
        np.testing.assert_allclose(read.cameras.cam_from_world[index, :3, 3].numpy(), scene.t[view], atol=1e-7)
        expected = torch.from_numpy(scene.images[view]).permute(2, 0, 1).float() / 255
        torch.testing.assert_close(read.load(index), expected, rtol=0, atol=0)
        np.testing.assert_allclose(read.load_depth(index).numpy(), scene.depth[view], atol=0.00051)
        assert read.size(index) == scene.size


def test_a_folder_with_a_table_of_poses_reads_back(tmp_path):
    read = data.open(write_rgbd(SCENE, tmp_path / "a"))
    assert read.source == "rgbd"
    assert read.names == tuple(f"{view:05d}.png" for view in range(5))
    check(read, SCENE, SCENE.K[0], range(5))
    assert data.open(tmp_path / "a" / "poses.txt").names == read.names


def test_frames_are_matched_by_name_where_images_are_missing(tmp_path):
    folder = write_rgbd(SCENE, tmp_path / "a", absent=0)
    (folder / "images" / "00000.png").unlink()
    (folder / "images" / "00002.png").unlink()
    read = data.open(folder)
    assert read.names == ("00001.png", "00003.png", "00004.png")
    check(read, SCENE, SCENE.K[0], (1, 3, 4))


def test_poses_in_single_precision_are_rotations(tmp_path):
    read = data.open(write_rgbd(SCENE, tmp_path / "a", digits=5))
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, :3].numpy(), SCENE.R, atol=1e-4)
    centres = -(SCENE.R.transpose(0, 2, 1) @ SCENE.t[..., None])[..., 0]
    E = read.cameras.cam_from_world.numpy()
    found = -(E[:, :3, :3].transpose(0, 2, 1) @ E[:, :3, 3, None])[..., 0]
    np.testing.assert_allclose(found, centres, atol=1e-4)


@pytest.mark.parametrize("number", ["nan", "-inf", "1e999"])
def test_a_lost_frame_is_left_out(tmp_path, number):
    folder = write_rgbd(SCENE, tmp_path / "a", absent=0)
    rows = (folder / "poses.txt").read_text().splitlines()
    rows[1] = " ".join([number] * 12 + ["0", "0", "0", "1"])
    (folder / "poses.txt").write_text("\n".join(rows))
    assert data.open(folder).names == ("00000.png", "00002.png", "00003.png", "00004.png")
    (folder / "poses.txt").write_text("\n".join([rows[1]] * 5))
    with pytest.raises(DataError, match="has no usable frame"):
        data.open(folder)


def test_a_frame_without_a_file_of_depth_has_none(tmp_path):
    folder = write_rgbd(SCENE, tmp_path / "a")
    (folder / "depth" / "00003.png").unlink()
    read = data.open(folder)
    assert read.load_depth(3) is None
    assert read.load_depth(2) is not None
    assert read.sample().depth is None
    for file in (folder / "depth").iterdir():
        file.unlink()
    assert data.open(folder).depths is None


def test_a_sequence_of_seven_scenes_reads_back(tmp_path):
    folder = write_seven_scenes(SCENE, tmp_path / "seq-01")
    fx, fy, cx, cy = (float(SCENE.K[0][at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    read = data.read_seven_scenes(folder, intrinsics=(fx, fy, cx, cy))
    assert read.source == "7-scenes"
    check(read, SCENE, SCENE.K[0], range(5))
    stated = data.open(folder)
    assert stated.names == tuple(f"frame-{view:06d}.color.png" for view in range(5))
    expected = torch.tensor([[585, 0, 320], [0, 585, 240], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(stated.cameras.intrinsics, expected.expand(5, 3, 3), rtol=0, atol=0)


def test_seven_scenes_has_two_numbers_for_no_depth(tmp_path):
    folder = write_seven_scenes(SCENE, tmp_path)
    depth = np.full((24, 32), 1234, np.uint16)
    depth[0, 0], depth[1, 1], depth[2, 2] = 0, 65535, 65534
    Image.fromarray(depth).save(folder / "frame-000002.depth.png")
    read = data.open(folder).load_depth(2).numpy()
    assert read[0, 0] == read[1, 1] == 0
    np.testing.assert_allclose([read[2, 2], read[3, 3]], [65.534, 1.234], rtol=1e-6)


def test_frames_of_seven_scenes_that_are_not_whole_are_left_out(tmp_path):
    folder = write_seven_scenes(SCENE, tmp_path)
    (folder / "frame-000001.color.png").unlink()
    (folder / "frame-000003.pose.txt").write_text(" ".join(["-nan"] * 16))
    (folder / "frame-000004.depth.png").unlink()
    read = data.open(folder)
    assert read.names == ("frame-000000.color.png", "frame-000002.color.png", "frame-000004.color.png")
    assert read.load_depth(2) is None


@pytest.mark.parametrize("intrinsics", [(1, 2, 3), (0, 1, 2, 3), (1, 1, np.nan, 3), "abcd", None, (1, 1, 1e9, 3)])
def test_intrinsics_are_checked(tmp_path, intrinsics):
    with pytest.raises(OptionError, match=r"read_seven_scenes: intrinsics must be .* got"):
        data.read_seven_scenes(tmp_path, intrinsics=intrinsics)
