"""Calibrations that lie: a DataError that names the file; their parser runs in a process that may die."""

import gzip
import os

import numpy as np
import pytest

from lsmgeo import data
from lsmgeo.data.formats import format_opencv
from lsmgeo.data.formats.format_opencv import read_storage_files
from lsmgeo.errors import DataError
from tests.data.hostile import TRIALS, judged, mutated
from tests.data.test_calibration import YAML, write_rig, write_storage

pytestmark = pytest.mark.timeout(120)
HEAD = "%YAML:1.0\n---\n"
LENS = YAML.removeprefix(HEAD)


def matrix(name, values, rows=3, columns=3):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {values} ]\n"


XML = '<?xml version="1.0"?>\n<opencv_storage>\n{}\n</opencv_storage>\n'
IDENTITY = "1., 0., 0., 0., 1., 0., 0., 0., 1."
SHIFT = matrix("T", "0., 0., 1.", 3, 1)
ATTACKS = [
    ("a.yml", "", "not a file of OpenCV"),
    ("a.yml", HEAD, "has no camera matrix|not a file of OpenCV"),
    ("a.yml", "/etc/passwd", "not a file of OpenCV"),
    ("a.yml", "/etc/passwd?base64", "not a file of OpenCV"),
    ("a.yml", HEAD + "camera_matrix: [ [ [ [", "not a file of OpenCV"),
    ("a.xml", XML.format("<a>" * 100_000), "not a file of OpenCV|crashed|memory|made its parser"),
    ("a.json", '{"a":' * 100_000, "not a file of OpenCV|crashed|memory|made its parser"),
    ("a.yml", HEAD + matrix("camera_matrix", "1.", 2**30, 2**30), "has no camera matrix"),
    ("a.yml", HEAD + matrix("camera_matrix", "1.", -3, -3), "has no camera matrix"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY, 1, 9), "must be 3 x 3"),
    ("a.yml", HEAD + matrix("camera_matrix", "1., " * 200_000 + "1."), "has no camera matrix"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY.replace("1., 0.", ".Nan, 0.", 1)), "finite"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY.replace("1., 0.", ".Inf, 0.", 1)), "finite"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY.replace("1., 0.", "1e9, 0.", 1)), "beyond"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY.replace("1., 0.", "-1., 0.", 1)), "positive"),
    ("a.yml", HEAD + matrix("camera_matrix", "1., 0., 0., 0., 1., 0., 1., 0., 1."), "upper triangular"),
    ("a.yml", HEAD + matrix("camera_matrix", IDENTITY.replace("1., 0.", "1., 0.5", 1)), "skew"),
    ("a.yml", HEAD + LENS.replace("rows: 5", "rows: 6").replace("0.24", "0.24, 1."), "coefficients of distortion"),
    ("a.yml", HEAD + LENS.replace("0.24", "1e9"), "coefficient of distortion beyond"),
    ("a.yml", HEAD + LENS + matrix("M", IDENTITY), "are synonyms"),
    ("a.yml", HEAD + LENS + matrix("Camera_Matrix", IDENTITY), "capitals or underscores"),
    ("a.yml", HEAD + LENS + matrix("camera_matrix", IDENTITY), "a repeated one|not a file"),
    ("a.yml", HEAD + LENS.replace("640", "6.5"), "whole numbers"),
    ("a.yml", HEAD + LENS.replace("640", "2000000"), "whole numbers"),
    ("a.yml", HEAD + LENS.replace("board_width: 9", "board_width: 1"), "2 corners"),
    ("a.yml", HEAD + LENS.replace("board_width: 9", "board_width: 100000"), "whole numbers"),
    ("a.yml", HEAD + LENS.replace("2.5e-02", "-1"), "positive"),
    ("a.yml", HEAD + LENS.replace("cols: 6", "cols: 4").replace("rows: 2", "rows: 3"), "6 columns"),
    ("a.yml", HEAD + matrix("R", IDENTITY) + matrix("T", "0., 0.", 2, 1), "T three numbers"),
    ("a.yml", HEAD + matrix("R", "2., 0., 0., 0., 2., 0., 0., 0., 2.") + SHIFT, "scaled by 2"),
    ("a.yml", HEAD + matrix("R", IDENTITY[:-2] + "-1.") + SHIFT, "mirrored"),
    ("a.yml", HEAD + matrix("R", "9e9, 0., 0.", 3, 1) + SHIFT, "more than 360 degrees"),
    ("a.xml", XML.format("<l>\n../left.jpg ../right.jpg</l>"), "outside its folder"),
    ("a.xml", XML.format("<l>\n/etc/a.jpg /etc/b.jpg</l>"), "outside its folder"),
    ("a.xml", XML.format("<l>\na.jpg a.jpg</l>"), "twice"),
    ("a.xml", XML.format("<l>\na.jpg b.jpg</l><m>\nc.jpg d.jpg</m>"), "lists images"),
    ("a.xml", '<!DOCTYPE a [<!ENTITY x SYSTEM "/etc/passwd">]>\n' + XML.format("<a>&x;</a>"), "not a file of OpenCV"),
    ("a.json", '{"camera_matrix": {"type_id": "opencv-matrix", "rows": 3}}', "has no camera matrix"),
    ("a.yml", HEAD + LENS + "\0", "zero byte"),
    ("a.yml", HEAD + "# " + "x" * (1 << 22), "larger than"),
]  # fmt: skip


