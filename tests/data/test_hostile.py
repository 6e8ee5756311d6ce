"""Files that lie: every one gives a DataError that names it, quickly, and touches nothing outside its folder."""

import os
import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.hostile import chunk, judge_mutations, read_scene, scene_refused
from tests.data.writers import make_scene, write_colmap, write_middlebury

SCENE = make_scene(24, 32)
MODEL = "sparse/0"
# A reader that hangs or expands a small file without end is stopped, and fails.
pytestmark = pytest.mark.timeout(60)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("nonsense", "expected a name and 21 numbers"),
        ("../v1.png {rest}", "outside its folder"),
        ("/etc/passwd {rest}", "outside its folder"),
        ("missing.png {rest}", "no such file"),
        ("v0.png {rest}", "twice"),
        ("v1.png " + "1 " * 21, "K must be"),
        ("v1.png 5 0 1 0 5 1 0 0 1 " + "2 0 0 0 2 0 0 0 2 0 0 0", "the rotation is scaled by 2"),
        ("v1.png 5 0 1 0 5 1 0 0 1 " + "1 0 0 0 1 0 0 0 -1 0 0 0", "the rotation is mirrored"),
        ("v1.png nan" + " 0" * 20, "finite"),
        ("v1.png 1e999" + " 0" * 20, "finite"),
        ("v1.png " + "9" * 5000 + " 0" * 20, "number too long"),
        ("v1.png x" + " 0" * 20, "expected numbers"),
    ],
)
def test_middlebury_lines_are_checked(tmp_path, line, match):
    file = write_middlebury(SCENE, tmp_path) / "scene_par.txt"
    lines = file.read_text().splitlines()
    lines[2] = line.format(rest=lines[2].split(maxsplit=1)[1])
    file.write_text("\n".join(lines))
    scene_refused(tmp_path, match)


@pytest.mark.parametrize(
    ("content", "match"),
    [(b"", "first line"), (b"999999999999\n", "announces"), (b"5\n", "announces"), (b"0\n", "announces"),
     (b"-1\n", "announces"), (b"\xff\xfe5\n", "UTF-8"), (b"1\0\n", "zero byte"), (b"1 2\n", "first line"),
     (b"9" * 50 + b"\n", "too long")],
)  # fmt: skip
def test_middlebury_headers_are_checked(tmp_path, content, match):
    (tmp_path / "scene_par.txt").write_bytes(content)
    scene_refused(tmp_path, match)


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    outside = tmp_path / "outside.png"
    Image.new("RGB", (32, 24)).save(outside)
    folder = write_middlebury(SCENE, tmp_path / "scene")
    (folder / "v1.png").unlink()
    (folder / "v1.png").symlink_to(outside)
    scene_refused(folder, "outside its folder")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [43, 2**31, 2**63, 2**64 - 1])
