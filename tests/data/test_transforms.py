"""``transforms.json`` written by code that shares nothing with the reader, and lenses against a closed form."""

import json
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.posed_writers import (
    check_scene,
    render_sky,
    see_fisheye,
    see_perspective,
    sky,
    trimmed,
    write_transforms,
)


def test_frames_of_different_sizes_read_back(scene, tmp_path):
    read = data.open(write_transforms(scene, tmp_path))
    assert read.source == "transforms"
    assert read.names == tuple(f"images/{name}" for name in scene.names)
    assert read.points is None
    assert read.lenses is None
    assert not read.cut_out
    check_scene(read, scene, trimmed(scene))
    assert data.open(tmp_path / "transforms.json").names == read.names


def test_what_is_stated_once_holds_for_all_and_a_frame_overrides_it(scene, tmp_path):
    def change(values):
        frames = values["frames"]
        values |= {key: frames[0].pop(key) for key in ("fl_x", "fl_y", "cx", "cy")}
        for frame in frames:
            del frame["w"], frame["h"]

    check_scene(data.open(write_transforms(scene, tmp_path, change)), scene, trimmed(scene))


def test_an_angle_states_the_focal_length_and_the_middle_is_the_images(scene, tmp_path):
    def change(values):
        values["camera_angle_x"] = 0.8
        for frame in values["frames"]:
            for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
                del frame[key]

    read = data.open(write_transforms(scene, tmp_path, change))
    width, height = 64 - 5, 48 - 3
    focal = 0.5 * width / np.tan(0.4)
    expected = [[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]]
    np.testing.assert_allclose(read.cameras.intrinsics[1].numpy(), expected, rtol=1e-13)

    values = json.loads((tmp_path / "transforms.json").read_text())
    values["camera_angle_y"] = 0.5
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    K = data.open(tmp_path).cameras.intrinsics[1].numpy()
    np.testing.assert_allclose([K[0, 0], K[1, 1]], [focal, 0.5 * height / np.tan(0.25)], rtol=1e-13)


def test_three_rows_and_names_without_their_ending(scene, tmp_path):
    def change(values):
        for frame in values["frames"]:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
            del frame["transform_matrix"][3]

    read = data.open(write_transforms(scene, tmp_path, change))
    assert read.names[0] == "./images/v0"
    check_scene(read, scene, trimmed(scene))


def test_alpha_cuts_out(scene, tmp_path):
    write_transforms(scene, tmp_path)
    pixels = np.dstack([trimmed(scene)[2], np.full(trimmed(scene)[2].shape[:2], 255, np.uint8)])
    pixels[5:20, 7:30, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "images" / scene.names[2])
    read = data.open(tmp_path)
    assert read.cut_out
    assert float(read.load(2)[:, 5:20, 7:30].min()) == 1
    np.testing.assert_array_equal(read.load_mask(2).numpy(), pixels[..., 3] > 0)
    assert bool(read.load_mask(0).all())
    np.testing.assert_array_equal(read.load(0).mul(255).round().to(torch.uint8).permute(1, 2, 0), trimmed(scene)[0])


@pytest.mark.parametrize(("scale", "step"), [(None, 0.001), (0.0025, 0.0025)])
def test_depth_is_in_millimetres_or_in_what_is_said(scene, tmp_path, scale, step):
    def change(values):
        values["frames"][1]["depth_file_path"] = "depth/1.png"
        if scale is not None:
            values["depth_unit_scale_factor"] = scale

    write_transforms(scene, tmp_path, change)
    counts = np.arange(45 * 59, dtype=np.uint16).reshape(45, 59)
    (tmp_path / "depth").mkdir()
    Image.fromarray(counts).save(tmp_path / "depth" / "1.png")
    read = data.open(tmp_path)
    np.testing.assert_allclose(read.load_depth(1).numpy(), (counts * step).astype(np.float32), rtol=1e-6)
    assert read.load_depth(0) is None


def write_depth(scene, folder, counts):
    write_transforms(scene, folder, lambda values: values["frames"][1].update(depth_file_path="depth.png"))
    Image.fromarray(counts).save(folder / "depth.png")
    return data.open(folder)


@pytest.mark.parametrize("size", [(15, 20), (45, 59), (90, 118), (23, 30), (1, 1)])
def test_depth_of_other_sizes_is_taken_at_its_nearest_pixels(scene, tmp_path, size):
    counts = np.arange(1, size[0] * size[1] + 1, dtype=np.uint16).reshape(size)
    depth = write_depth(scene, tmp_path, counts).load_depth(1).numpy()
    assert depth.shape == (45, 59)
    for row, column in ((0, 0), (7, 3), (22, 29), (31, 40), (44, 58)):
        there = (int(Fraction(2 * row + 1, 90) * size[0]), int(Fraction(2 * column + 1, 118) * size[1]))
        np.testing.assert_allclose(depth[row, column], 0.001 * counts[there], rtol=1e-6)


@pytest.mark.parametrize("size", [(20, 15), (45, 57), (1, 59), (43, 59)])
def test_depth_of_another_shape_than_its_image_is_refused(scene, tmp_path, size):
    with pytest.raises(DataError, match=r"depth\.png.*59 x 45: another shape"):
        write_depth(scene, tmp_path, np.ones(size, np.uint16)).load_depth(1)


