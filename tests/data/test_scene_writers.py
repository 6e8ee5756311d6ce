"""What is written reads back equal, and is there whole or not at all."""

import json
import os

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.data.atomic_files import atomic_file, atomic_folder, is_abandoned
from lsmgeo.errors import CameraError, DataError, OptionError
from tests.data.posed_writers import trimmed, write_plain_cameras, write_transforms
from tests.data.writers import project, write_colmap

WRITERS = {"colmap": data.write_colmap, "transforms": data.write_transforms, "cameras": data.write_cameras_json}


def check(read, source, atol=1e-12):
    assert len(read) == len(source)
    for view in range(len(source)):
        torch.testing.assert_close(read.camera(view).intrinsics, source.camera(view).intrinsics, rtol=1e-14, atol=0)
        torch.testing.assert_close(
            read.camera(view).cam_from_world, source.camera(view).cam_from_world, rtol=0, atol=atol
        )
        assert read.size(view) == source.size(view)
        torch.testing.assert_close(read.load(view), source.load(view), rtol=0, atol=0)


@pytest.mark.parametrize("form", WRITERS)
def test_images_of_different_sizes_read_back(scene, tmp_path, form):
    source = data.open(write_transforms(scene, tmp_path / "source"))
    folder = WRITERS[form](source, tmp_path / "new" / "folder")
    assert folder == tmp_path / "new" / "folder"
    assert os.listdir(tmp_path / "new") == ["folder"]
    read = data.open(folder)
    assert read.source == form
    check(read, source)
    # The images' own bytes, under the same names however often they are written.
    assert [path.read_bytes() for path in read.paths] == [path.read_bytes() for path in source.paths]
    again = WRITERS[form](read, tmp_path / "again")
    assert sorted(path.relative_to(again) for path in again.rglob("*")) == sorted(
        path.relative_to(folder) for path in folder.rglob("*")
    )


@pytest.mark.parametrize("form", WRITERS)
def test_what_a_lens_bent_is_written_straight(scene, tmp_path, form):
    def change(values):
        values |= {"k1": -0.2, "k2": 0.05}
        for frame in values["frames"]:
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        del values["camera_model"]

    source = data.open(write_transforms(scene, tmp_path / "source", change))
    assert source.lenses is not None
    read = data.open(WRITERS[form](source, tmp_path / "out"))
    assert read.lenses is None
    check(read, source)


def test_cut_out_and_distorted_images_keep_their_silhouettes(scene, tmp_path):
    write_transforms(scene, tmp_path / "source", lambda values: values.update(k1=-0.2))
    pixels = np.dstack([trimmed(scene)[2], np.full(trimmed(scene)[2].shape[:2], 255, np.uint8)])
    pixels[5:20, 7:30, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "source" / "images" / scene.names[2])
    source = data.open(tmp_path / "source")
    read = data.open(data.write_cameras_json(source, tmp_path / "out"))
    check(read, source)
    assert read.load_mask(2).equal(source.load_mask(2))
    assert not bool(read.load_mask(2).all())


@pytest.mark.parametrize("form", ["text", "binary"])
def test_points_and_who_sees_them_read_back(scene, tmp_path, form):
    source = data.open(write_colmap(scene, tmp_path / "source", form=form))
    read = data.open(data.write_colmap(source, tmp_path / "out"))
    assert read.names == ("v0.png", "v1.png", "v2.png", "v4.png", "view_3.png")
    check(read, source)
    np.testing.assert_array_equal(read.points.positions, source.points.positions)
    np.testing.assert_array_equal(read.points.colours, source.points.colours)
    for view, observed in enumerate(read.points.observations):
        np.testing.assert_array_equal(observed.points, source.points.observations[view].points)
        np.testing.assert_allclose(observed.pixels, project(scene, view)[observed.points], atol=1e-9)


def test_one_camera_is_stated_once(scene, tmp_path):
    one = scene._replace(K=np.broadcast_to(scene.K[:1], scene.K.shape))
    source = data.open(write_colmap(one, tmp_path / "source", form="text"))
    check(data.open(data.write_transforms(source, tmp_path / "transforms")), source)
    values = json.loads((tmp_path / "transforms" / "transforms.json").read_text())
    focal = one.K[0, 0, 0]
    assert (values["w"], values["h"], values["fl_x"], values["cx"]) == (64, 48, focal, one.K[0, 0, 2] + 0.5)
    np.testing.assert_allclose(values["camera_angle_x"], 2 * np.arctan(32 / focal), rtol=1e-14)
    assert set(values["frames"][0]) == {"file_path", "transform_matrix"}
    data.write_colmap(source, tmp_path / "colmap")
    assert len((tmp_path / "colmap" / "sparse" / "0" / "cameras.txt").read_text().splitlines()) == 1


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_a_rotation_that_is_nearly_one_keeps_its_camera_centre(scene, tmp_path, form):
    rounded = scene._replace(R=np.round(scene.R, 4))
    source = data.open(write_plain_cameras(rounded, tmp_path / "source"))
    read = data.open(WRITERS[form](source, tmp_path / "out"))
    check(read, source, atol=2e-4)
    E = read.cameras.cam_from_world.numpy()
    np.testing.assert_allclose(
        E[:, :3, :3] @ E[:, :3, :3].transpose(0, 2, 1), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-14
    )
    centers = np.linalg.solve(rounded.R, -rounded.t[..., None])
    np.testing.assert_allclose(-E[:, :3, :3].transpose(0, 2, 1) @ E[:, :3, 3:], centers, atol=1e-13)
    exact = data.open(data.write_cameras_json(source, tmp_path / "plain"))
    np.testing.assert_array_equal(exact.cameras.cam_from_world[:, :3, :3].numpy(), rounded.R)


