"""RGB-D folders and stereo pairs that lie: a DataError that names the file, quickly, and nothing outside the folder."""

import os
import struct

import numpy as np
import pytest

from lsmgeo import data
from lsmgeo.data.formats.depth_files import read_pfm
from tests.data.hostile import judge_mutations, read_scene, scene_refused
from tests.data.test_rgbd import write_rgbd, write_seven_scenes
from tests.data.test_stereo_pairs import HEIGHT, WIDTH, write_pair
from tests.data.writers import make_scene

SCENE = make_scene(24, 32)
pytestmark = pytest.mark.timeout(60)


def replace_line(file, number, line):
    lines = file.read_text().splitlines()
    lines[number] = line
    file.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("", "holds 4 poses"),
        ("1 2 3", "16 numbers"),
        ("0 " * 17, "16 numbers"),
        ("x " * 16, "expected numbers"),
        ("9" * 500 + " 0" * 15, "number too long"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "last row"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1e300 1", "last row"),
        ("1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1", "beyond 1e"),
        ("1e300 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "beyond 1e"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "scaled by 2"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "mirrored"),
        ("1 1 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "rotation"),
        ("0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1", "rotation"),
    ],
)
def test_poses_are_checked(tmp_path, line, match):
    folder = write_rgbd(SCENE, tmp_path / "table", absent=0)
    replace_line(folder / "poses.txt", 1, line)
    scene_refused(folder, match, "poses.txt")
    if line:
        folder = write_seven_scenes(SCENE, tmp_path / "files")
        (folder / "frame-000001.pose.txt").write_text(line)
        scene_refused(folder, match)


@pytest.mark.parametrize(
    ("name", "match"),
    [("../K.txt", "outside its folder"), ("/etc/passwd", "outside its folder"), ("a\x07.png", "unusable"),
     ("a" * 600, "unusable"), ("00000.png", "twice"), (".", "outside its folder"), ("..", "outside its folder")],
)  # fmt: skip
def test_names_of_frames_are_checked(tmp_path, name, match):
    folder = write_rgbd(SCENE, tmp_path / "table", absent=0)
    replace_line(folder / "frame_index.txt", 1, name)
    scene_refused(folder, match, "frame_index.txt")


@pytest.mark.parametrize(
    ("content", "match"),
    [("", "9 numbers"), ("1 " * 10, "9 numbers"), ("1 " * 9, "upper triangular"), ("0 0 1 0 5 1 0 0 1", "positive"),
     ("5 0 1 0 5 1 0 0 2", "last row"), ("1e99 0 1 0 5 1 0 0 1", "beyond"), ("nan 0 1 0 5 1 0 0 1", "finite"),
     ("1 " * 20_000, "larger than"), ("\0", "zero byte")],
)  # fmt: skip
def test_intrinsics_are_checked(tmp_path, content, match):
    folder = write_rgbd(SCENE, tmp_path / "table", absent=0)
    (folder / "K.txt").write_text(content)
    scene_refused(folder, match, "K.txt")


@pytest.mark.parametrize("form", ["table", "files", "pair"])
def test_links_out_of_the_folder_are_refused(tmp_path, form):
    outside = tmp_path / "outside.png"
    if form == "table":
        folder = write_rgbd(SCENE, tmp_path / "scene", absent=0)
        files = [folder / "images" / "00001.png", folder / "depth" / "00001.png"]
    elif form == "files":
        folder = write_seven_scenes(SCENE, tmp_path / "scene")
        files = [folder / f"frame-000001.{end}" for end in ("color.png", "depth.png", "pose.txt")]
    else:
        folder, _ = write_pair(tmp_path / "scene")
        files = [folder / name for name in ("im1.png", "disp0.pfm")]
    for file in files:
        content = file.read_bytes()
        outside.write_bytes(content)
        file.unlink()
        file.symlink_to(outside)
        scene_refused(folder, "outside its folder")
        file.unlink()
        file.write_bytes(content)
    read_scene(folder)


def test_pipes_are_not_waited_for(tmp_path):
    folder = write_seven_scenes(SCENE, tmp_path / "scene")
    (folder / "frame-000001.pose.txt").unlink()
    os.mkfifo(folder / "frame-000001.pose.txt")
    scene_refused(folder, "no such file")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("cam0=", "cam=", "does not state cam0"),
        ("doffs=3.125", "doffs=4", "doffs is 4"),
        ("doffs=3.125\n", "", "does not state doffs"),
        ("doffs=3.125", "doffs=nan", "finite"),
        ("doffs=3.125", "doffs=" + "9" * 100, "too long"),
        ("doffs=3.125", "doffs=1e300", "beyond"),
        ("baseline=193.001", "baseline=0", "positive"),
        ("baseline=193.001", "baseline=-193.001", "positive"),
        ("baseline=193.001", "baseline=", "expected numbers"),
        ("baseline=193.001", "baseline 193.001", "name=value"),
        ("width=32", "width=64", "K of another resolution"),
        ("width=32", "width=3e1", "whole numbers"),
        ("ndisp=280", "doffs=3.125", "twice"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[50.5 0 15.25; 0 50.5 11.5]", "3 x 3"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[50.5 0 15.25 0 50.5 11.5 0 0 1]", "3 x 3"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[50.5 0 1e300; 0 50.5 11.5; 0 0 1]", "beyond"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[-50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "positive"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[50.5 0 15.25; 0 60 11.5; 0 0 1]", "one focal length"),
        ("[50.5 0 15.25; 0 50.5 11.5; 0 0 1]", "[50.5 1 15.25; 0 50.5 11.5; 0 0 1]", "no skew"),
        ("[50.5 0 18.375; 0 50.5 11.5; 0 0 1]", "[50.5 0 18.375; 0 50.5 12.5; 0 0 1]", "not a rectified pair"),
        ("[50.5 0 18.375; 0 50.5 11.5; 0 0 1]", "[51 0 18.375; 0 51 11.5; 0 0 1]", "not a rectified pair"),
        ("isint=0", "a" * 70_000, "larger than"),
    ],
)
def test_calibrations_of_pairs_are_checked(tmp_path, old, new, match):
    folder, _ = write_pair(tmp_path / "pair")
    text = (folder / "calib.txt").read_text()
    assert old in text
    (folder / "calib.txt").write_text(text.replace(old, new, 1))
    scene_refused(folder, match, "calib.txt")