@pytest.fixture(scope="module")
def parsed(tmp_path_factory):
    """Every attack's file and what the parser makes of it: one process reads all but those that kill it."""
    root = tmp_path_factory.mktemp("attacks")
    paths = []
    for index, (name, content, _) in enumerate(ATTACKS):
        paths.append(root / str(index) / name)
        paths[-1].parent.mkdir()
        paths[-1].write_text(content)
    return list(zip(paths, read_storage_files(paths), strict=True))


@pytest.mark.parametrize("index", range(len(ATTACKS)))
def test_calibrations_are_checked(parsed, monkeypatch, index):
    path, entries = parsed[index]
    monkeypatch.setattr(format_opencv, "read_storage_files", lambda _: [entries])
    with pytest.raises(DataError, match=ATTACKS[index][2]) as caught:
        data.read_calibration(path)
    assert str(caught.value.path) == str(path)
    assert list(path.parent.iterdir()) == [path]


def test_nesting_without_end_kills_only_the_parser(tmp_path):
    (tmp_path / "a.yml").write_text(HEAD + "camera_matrix: " + "[" * 100_000)
    with pytest.raises(DataError, match=r"crashed its parser|made its parser fail|not a file of OpenCV"):
        data.read_calibration(tmp_path / "a.yml")


def test_files_that_state_the_same_are_named(tmp_path):
    folder = write_rig(tmp_path)
    (folder / "other.yml").write_bytes((folder / "intrinsics.yml").read_bytes())
    with pytest.raises(DataError, match=r"states the lens 'first' as intrinsics\.yml"):
        data.read_calibration(folder)
    (folder / "other.yml").write_bytes((folder / "extrinsics.yml").read_bytes())
    with pytest.raises(DataError, match=r"states R and T, and so does extrinsics\.yml"):
        data.read_calibration(folder)
    for name, width in (("other.yml", 9), ("third.yml", 8)):
        write_storage(folder / name, board_width=width, board_height=6, camera_matrix=np.eye(3))
    with pytest.raises(DataError, match="another file"):
        data.read_calibration(folder)


def test_compressed_files_pipes_and_links_are_not_followed(tmp_path):
    (tmp_path / "a.yml").write_bytes(gzip.compress(YAML.encode()))
    with pytest.raises(DataError, match="invalid UTF-8"):
        data.read_calibration(tmp_path / "a.yml")
    os.mkfifo(tmp_path / "b.yml")
    with pytest.raises(DataError, match="no such file"):
        data.read_calibration(tmp_path / "b.yml")
    folder = write_rig(tmp_path / "rig")
    (folder / "left00.png").rename(tmp_path / "left00.png")
    (folder / "left00.png").symlink_to(tmp_path / "left00.png")
    with pytest.raises(DataError, match="outside its folder"):
        data.read_calibration(folder)


@pytest.mark.parametrize("array", [np.array(np.nan), np.array(1e13), np.array([[np.inf]])])
def test_the_answer_of_a_process_is_checked(tmp_path, monkeypatch, array):
    monkeypatch.setattr(format_opencv, "parse_isolated", lambda *_, **__: [{"a": array}])
    (found,) = read_storage_files([tmp_path / "a.yml"])
    assert isinstance(found, DataError)
    assert found.path == tmp_path / "a.yml"


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_damaged_calibrations_give_a_data_error_or_a_calibration(tmp_path, monkeypatch, ending):
    rng = np.random.default_rng(0)
    source = tmp_path / f"source.{ending}"
    write_storage(source, camera_matrix=np.eye(3), D=np.full(5, 0.25), R=np.eye(3), T=np.ones(3), image_width=64,
                  image_height=48, board_width=9, board_height=6, square_size=0.5, list=["a.png", "b.png"],
                  extrinsic_parameters=np.ones((2, 6)))  # fmt: skip
    original = source.read_bytes()
    folder = tmp_path / "mutations"
    folder.mkdir()
    paths = [folder / f"{index}.{ending}" for index in range(TRIALS)]
    for path in paths:
        path.write_bytes(mutated(rng, original))
    before = sorted(tmp_path.rglob("*"))
    verdicts = []
    for path, entries in zip(paths, read_storage_files(paths), strict=True):
        monkeypatch.setattr(format_opencv, "read_storage_files", lambda _, entries=entries: [entries])
        verdicts.append(judged(lambda path=path: data.read_calibration(path)))
    assert set(verdicts) == {"read", "refused"}
    assert verdicts.count("refused") > TRIALS // 20
    assert sorted(tmp_path.rglob("*")) == before
