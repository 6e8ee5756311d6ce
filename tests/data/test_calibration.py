"""OpenCV's calibrations read back as OpenCV and hand-written text state them."""

import cv2
import numpy as np
import pytest
from PIL import Image

from lsmgeo import data

K1 = np.array([[534.25, 0, 336.5], [0, 533.75, 240.125], [0, 0, 1]])
K2 = np.array([[530.5, 0, 330.25], [0, 531.5, 241.75], [0, 0, 1]])
D1, D2 = np.array([[-0.27, -0.04, 0.0018, -0.0003, 0.24]]), np.array([[-0.28, 0.05, 0.001, 0.0002]])
R = cv2.Rodrigues(np.array([0.02, -0.05, 0.1]))[0]
T = np.array([[-3.3], [0.04], [0.01]])
VIEWS = np.arange(18, dtype=np.float64).reshape(3, 6) / 7

YAML = """%YAML:1.0
---
calibration_time: "Sun Nov 22 14:15:05 2026"
nframes: 3
image_width: 640
image_height: 480
board_width: 9
board_height: 6
square_size: 2.5e-02
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 534.25, 0., 336.5, 0., 533.75, 240.125, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.27, -0.04, 0.0018,
       -0.0003, 0.24 ]
extrinsic_parameters: !!opencv-matrix
   rows: 2
   cols: 6
   dt: d
   data: [ 0.1, 0.2, 0.3, 1., 2., 3., -0.1, -0.2, -0.3, 4., 5., 6. ]
"""


def write_storage(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        if isinstance(value, list):
            storage.startWriteStruct(name, cv2.FileNode_SEQ)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            storage.write(name, value)
    storage.release()


def write_rig(folder, ending="yml", images=3):
    """Lenses, rig and a list of images in three files, as OpenCV's sample leaves them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_storage(folder / f"intrinsics.{ending}", M1=K1, D1=D1, M2=K2, D2=D2)
    names = [f"{side}{number:02d}.png" for number in range(images) for side in ("left", "right")]
    # A JSON file without a matrix could be anybody's.
    more = {"images": names} if ending == "json" else {}
    write_storage(folder / f"extrinsics.{ending}", R=R, T=T, R1=np.eye(3), P1=np.eye(3, 4), Q=np.eye(4), **more)
    if not more:
        write_storage(folder / f"list.{ending}", images=names)
    for name in names:
        Image.new("RGB", (8, 6)).save(folder / name)
    return folder


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml", "json"])
def test_the_files_of_a_rig_read_back(tmp_path, ending):
    folder = write_rig(tmp_path, ending)
    found = data.detect(folder)
    assert (found.name, found.kind) == ("opencv", "calibration")
    read = found.read(folder)
    assert set(read.lenses) == {"first", "second"}
    for name, K, D in (("first", K1, D1), ("second", K2, D2)):
        lens = read.lenses[name]
        np.testing.assert_allclose(lens.intrinsics, K, rtol=1e-15)
        np.testing.assert_allclose(lens.coefficients, D[0], rtol=1e-15)
        assert (lens.kind, lens.size, lens.views) == ("perspective", None, None)
        assert lens.sized(480, 640).height == 480
    np.testing.assert_allclose(read.rig.rotation, R, atol=1e-15)
    np.testing.assert_allclose(read.rig.translation, T[:, 0], atol=1e-15)
    assert read.board is None
    assert [[path.name for path in side] for side in read.images] == [
        ["left00.png", "left01.png", "left02.png"], ["right00.png", "right01.png", "right02.png"]
    ]  # fmt: skip
    alone = data.read_calibration(folder / f"intrinsics.{ending}")
    assert (set(alone.lenses), alone.rig, alone.images) == ({"first", "second"}, None, ())


def test_a_single_camera_reads_back_from_text(tmp_path):
    (tmp_path / "left.yml").write_text(YAML)
    read = data.read_calibration(tmp_path)
    lens = read.lenses["left"]
    np.testing.assert_array_equal(lens.intrinsics, K1)
    assert lens.coefficients == (-0.27, -0.04, 0.0018, -0.0003, 0.24)
    assert lens.size == (480, 640)
    np.testing.assert_array_equal(lens.views, [[0.1, 0.2, 0.3, 1, 2, 3], [-0.1, -0.2, -0.3, 4, 5, 6]])
    assert read.board == data.Board((9, 6), 0.025)


def test_base64_and_older_names_read_back(tmp_path):
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_BASE64
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), flags)
    for name, value in (("Camera_Matrix", K1), ("Distortion_Coefficients", D1), ("Extrinsic_Parameters", VIEWS)):
        storage.write(name, value)
    storage.write("image_Width", 640)
    storage.write("image_Height", 480)
    storage.release()
    assert "!!binary" in (tmp_path / "a.yml").read_text()
    lens = data.read_calibration(tmp_path / "a.yml").lenses["a"]
    np.testing.assert_array_equal(lens.intrinsics, K1)
    np.testing.assert_array_equal(lens.views, VIEWS)
    assert lens.size == (480, 640)


def test_a_fisheye_has_four_coefficients(tmp_path):
    write_storage(tmp_path / "a.json", K=K1, D=np.array([0.1, 0.02, 0.003, 0.0004]), fisheye_model=1)
    lens = data.read_calibration(tmp_path).lenses["a"]
    assert lens.kind == "fisheye"
    assert lens.coefficients == (0.1, 0.02, 0.003, 0.0004)


def test_a_rotation_vector_is_a_rotation(tmp_path):
    write_storage(tmp_path / "a.xml", R=np.array([0.02, -0.05, 0.1]), T=T.T)
    np.testing.assert_allclose(data.read_calibration(tmp_path).rig.rotation, R, atol=1e-15)


def test_images_that_are_not_there_are_left_out_with_their_partner(tmp_path):
    folder = write_rig(tmp_path)
    (folder / "right01.png").unlink()
    images = data.read_calibration(folder).images
    assert [[path.name for path in side] for side in images] == [
        ["left00.png", "left02.png"], ["right00.png", "right02.png"]
    ]  # fmt: skip
    for file in folder.glob("*.png"):
        file.unlink()
    assert data.read_calibration(folder).images == ()


def test_the_images_of_one_camera_are_one_list(tmp_path):
    write_storage(tmp_path / "list.yml", images=[f"view{number}.jpg" for number in range(4)], K=K1)
    for number in (0, 1, 3):
        Image.new("RGB", (8, 6)).save(tmp_path / f"view{number}.jpg")
    images = data.read_calibration(tmp_path / "list.yml").images
    assert [[path.name for path in side] for side in images] == [["view0.jpg", "view1.jpg", "view3.jpg"]]