BODY = np.ones((HEIGHT, WIDTH), "<f4").tobytes()


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is not a portable float map"),
        (b"Pf", "is not a portable float map"),
        (b"P5\n32 24\n-1\n" + BODY, "is not a portable float map"),
        (b"PF\n32 24\n-1\n" + BODY, "three channels"),
        (b"Pf\n24 32\n-1\n" + BODY, "24 x 32"),
        (b"Pf\n999999999 999999999\n-1\n" + BODY, "999999999 x"),
        (b"Pf\n-32 24\n-1\n" + BODY, "is not a portable float map"),
        (b"Pf\n9999999999999999999999 24\n-1\n" + BODY, "is not a portable float map"),
        (b"Pf\n32 24\n0\n" + BODY, "scale"),
        (b"Pf\n32 24\nnan\n" + BODY, "scale"),
        (b"Pf\n32 24\ninf\n" + BODY, "scale"),
        (b"Pf\n32 24\nx\n" + BODY, "scale"),
        (b"Pf\n32 24\n-" + b"1" * 100 + b"\n" + BODY, "is not a portable float map"),
        (b"Pf\n32 24\n-1\n" + BODY[:-1], "more or less data"),
        (b"Pf\n32 24\n-1\n" + BODY + b"\0", "more or less data"),
        (b"Pf\n" + b" " * 400 + b"32 24\n-1\n" + BODY, "larger|is not a portable"),
        (b"Pf\n32 24\n-1\n" + BODY * 2, "larger than"),
        (b"Pf # comment\n32 24\n-1\n" + BODY, "is not a portable float map"),
    ],
)
def test_float_maps_are_checked(tmp_path, content, match):
    folder, _ = write_pair(tmp_path / "pair")
    (folder / "disp1.pfm").write_bytes(content)
    scene_refused(folder, match, "disp1.pfm")


@pytest.mark.parametrize("file", ["poses.txt", "frame_index.txt", "K.txt"])
def test_damaged_tables_give_a_data_error_or_a_scene(tmp_path, file):
    folder = write_rgbd(SCENE, tmp_path / "scene", absent=0)
    judge_mutations(folder, folder / file, lambda: data.open(folder))


@pytest.mark.parametrize("file", ["calib.txt", "frame-000002.pose.txt"])
def test_damaged_cameras_give_a_data_error_or_a_scene(tmp_path, file):
    if file == "calib.txt":
        folder, _ = write_pair(tmp_path / "scene")
    else:
        folder = write_seven_scenes(SCENE, tmp_path / "scene")
    judge_mutations(folder, folder / file, lambda: data.open(folder))


def test_damaged_float_maps_give_a_data_error_or_a_map(tmp_path):
    file = tmp_path / "a.pfm"
    # Short, so that most mutations meet the header.
    file.write_bytes(b"Pf\n3 2\n-1\n" + struct.pack("<6f", *range(6)))
    judge_mutations(tmp_path, file, lambda: read_pfm(file, (2, 3)))
