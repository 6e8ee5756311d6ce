"""COLMAP models of every camera, written by COLMAP itself, and ours read by it."""

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.writers import make_scene

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap writes the models")

# Parameters of a 96 x 72 camera; lens kind and coefficients as OpenCV has them, None where there is nothing to undo.
MODELS = {
    "SIMPLE_PINHOLE": ([151.0, 47.2, 37.1], None),
    "PINHOLE": ([151.0, 154.0, 47.2, 37.1], None),
    "SIMPLE_RADIAL": ([151.0, 47.2, 37.1, -0.15], ("perspective", (-0.15, 0, 0, 0))),
    "RADIAL": ([151.0, 47.2, 37.1, -0.15, 0.05], ("perspective", (-0.15, 0.05, 0, 0))),
    "OPENCV": ([151.0, 154.0, 47.2, 37.1, 0.2, -0.05, 0.004, -0.003], ("perspective", (0.2, -0.05, 0.004, -0.003))),
    "FULL_OPENCV": (
        [151.0, 154.0, 47.2, 37.1, 0.3, 0.03, 0.002, -0.003, 0.01, 0.4, 0.02, 0.01],
        ("perspective", (0.3, 0.03, 0.002, -0.003, 0.01, 0.4, 0.02, 0.01)),
    ),
    "SIMPLE_FISHEYE": ([151.0, 47.2, 37.1], ("fisheye", (0, 0, 0, 0))),
    "FISHEYE": ([151.0, 154.0, 47.2, 37.1], ("fisheye", (0, 0, 0, 0))),
    "SIMPLE_RADIAL_FISHEYE": ([151.0, 47.2, 37.1, 0.1], ("fisheye", (0.1, 0, 0, 0))),
    "RADIAL_FISHEYE": ([151.0, 47.2, 37.1, 0.1, -0.2], ("fisheye", (0.1, -0.2, 0, 0))),
    "OPENCV_FISHEYE": (
        [151.0, 154.0, 47.2, 37.1, 0.1, -0.2, 0.1, -0.05],
        ("fisheye", (0.1, -0.2, 0.1, -0.05)),
    ),
}
# The images' sizes: they differ, and K is the same.
SIZES = [(72, 96), (69, 91), (72, 88), (65, 96), (70, 94)]


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def write(scene, folder, model, parameters, form):
    """The scene as COLMAP writes it: a camera and a rig for each image, in an order of its own."""
    made = pycolmap.Reconstruction()
    seen = []
    for view in (3, 1, 0, 4, 2):
        height, width = SIZES[view]
        camera = pycolmap.Camera(model=model, width=width, height=height, params=parameters, camera_id=view + 3)
        made.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(scene.R[view]), scene.t[view])
        pixels = np.array([camera.img_from_cam(point @ scene.R[view].T + scene.t[view]) for point in scene.points])
        shown = np.flatnonzero((pixels > 0).all(1) & (pixels < (width, height)).all(1))
        image = pycolmap.Image(
            name=scene.names[view].replace(" ", "_"), keypoints=pixels[shown], camera_id=view + 3, image_id=view + 7
        )
        made.add_image_with_trivial_frame(image, pose)
        seen.append((view, shown))
    for point, (position, colour) in enumerate(zip(scene.points, scene.colours, strict=True)):
        track = pycolmap.Track()
        for view, shown in seen:
            for index in np.flatnonzero(shown == point):
                track.add_element(view + 7, int(index))
        made.add_point3D(position, track, colour)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (made.write_binary if form == "bin" else made.write_text)(str(sparse))
    assert (sparse / f"rigs.{form}").is_file()
    (folder / "images").mkdir()
    for view, (height, width) in enumerate(SIZES):
        Image.fromarray(scene.images[view][:height, :width]).save(
            folder / "images" / scene.names[view].replace(" ", "_")
        )
    return made


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("model", MODELS)
def test_every_camera_reads_back(scene, tmp_path, model, form):
    parameters, lens = MODELS[model]
    made = write(scene, tmp_path, model, parameters, form)
    read = data.open(tmp_path)
    assert read.names == ("v0.png", "v1.png", "v2.png", "v4.png", "view_3.png")
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, :3].numpy(), scene.R, atol=1e-12)
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, 3].numpy(), scene.t, atol=1e-12)
    np.testing.assert_allclose(read.points.positions, scene.points, rtol=0, atol=0)
    np.testing.assert_array_equal(read.points.colours, scene.colours)
    fx, fy = parameters[0], parameters[0] if "SIMPLE" in model or model.startswith("RADIAL") else parameters[1]
    taken = np.array([[fx, 0, 46.7], [0, fy, 36.6], [0, 0, 1]])
    assert (read.lenses is None) == (lens is None)
    counts = []
    for view in range(5):
        assert read.size(view) == SIZES[view]
        assert read.load(view).shape == (3, *SIZES[view])
        K = read.cameras.intrinsics[view].numpy()
        if lens is None:
            np.testing.assert_allclose(K, taken, rtol=1e-14)
        else:
            assert (read.lenses[view].kind, read.lenses[view].coefficients) == lens
            np.testing.assert_allclose(read.lenses[view].intrinsics, taken, rtol=1e-14)
        points, pixels = read.points.observations[view]
        assert len(points) == len(made.image(view + 7).points2D)
        # What the straightened image shows is what a pinhole camera sees, and what COLMAP undoes.
        camera = (scene.points[points] @ scene.R[view].T + scene.t[view]) @ K.T
        np.testing.assert_allclose(pixels, camera[:, :2] / camera[:, 2:], atol=1e-7)
        keypoints = np.array([point.xy for point in made.image(view + 7).points2D])
        undone = np.column_stack([made.camera(view + 3).cam_from_img(keypoints), np.ones(len(keypoints))]) @ K.T
        order = np.array([point.point3D_id for point in made.image(view + 7).points2D]) - 1
        np.testing.assert_array_equal(order, points)
        np.testing.assert_allclose(pixels, undone[:, :2], atol=1e-7)
        counts.append(len(points))
    assert min(counts) > 15


