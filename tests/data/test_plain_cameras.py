"""Cameras in plain files, ours and Strecha's, written by code that shares nothing with the readers."""

import json

import numpy as np
import pytest
from PIL import Image

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.posed_writers import check_scene, strecha_text, trimmed, write_plain_cameras, write_strecha
from tests.data.writers import make_scene


@pytest.fixture(scope="module")
def scene():
    scene = make_scene(48, 64)
    return scene._replace(K=scene.K + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]]))  # these formats have skew


def as_half(values):
    values["pixel_center"] = "half"
    for entry in values["cameras"]:
        entry["K"] = np.add(entry["K"], [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).tolist()


def as_parts(values):
    """As rotation and translation, without a word of the format."""
    for key in ("format", "version", "pixel_center"):
        del values[key]
    for entry in values["cameras"]:
        pose = np.array(entry.pop("cam_from_world"))
        entry |= {"name": entry.pop("file"), "R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()}


@pytest.mark.parametrize("change", [None, as_half, as_parts])
def test_plain_cameras_read_back(scene, tmp_path, change):
    read = data.open(write_plain_cameras(scene, tmp_path, change))
    assert read.source == "cameras"
    assert read.names == tuple(f"images/{name}" for name in scene.names)
    check_scene(read, scene, trimmed(scene))
    (tmp_path / "cameras.json").rename(tmp_path / "another name.json")
    check_scene(data.open(tmp_path / "another name.json"), scene, trimmed(scene))


def entry(**changes):
    return lambda values: values["cameras"][1].update(changes)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda values: values.update(version=2), "version int 2; expected 'lsmgeo cameras', version 1"),
        (lambda values: values.update(version=True), "version bool True"),
        (lambda values: values.update(pixel_center="corner"), "pixel_center must be one of integer, half"),
        (lambda values: values.update(cameras=[]), "cameras must be a list of 1 to"),
        (entry(width=128, height=96), "camera 1: the camera has 128 x 96 pixels and 'v1.png' has 59 x 45"),
        (entry(width=59.5), "whole numbers"),
        (entry(width="59"), "width must be a number"),
        (entry(file="../../secret.png"), "outside its folder"),
        (entry(file=7), "file must be a string"),
        (entry(K=[[1, 0, 0], [0, 1, 0]]), "camera 1: K must be 3 x 3 numbers"),
        (entry(K=np.diag([5, -5, 1]).tolist()), "K must be upper triangular with positive"),
        (entry(cam_from_world=np.diag([2.0, 2.0, 2.0, 1.0]).tolist()), "the rotation is scaled by 2;"),
        (entry(cam_from_world=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "the rotation is mirrored"),
        (entry(cam_from_world=np.diag([1.0, 1.0, 1.0, 2.0]).tolist()), "the last row"),
    ],
)
def test_plain_cameras_that_make_no_sense_are_refused(scene, tmp_path, change, match):
    with pytest.raises(DataError, match=match):
        data.open(write_plain_cameras(scene, tmp_path, change))


def test_a_list_of_other_cameras_is_left_to_others(scene, tmp_path):
    write_plain_cameras(scene, tmp_path)
    (tmp_path / "cameras.json").write_text(json.dumps([{"id": 0, "img_name": "v0"}]))
    with pytest.raises(DataError, match="holds no known format"):
        data.open(tmp_path)


@pytest.mark.parametrize(("cameras", "images"), [(".", "."), (".", "images"), ("cameras", "images"), ("cams", "cams")])
def test_strecha_scenes_read_back(scene, tmp_path, cameras, images):
    names = ["0000.png", "0001.png", "0002.png", "0003.png", "0004.png"]
    folder = write_strecha(scene, tmp_path / cameras, tmp_path / images, names)
    for path in (tmp_path, folder, folder / "0002.png.camera"):
        read = data.open(path)
        assert read.source == "strecha"
        assert read.names == tuple(names)
        check_scene(read, scene, trimmed(scene))


def rewritten(scene, line, text):
    lines = strecha_text(scene, 1, trimmed(scene)[1]).splitlines()
    lines[line] = text
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("line", "text", "match"),
    [
        (3, "0.1 0 0", "has radial distortion, whose model the format does not define"),
        (3, "", "expected 26 numbers .* got 23"),
        (0, "-5 0 1", "K must be upper triangular"),
        (4, "2 0 0", "not a rotation"),
        (7, "1 nan 2", "finite"),
        (7, "1 1e13 2", "beyond 1e12"),
        (8, "3072 2048", "has 3072 x 2048 pixels and '0001.png' has 59 x 45"),
        (8, "59.5 45", "K of another resolution"),
        (8, "59 x", "expected numbers"),
    ],
)
def test_strecha_files_that_make_no_sense_are_refused(scene, tmp_path, line, text, match):
    write_strecha(scene, tmp_path, tmp_path, [f"000{view}.png" for view in range(5)])
    (tmp_path / "0001.png.camera").write_text(rewritten(scene, line, text))
    with pytest.raises(DataError, match=match) as caught:
        data.open(tmp_path)
    assert caught.value.path == tmp_path / "0001.png.camera"


def test_strecha_folders_are_distinguished(scene, tmp_path):
    names = [f"000{view}.png" for view in range(5)]
    write_strecha(scene, tmp_path / "a", tmp_path / "a", names)
    write_strecha(scene, tmp_path / "b", tmp_path / "b", names)
    with pytest.raises(DataError, match="in one folder; found a, b"):
        data.open(tmp_path)
    (tmp_path / "a" / "0001.png").unlink()
    with pytest.raises(DataError, match=r"has no image '0001\.png' beside it"):
        data.open(tmp_path / "a")
    Image.new("RGB", (3, 3)).save(tmp_path / "a" / "0001.png")
    with pytest.raises(DataError, match="K of another resolution"):
        data.open(tmp_path / "a")