def test_binary_counts_are_compared_with_the_file(tmp_path, name, count):
    file = write_colmap(SCENE, tmp_path, form="binary") / MODEL / f"{name}.bin"
    file.write_bytes(struct.pack("<Q", count) + file.read_bytes()[8:])
    scene_refused(tmp_path, "more than it can hold|ends inside|without end")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_are_read_to_their_end(tmp_path, name):
    file = write_colmap(SCENE, tmp_path, form="binary") / MODEL / f"{name}.bin"
    content = file.read_bytes()
    file.write_bytes(content + b"\0")
    scene_refused(tmp_path, "after its last record")
    for length in (0, 4, 8, 20, len(content) // 2, len(content) - 1):
        file.write_bytes(content[:length])
        scene_refused(tmp_path, "more than it can hold|ends inside|without end")


@pytest.mark.parametrize(
    ("file", "old", "new", "match"),
    [
        ("cameras.txt", "2 PINHOLE", "2 FOV", "undistort first"),
        ("cameras.txt", "2 PINHOLE", "2 MAGIC", "unknown camera model"),
        ("cameras.txt", "2 PINHOLE", "1 PINHOLE", "twice"),
        ("cameras.txt", "2 PINHOLE", "77 PINHOLE", "does not exist"),
        ("cameras.txt", "PINHOLE 32 24", "PINHOLE 0 24", "invalid size"),
        ("cameras.txt", "PINHOLE 32 24", "PINHOLE 999999999 24", "invalid size"),
        ("cameras.txt", "PINHOLE 32 24", "PINHOLE 32", "whole numbers"),
        ("cameras.txt", "PINHOLE 32 24 1", "PINHOLE 32 24 -1", "positive"),
        ("images.txt", " v1.png", " ../v1.png", "outside its folder"),
        ("images.txt", " v1.png", " /etc/passwd", "outside its folder"),
        ("images.txt", " v1.png", " v0.png", "twice"),
        ("images.txt", " v1.png", "", "expected id"),
        ("images.txt", "\n6 ", "\n5 ", "twice"),
        ("images.txt", "\n6 ", "\n6 3", "quaternion"),
        ("images.txt", " 133", " 134", "does not exist"),
        ("images.txt", " -1", "", "x, y, point id"),
        ("points3D.txt", "\n13 ", "\n10 ", "twice"),
        ("points3D.txt", "\n13 ", "\n13 nan ", "finite"),
        ("points3D.txt", " 37 74", " 370 74", "0..255|expected"),
        ("points3D.txt", "\n13 ", "\n99999999999999999999 ", "64 bits"),
    ],
)
def test_text_models_are_checked(tmp_path, file, old, new, match):
    path = write_colmap(SCENE, tmp_path, form="text") / MODEL / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    scene_refused(tmp_path, match)


def test_a_binary_camera_that_opencv_lacks_is_named(tmp_path):
    file = write_colmap(SCENE, tmp_path, form="binary") / MODEL / "cameras.bin"
    content = bytearray(file.read_bytes())
    content[12] = 7
    file.write_bytes(bytes(content))
    scene_refused(tmp_path, "camera model FOV does not exist in OpenCV; undistort first")


def test_other_folders_say_what_is_missing(tmp_path):
    scene_refused(tmp_path, "is empty")
    scene_refused(tmp_path / "nowhere", "no such file or folder")
    write_middlebury(SCENE, tmp_path)
    (tmp_path / "other_par.txt").write_text("1\n")
    scene_refused(tmp_path, "expected one")
    (tmp_path / "other_par.txt").unlink()
    write_colmap(SCENE, tmp_path, form="text")
    scene_refused(tmp_path, "holds a Middlebury .* and a COLMAP model")


def test_a_pipe_is_not_waited_for(tmp_path):
    folder = write_middlebury(SCENE, tmp_path)
    (folder / "v1.png").unlink()
    os.mkfifo(folder / "v1.png")
    scene_refused(folder, "no such file")


def png_of(width, height, *, payload=b""):
    """A PNG header of any size, with hardly any data."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(payload)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (png_of(100_000, 100_000), "pixels|limit|exceeds"),
        (png_of(8193, 8192), "limit is 67108864"),
        (png_of(1 << 26, 2), "pixels|limit|exceeds"),
        (png_of(32, 24), "not a readable|truncated"),
        (b"GIF89a" + bytes(64), "not a readable"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 24\n", "not a readable"),
        (b"", "not a readable"),
        (b"SIMPLE  =                    T" + b" " * 2850, "not a readable"),
    ],
)
def test_images_are_checked(tmp_path, content, match):
    folder = write_middlebury(SCENE, tmp_path)
    (folder / "v1.png").write_bytes(content)
    scene_refused(folder, match)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (png_of(100_000, 100_000), "pixels|limit|exceeds"),
        (png_of(8193, 8192), "limit is 67108864"),
        (png_of(8192, 8192), "its camera expects 32 x 24"),
        (png_of(6048, 4032), "its camera expects 32 x 24"),
    ],
)
def test_an_image_of_another_size_is_refused_before_it_is_decoded(tmp_path, monkeypatch, content, match):
    folder = write_colmap(SCENE, tmp_path, form="binary")
    (folder / "images" / "v1.png").write_bytes(content)
    scene = data.open(folder)

    def load(self):
        pytest.fail("a pixel is decoded")

    monkeypatch.setattr(PngImageFile, "load", load)
    with pytest.raises(DataError, match=match):
        scene.load(scene.names.index("v1.png"))


def test_a_sixteen_bit_image_is_refused(tmp_path):
    folder = write_middlebury(SCENE, tmp_path)
    Image.fromarray(np.zeros((24, 32), np.uint16)).save(folder / "v1.png")
    scene_refused(folder, "8-bit")


@pytest.mark.parametrize("form", ["middlebury", "text", "binary", "png", "jpeg"])
def test_damaged_bytes_give_a_data_error_or_a_scene(tmp_path, form):
    if form in ("text", "binary"):
        folder = write_colmap(SCENE, tmp_path, form=form)
        files = sorted((folder / MODEL).iterdir())
    else:
        folder = write_middlebury(SCENE, tmp_path)
        files = [folder / ("scene_par.txt" if form == "middlebury" else "v1.png")]
        if form == "jpeg":
            Image.fromarray(SCENE.images[1]).save(files[0], format="JPEG")
    for file in files:
        judge_mutations(tmp_path, file, lambda: read_scene(folder))