LENSES = {
    "OPENCV": (see_perspective, (-0.25, 0.06, 0.003, -0.002), ("k1", "k2", "p1", "p2")),
    "k3": (see_perspective, (0.12, -0.05, 0.0, 0.001, 0.02), ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": (see_fisheye, (0.06, -0.02, 0.01, -0.003), ("k1", "k2", "k3", "k4")),
    "is_fisheye": (see_fisheye, (-0.03, 0.01, 0.0, 0.0), ("k1", "k2", "k3", "k4")),
}


@pytest.mark.parametrize("model", LENSES)
def test_a_straightened_image_is_what_a_pinhole_camera_sees(scene, tmp_path, model):
    see, k, keys = LENSES[model]
    size = scene.size
    images = [render_sky(see, scene.K[view] * [[0.45], [0.45], [1]], k, size, scene.R[view]) for view in range(5)]

    def change(values):
        if model == "is_fisheye":
            del values["camera_model"]
            values["is_fisheye"] = True
        else:
            values["camera_model"] = model if model in ("OPENCV", "OPENCV_FISHEYE") else "OPENCV"
        values |= dict(zip(keys, k, strict=True))
        for view, frame in enumerate(values["frames"]):
            K = scene.K[view] * [[0.45], [0.45], [1]]
            frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}

    read = data.open(write_transforms(scene, tmp_path, change, images))
    assert len(read.lenses) == 5
    v, u = np.mgrid[: size[0], : size[1]]
    errors, unbent = [], []
    for view in range(5):
        K = read.cameras.intrinsics[view].numpy()
        assert abs(K[0, 0] / (0.45 * scene.K[view][0, 0]) - 1) > 0.005  # another view than the lens's own
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
        expected = sky(rays @ scene.R[view])
        found = 255 * read.load(view).permute(1, 2, 0).double().numpy()
        errors.append(np.abs(found - expected))
        unbent.append(np.abs(images[view] - expected))
    # Grey levels: half of one is rounding, the rest mixes four pixels of a texture that curves.
    assert np.quantile(errors, 0.99) < 3
    assert np.max(errors) < 6
    assert np.quantile(unbent, 0.9) > 10


def test_frames_of_one_camera_share_a_lens(scene, tmp_path):
    def change(values):
        values["k1"] = -0.1
        for frame in values["frames"]:
            frame |= {"fl_x": 150.0, "fl_y": 150.0, "cx": 32.0, "cy": 24.0}

    read = data.open(write_transforms(scene, tmp_path, change, list(scene.images)))
    assert len({id(lens) for lens in read.lenses}) == 1
    assert read.camera(0).intrinsics.equal(read.camera(4).intrinsics)


def test_a_folder_of_several_says_so_and_a_file_decides(scene, tmp_path):
    write_transforms(scene, tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert len(data.open(tmp_path)) == 5
    (tmp_path / "transforms_test.json").write_bytes((tmp_path / "transforms_train.json").read_bytes())
    with pytest.raises(
        DataError, match=r"found transforms_test\.json, transforms_train\.json: pass the path of one file"
    ):
        data.open(tmp_path)
    assert len(data.open(tmp_path / "transforms_test.json")) == 5


def matrix(values, change):
    values["frames"][1]["transform_matrix"] = change(np.array(values["frames"][1]["transform_matrix"])).tolist()


def scaled(pose):
    return np.concatenate([pose[:3, :3] * 2.5, pose[:3, 3:]], 1)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda values: matrix(values, scaled), r"frame 1: the rotation is scaled by 2\.5; divide"),
        (lambda values: matrix(values, lambda m: m * [[1, -1, 1, 1]]), "frame 1: the rotation is mirrored"),
        (lambda values: matrix(values, lambda m: m + [[0.1, 0, 0, 0]] * 4), "last row|not a rotation"),
        (lambda values: matrix(values, lambda m: m.T), "transform_matrix must have the last row 0 0 0 1"),
        (lambda values: matrix(values, lambda m: m[:2]), "transform_matrix must be 4 x 4 numbers"),
        (lambda values: values["frames"][1].update(w=128, h=96), "has 128 x 96 pixels .*: K of another resolution"),
        (lambda values: values["frames"][1].update(w=59.5), "w must be a whole number"),
        (lambda values: [frame.pop(key) for frame in values["frames"] for key in ("fl_x", "fl_y")], "no focal length"),
        (lambda values: values["frames"][1].update(fl_x=-5), "focal lengths must be positive"),
        (lambda values: values["frames"][1].update(fl_x=True), "fl_x must be a number"),
        (lambda values: values.update(camera_angle_x=4.0) or values["frames"][0].pop("fl_x"), "between 0 and pi"),
        (lambda values: values.update(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' cannot be undistorted"),
        (lambda values: values.update(k4=0.1), "k4 has no defined meaning"),
        (lambda values: values.update(k1=-9.0), "the distortion"),
        (lambda values: values.update(ftheta_p0=1.0), "ftheta_p0 is of a camera"),
        (lambda values: values.update(frames=[]), "frames must be a list of 1 to"),
        (lambda values: values["frames"].append(values["frames"][0]), "uses an image name twice"),
        (lambda values: values["frames"][2].update(file_path="images/nobody"), "no such image, also not with"),
        (lambda values: values["frames"][2].update(depth_file_path="../../d.png"), "outside its folder"),
    ],
)
def test_files_that_make_no_sense_are_refused(scene, tmp_path, change, match):
    write_transforms(scene, tmp_path, change)
    with pytest.raises(DataError, match=match) as caught:
        data.open(tmp_path)
    assert str(tmp_path) in str(caught.value.path)
