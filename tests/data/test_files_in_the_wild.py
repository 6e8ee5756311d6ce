"""What files of other programs hold beside the essential: marks of byte order, comments in images, odd names."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from lsmgeo import data
from lsmgeo.data.formats import format_colmap
from lsmgeo.data.formats.depth_files import DepthPng
from lsmgeo.data.formats.lenses import Lens
from lsmgeo.data.images import read_cut_out, read_image
from lsmgeo.errors import CameraError, DataError
from tests.data import posed_writers
from tests.data.hostile import TRIALS, mutated
from tests.data.writers import make_scene, write_colmap, write_middlebury


def test_a_palette_with_transparency_is_read(tmp_path):
    indices = np.arange(12, dtype=np.uint8).reshape(3, 4) % 3
    image = Image.frombytes("P", (4, 3), indices.tobytes())
    image.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90])
    image.save(tmp_path / "a.png", transparency=bytes([0, 128, 255]))
    colours = np.array([[10, 20, 30], [40, 50, 60], [70, 80, 90]], np.uint8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), colours[indices])
    expected = np.concatenate([colours[indices], np.array([[0], [128], [255]], np.uint8)[indices]], -1)
    np.testing.assert_array_equal(read_cut_out(tmp_path / "a.png"), expected)


def test_an_image_with_a_damaged_second_one_is_read(tmp_path):
    images = [Image.new("RGB", (16, 8), (value,) * 3) for value in (200, 10)]
    images[0].save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=images[1:])
    content = (tmp_path / "a.jpg").read_bytes()
    index = content.index(b"MPF\0") + 8
    (tmp_path / "a.jpg").write_bytes(content[:index] + b"\xff\xff\xff\xff" + content[index + 4 :])
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), np.full((8, 16, 3), 200))


def test_an_orientation_in_exif_is_not_applied(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    image = Image.new("L", (16, 8))
    image.paste(255, (8, 0, 16, 8))
    image.save(tmp_path / "a.jpg", exif=exif)
    assert (read_image(tmp_path / "a.jpg")[:, :, 0] > 127).tolist() == [[False] * 8 + [True] * 8] * 8


def test_depth_may_have_a_resolution_and_comments(tmp_path):
    steps = np.arange(35, dtype=np.uint16).reshape(5, 7) * 1500
    comments = PngInfo()
    comments.add_text("Software", "a depth camera")
    comments.add(b"gAMA", (45455).to_bytes(4, "big"))
    comments.add(b"tRNS", (3000).to_bytes(2, "big"))
    Image.fromarray(steps).save(tmp_path / "a.png", pnginfo=comments, dpi=(96, 96))
    expected = steps * np.float32(0.001)
    np.testing.assert_allclose(DepthPng(tmp_path / "a.png", 0.001).read((5, 7)), expected, rtol=1e-6)


def test_damaged_depth_with_comments_is_refused(tmp_path):
    comments = PngInfo()
    comments.add_text("Software", "a depth camera")
    steps = np.arange(35, dtype=np.uint16).reshape(5, 7)
    Image.fromarray(steps).save(tmp_path / "a.png", pnginfo=comments)
    content = (tmp_path / "a.png").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(TRIALS):
        (tmp_path / "b.png").write_bytes(mutated(rng, content))
        with contextlib.suppress(DataError):
            np.testing.assert_array_equal(DepthPng(tmp_path / "b.png", 1.0).read((5, 7)), steps)


@pytest.mark.parametrize("form", ["transforms", "cameras", "colmap", "middlebury", "strecha"])
def test_text_with_a_mark_of_byte_order_and_windows_lines_is_read(tmp_path, form):
    scene = make_scene()
    if form == "colmap":
        write_colmap(scene, tmp_path, form="text")
    elif form == "middlebury":
        write_middlebury(scene, tmp_path)
    elif form == "strecha":
        posed_writers.write_strecha(scene, tmp_path, tmp_path, [f"{view}.png" for view in range(len(scene.images))])
    else:
        write = {"transforms": posed_writers.write_transforms, "cameras": posed_writers.write_plain_cameras}[form]
        write(scene, tmp_path)
    plain = data.open(tmp_path)
    for file in [file for file in tmp_path.rglob("*") if file.suffix in (".json", ".txt", ".camera")]:
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    marked = data.open(tmp_path)
    assert marked.names == plain.names
    for value, expected in zip(marked.cameras, plain.cameras, strict=True):
        np.testing.assert_array_equal(value, expected)


def test_names_of_windows_lead_into_folders(tmp_path):
    scene = make_scene()
    names = [f"images\\{view}.png" for view in range(len(scene.images))]
    posed_writers.save(scene.images, [name.replace("\\", "/") for name in names], tmp_path)
    values = posed_writers.transforms(scene, scene.images, names)
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    assert data.open(tmp_path).paths[1] == tmp_path / "images" / "1.png"
    values["frames"][0]["file_path"] = "..\\secret.png"
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(DataError, match="outside its folder"):
        data.open(tmp_path)


def test_names_longer_than_the_system_takes_are_refused(tmp_path):
    scene = make_scene()
    name = "x" * 300
    values = posed_writers.transforms(scene, scene.images[:1], [name])
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    (tmp_path / "frame_index.txt").write_text(f"{name}\n")
    (tmp_path / "images").mkdir()
    (tmp_path / "K.txt").write_text("9 0 4 0 9 4 0 0 1")
    for read in (data.read_transforms, data.read_rgbd):
        with pytest.raises(DataError, match="too long"):
            read(tmp_path)
        with pytest.raises(DataError, match="too long"):
            read(path=tmp_path)


def test_blanks_in_a_calibration_are_passed_once(tmp_path):
    # A pattern that tries every way to share them out takes a minute.
    (tmp_path / "calib.txt").write_text(f"cam0={' ' * 65_000}x")
    with pytest.raises(DataError, match="cam0 must be a 3 x 3 matrix"):
        data.read_stereo_pair(tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_text(f"note=x{' ' * 65_000}x")
    with pytest.raises(DataError, match="does not state cam0"):
        data.read_stereo_pair(tmp_path / "calib.txt")


READERS = (
    data.read_binvox,
    data.read_calibration,
    data.read_cameras_json,
    data.read_colmap,
    data.read_llff,
    data.read_lsm,
    data.read_middlebury,
    data.read_r2n2,
    data.read_rgbd,
    data.read_seven_scenes,
    data.read_stereo_pair,
    data.read_strecha,
    data.read_transforms,
)


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__name__)
def test_folders_that_may_not_be_looked_into_are_refused(tmp_path, monkeypatch, read):
    # The superuser may look everywhere, so the system's answer is put in place of permissions.
    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    for name in ("is_dir", "is_file", "exists", "stat", "glob", "iterdir"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(DataError, match="Permission denied") as caught:
        read(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_files_beside_images_that_macos_leaves_are_ignored(tmp_path):
    scene = make_scene()
    posed_writers.save(scene.images, [f"{view}.png" for view in range(len(scene.images))], tmp_path / "images")
    (tmp_path / "images" / "._0.png").write_bytes(b"Mac OS X")
    np.save(tmp_path / "poses_bounds.npy", posed_writers.llff_rows(scene, 100.0))
    assert data.open(tmp_path).names == tuple(f"{view}.png" for view in range(len(scene.images)))


@pytest.mark.parametrize(
    ("sparse", "named"),
    [
        ("colmap/sparse/0", "colmap"),
        ("colmap/sparse/0", "colmap/sparse/0"),
        ("sparse/0", "sparse"),
        ("sparse/0", "sparse/0"),
        ("sparse", "."),
    ],
)
def test_images_of_a_model_are_found_above_it(tmp_path, monkeypatch, sparse, named):
    scene = make_scene()
    write_colmap(scene, tmp_path, form="text", sparse=sparse)
    assert data.open(tmp_path / named).paths[0].parent == tmp_path / "images"
    monkeypatch.chdir(tmp_path / sparse)
    assert data.open(".").paths[0].parent == tmp_path / "images"


def test_a_long_name_is_not_repeated_whole(tmp_path):
    write_colmap(make_scene(), tmp_path, form="text")
    (tmp_path / "sparse/0/images.txt").write_text(f"1 1 0 0 0 0 0 0 99 {'x' * 100_000}\n\n")
    with pytest.raises(DataError, match="refers to camera 99") as caught:
        format_colmap.read_colmap(tmp_path)
    assert len(str(caught.value)) < 1000


def test_images_too_long_for_opencv_are_refused_before_they_are_read():
    K = np.array([[33000.0, 0, 16499.5], [0, 33000, 4.5], [0, 0, 1]])
    with pytest.raises(CameraError, match="at most 32766 pixels"):
        _ = Lens("perspective", K, (-0.01, 0.0, 0.0, 0.0), 10, 33000).pinhole
    lens = Lens("perspective", K, (-0.01, 0.0, 0.0, 0.0), 10, 32766)
    assert lens.straighten(np.zeros((10, 32766), np.uint8)).shape == (10, 32766)
