"""``poses_bounds.npy`` written by code that shares nothing with the reader."""

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.posed_writers import llff_rows, save

FOCAL = 157.25


def write(scene, folder, images="images", rows=None):
    save(list(scene.images), scene.names, folder / images)
    np.save(folder / "poses_bounds.npy", llff_rows(scene, FOCAL) if rows is None else rows)
    return folder


def check_poses(read, scene, atol=1e-12):
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, :3].numpy(), scene.R, atol=atol)
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, 3].numpy(), scene.t, atol=10 * atol)


@pytest.mark.parametrize(("dtype", "atol"), [(np.float64, 1e-12), (np.float32, 3e-7), (">f8", 1e-12)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_rows_read_back(scene, tmp_path, dtype, atol, order):
    read = data.open(write(scene, tmp_path, rows=np.asarray(llff_rows(scene, FOCAL), dtype, order=order)))
    assert read.source == "llff"
    assert read.names == tuple(sorted(scene.names))
    check_poses(read, scene, atol)
    expected = np.array([[FOCAL, 0, 31.5], [0, FOCAL, 23.5], [0, 0, 1]])
    np.testing.assert_array_equal(read.cameras.intrinsics.numpy(), np.broadcast_to(expected, (5, 3, 3)))
    for view in range(5):
        expected = torch.from_numpy(scene.images[view]).permute(2, 0, 1).to(torch.float32) / 255
        torch.testing.assert_close(read.load(view), expected, rtol=0, atol=0)
    assert data.open(tmp_path / "poses_bounds.npy").names == read.names


def test_reduced_images_take_their_own_camera(scene, tmp_path):
    rows = llff_rows(scene, 4 * FOCAL)
    rows[:, 4], rows[:, 9] = 4 * 48 + 3, 4 * 64 - 2  # the originals' sides are no multiple of four
    read = data.open(write(scene, tmp_path, "images_4", rows))
    check_poses(read, scene)
    focal = [4 * FOCAL * 64 / 254, 4 * FOCAL * 48 / 195]
    expected = np.array([[focal[0], 0, 31.5], [0, focal[1], 23.5], [0, 0, 1]])
    np.testing.assert_allclose(read.cameras.intrinsics[3].numpy(), expected, rtol=1e-14)


def test_images_may_differ_in_size(scene, tmp_path):
    write(scene, tmp_path)
    Image.fromarray(np.repeat(np.repeat(scene.images[1], 2, 0), 2, 1)).save(tmp_path / "images" / scene.names[1])
    read = data.open(tmp_path)
    assert [read.size(view) for view in (0, 1)] == [(48, 64), (96, 128)]
    expected = np.array([[2 * FOCAL, 0, 63.5], [0, 2 * FOCAL, 47.5], [0, 0, 1]])
    np.testing.assert_array_equal(read.cameras.intrinsics[1].numpy(), expected)


def test_images_go_before_reduced_ones(scene, tmp_path):
    write(scene, tmp_path)
    (tmp_path / "images_4").mkdir()
    assert data.open(tmp_path).paths[0].parent.name == "images"


def changed(scene, **columns):
    rows = llff_rows(scene, FOCAL)
    for column, value in columns.items():
        rows[1, int(column[1:])] = value
    return rows


def mirrored(scene):
    rows = llff_rows(scene, FOCAL)
    rows[1, [1, 6, 11]] *= -1
    return rows


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        (lambda s: llff_rows(s, FOCAL)[:4], "has 4 rows, and 5 images are in 'images'"),
        (lambda s: llff_rows(s, FOCAL)[:, :15], r"rows of 17 numbers; got an array of \(5, 15\)"),
        (lambda s: llff_rows(s, FOCAL)[0], r"rows of 17 numbers; got an array of \(17,\)"),
        (lambda s: llff_rows(s, FOCAL)[:0], "rows of 17 numbers"),
        (lambda s: llff_rows(s, FOCAL).astype(np.int64), "must hold float32 or float64; got int64"),
        (lambda s: llff_rows(s, FOCAL).astype(np.float16), "float32 or float64"),
        (lambda s: changed(s, c3=np.nan), "not finite"),
        (lambda s: changed(s, c14=-3.0), "focal length of -3 is no valid camera"),
        (lambda s: changed(s, c4=0.0), "is no valid camera"),
        (lambda s: changed(s, c4=64.0, c9=48.0), "another shape"),
        (mirrored, "row 1: the rotation is mirrored"),
    ],
)
def test_rows_that_make_no_sense_are_refused(scene, tmp_path, rows, match):
    with pytest.raises(DataError, match=match):
        data.open(write(scene, tmp_path, rows=rows(scene)))


def test_a_folder_without_images_is_refused(scene, tmp_path):
    np.save(tmp_path / "poses_bounds.npy", llff_rows(scene, FOCAL))
    with pytest.raises(DataError, match="has 5 rows, and no folder images holds an image"):
        data.open(tmp_path)