def test_only_cameras_are_written_beside_their_images(scene, tmp_path):
    source = data.open(write_transforms(scene, tmp_path))
    file = data.write_cameras_json(source, tmp_path / "alone.json")
    check(data.open(file), source)
    with pytest.raises(OptionError, match="must be below the folder of the file"):
        data.write_cameras_json(source, tmp_path / "elsewhere" / "alone.json")
    bent = data.open(write_transforms(scene, tmp_path / "bent", lambda values: values.update(k1=-0.1)))
    with pytest.raises(OptionError, match="path must be a folder if images have distortion"):
        data.write_cameras_json(bent, tmp_path / "bent" / "alone.json")


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_skew_is_refused(scene, tmp_path, form):
    def change(values):
        values["cameras"][1]["K"][0][1] = 0.75

    source = data.open(write_plain_cameras(scene, tmp_path / "source", change))
    with pytest.raises(CameraError, match=r"no skew: .* cannot hold 'images/v1\.png' with K.* 0\.75"):
        WRITERS[form](source, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    check(data.open(data.write_cameras_json(source, tmp_path / "out")), source)


@pytest.mark.parametrize("form", WRITERS)
def test_what_is_there_is_not_touched(scene, tmp_path, form):
    source = data.open(write_transforms(scene, tmp_path / "source"))
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine").write_text("kept")
    for path in (out, out / "mine"):
        with pytest.raises(DataError, match="exists and is not an empty folder") as caught:
            WRITERS[form](source, path)
        assert caught.value.path == path
    assert (out / "mine").read_text() == "kept"
    (out / "mine").unlink()
    WRITERS[form](source, out)
    assert len(data.open(out)) == 5


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("fault", ["missing", "other size", "full", "interrupt", "rename"])
def test_a_failed_write_leaves_nothing(scene, tmp_path, monkeypatch, form, fault):
    source = data.open(write_transforms(scene, tmp_path / "source"))
    expected = DataError
    if fault == "missing":
        source.paths[3].unlink()
    elif fault == "other size":
        Image.new("RGB", (3, 3)).save(source.paths[3])
    else:

        def fail(*_, **__):
            raise KeyboardInterrupt if fault == "interrupt" else OSError(28, "No space left on device")

        expected = KeyboardInterrupt if fault == "interrupt" else DataError
        monkeypatch.setattr("pathlib.Path.replace" if fault == "rename" else "os.fsync", fail)
    with pytest.raises(expected):
        WRITERS[form](source, tmp_path / "made" / "out")
    assert list((tmp_path / "made").iterdir()) == []


def test_two_images_of_one_name_are_refused(scene, tmp_path):
    source = data.open(write_colmap(scene, tmp_path / "source", form="text"))
    names = ("a b.png", "a_b.png", *source.names[2:])
    source = data.PosedImages(names, source.paths, source.cameras, None, "colmap")
    with pytest.raises(DataError, match=r"two images that would be named 'a_b\.png'"):
        data.write_colmap(source, tmp_path / "out")
    assert len(data.open(data.write_transforms(source, tmp_path / "out"))) == 5


def test_names_lead_nowhere_else(scene, tmp_path):
    source = data.open(write_colmap(scene, tmp_path / "source", form="text"))
    names = ("../../a.png", "/etc/b.png", *source.names[2:])
    source = data.PosedImages(names, source.paths, source.cameras, None, "colmap")
    folder = data.write_transforms(source, tmp_path / "out")
    read = data.open(folder)
    assert read.names[:2] == ("images/a.png", "images/etc/b.png")
    assert sorted(os.listdir(tmp_path)) == ["out", "source"]


def test_a_folder_that_is_filled_meanwhile_keeps_what_it_holds(tmp_path):
    writing = atomic_folder(tmp_path / "scene")
    (writing.__enter__() / "mine").write_text("mine")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "theirs").write_text("theirs")
    with pytest.raises(DataError, match="scene"):
        writing.__exit__(None, None, None)
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "theirs"]


def test_a_temporary_file_is_abandoned_when_its_writer_has_gone(tmp_path):
    with atomic_file(tmp_path / "file") as stream:
        stream.write(b"half")
        (temporary,) = tmp_path.glob(".file.*.tmp")
        assert not is_abandoned(temporary)
    left = tmp_path / ".file.0123abcd.tmp"
    left.write_bytes(b"half")
    assert is_abandoned(left)