def test_an_observation_that_cannot_be_straightened_is_left_out(scene, tmp_path):
    write(scene, tmp_path, "SIMPLE_RADIAL", MODELS["SIMPLE_RADIAL"][0], "txt")
    before = data.open(tmp_path).points.observations
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    row = next(index for index, line in enumerate(lines) if line.endswith("v1.png")) + 1
    x, _, point, rest = lines[row].split(maxsplit=3)
    lines[row] = f"{x} 999.5 {point} {rest}"
    file.write_text("\n".join(lines) + "\n")
    after = data.open(tmp_path).points.observations
    np.testing.assert_array_equal(after[1].points, before[1].points[1:])
    np.testing.assert_array_equal(after[1].pixels, before[1].pixels[1:])
    np.testing.assert_array_equal(after[0].points, before[0].points)


@pytest.mark.parametrize(
    ("model", "parameters"), [("SIMPLE_RADIAL", [151.0, 47, 37, 0.0]), ("OPENCV", [151.0, 150, 47, 37, 0, 0, 0, 0])]
)
def test_a_camera_without_distortion_needs_no_lens(scene, tmp_path, model, parameters):
    write(scene, tmp_path, model, parameters, "bin")
    read = data.open(tmp_path)
    assert read.lenses is None
    np.testing.assert_allclose(read.cameras.intrinsics[0, :2, 2].numpy(), [46.5, 36.5])


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("FOV", [151.0, 151.0, 47.2, 37.1, 0.3]),
        ("THIN_PRISM_FISHEYE", [151.0, 151.0, 47.2, 37.1] + 8 * [0.01]),
        ("DIVISION", [151.0, 151.0, 47.2, 37.1, -0.1]),
    ],
)
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_cameras_that_opencv_lacks_are_refused_by_name(scene, tmp_path, model, parameters, form):
    write(scene, tmp_path, model, parameters, form)
    with pytest.raises(DataError, match=f"camera model {model} does not exist in OpenCV; undistort first"):
        data.open(tmp_path)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("OPENCV", [30.0, 30, 48, 36, -0.9, 0, 0, 0]),
        ("FISHEYE", [20.0, 20, 48, 36]),
        ("OPENCV", [150.0, 150, 48, 36, 1e6, -1e6, 0, 0]),
    ],
)
def test_distortion_that_leaves_no_image_is_refused(scene, tmp_path, model, parameters):
    write(scene, tmp_path, "PINHOLE", [151.0, 154.0, 47.2, 37.1], "txt")
    file = tmp_path / "sparse" / "0" / "cameras.txt"
    numbers = " ".join(map(str, parameters))
    file.write_text("".join(f"{view + 3} {model} {w} {h} {numbers}\n" for view, (h, w) in enumerate(SIZES)))
    with pytest.raises(DataError, match="the distortion"):
        data.open(tmp_path)


def test_colmap_reads_what_is_written(scene, tmp_path):
    write(scene, tmp_path / "bent", "OPENCV", MODELS["OPENCV"][0], "bin")
    bent = data.open(tmp_path / "bent")
    folder = data.write_colmap(bent, tmp_path / "straight")
    read = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert read.is_valid()
    assert (read.num_images(), read.num_points3D()) == (5, len(scene.points))
    errors = []
    for view, name in enumerate(bent.names):
        image = read.find_image_with_name(name)
        camera = read.camera(image.camera_id)
        assert camera.model_name == "PINHOLE"
        assert (camera.height, camera.width) == SIZES[view]
        K = np.add(bent.cameras.intrinsics[view].numpy(), [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        np.testing.assert_allclose(camera.calibration_matrix(), K, rtol=1e-14)
        matrix = image.cam_from_world().matrix()
        np.testing.assert_allclose(matrix, bent.cameras.cam_from_world[view, :3].numpy(), atol=1e-12)
        assert len(image.points2D) == len(bent.points.observations[view].points)
        for point in image.points2D:
            seen = camera.img_from_cam(matrix @ [*read.point3D(point.point3D_id).xyz, 1.0])
            errors.append(np.linalg.norm(seen - point.xy))
        with Image.open(folder / "images" / name) as stored:
            found = torch.from_numpy(np.array(stored)).permute(2, 0, 1) / 255
        torch.testing.assert_close(found, bent.load(view), rtol=0, atol=0)
    assert max(errors) < 1e-7
    for number, colour in enumerate(scene.colours, 1):
        np.testing.assert_array_equal(read.point3D(number).color, colour)
