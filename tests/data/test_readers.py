"""The readers give back what an independent writer wrote, in our conventions."""

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import data
from lsmgeo.data.images import image_size
from lsmgeo.errors import DataError
from tests.data.posed_writers import check_scene
from tests.data.writers import make_scene, project, write_colmap, write_middlebury


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def test_a_middlebury_folder_reads_back(scene, tmp_path):
    read = data.open(write_middlebury(scene, tmp_path))
    assert read.source == "middlebury"
    assert read.names == ("v0.png", "v1.png", "v2.png", "v4.png", "view_3.png")
    assert read.points is None
    check_scene(read, scene, scene.images)
    assert data.open(tmp_path / "scene_par.txt").names == read.names


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("sparse", [".", "sparse", "sparse/0"])
def test_a_colmap_model_reads_back(scene, tmp_path, form, sparse):
    read = data.open(write_colmap(scene, tmp_path, form=form, sparse=sparse))
    assert read.source == "colmap"
    assert read.names == tuple(scene.names)
    check_scene(read, scene, scene.images)
    np.testing.assert_allclose(read.points.positions, scene.points, rtol=0, atol=0)
    np.testing.assert_array_equal(read.points.colours, scene.colours)
    for view, observed in enumerate(read.points.observations):
        assert sorted(observed.points) == list(range(len(scene.points)))
        np.testing.assert_allclose(observed.pixels, project(scene, view)[observed.points], atol=1e-9)


def test_a_simple_pinhole_camera_has_one_focal_length(scene, tmp_path):
    write_colmap(scene, tmp_path, form="text")
    cameras = "\n".join(f"{index} SIMPLE_PINHOLE 96 72 100 48 36" for index in range(1, 6))
    (tmp_path / "sparse/0/cameras.txt").write_text(cameras)
    read = data.read_colmap(tmp_path)
    expected = torch.tensor([[100, 0, 47.5], [0, 100, 35.5], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(read.cameras.intrinsics[3], expected, rtol=0, atol=0)


def test_an_image_may_observe_nothing(scene, tmp_path):
    write_colmap(scene, tmp_path, form="text")
    file = tmp_path / "sparse/0/images.txt"
    lines = file.read_text().splitlines()
    lines[3] = ""  # the observations of the first record, which is the last image
    file.write_text("\n".join(lines) + "\n")
    counts = [len(observed.points) for observed in data.open(tmp_path).points.observations]
    assert counts == [42, 42, 42, 42, 0]


def test_an_image_of_another_size_than_its_camera_is_refused(scene, tmp_path):
    read = data.open(write_colmap(scene, tmp_path, form="binary"))
    Image.fromarray(scene.images[1][:, :50]).save(read.paths[1])
    with pytest.raises(DataError, match=r"50 x 72 .* expects 96 x 72"):
        read.load(1)


def test_an_image_of_24_megapixels_reads_back(tmp_path):
    path = tmp_path / "image.jpg"
    Image.new("RGB", (6048, 4032), (255, 255, 255)).save(path)
    assert image_size(path) == (4032, 6048)
    image = data.read_image(path, (4032, 6048))
    assert image.shape == (4032, 6048, 3)
    assert int(image[-1, -1].min()) == 255


def test_a_point_cloud_reads_back_and_leaves_nothing_else(tmp_path):
    import trimesh

    positions = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    colours = np.random.default_rng(1).integers(0, 256, (20, 3), dtype=np.uint8)
    path = data.write_point_cloud(tmp_path / "new" / "points.ply", positions, colours)
    read = trimesh.load(path)
    np.testing.assert_allclose(read.vertices, positions, rtol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], colours)
    assert [file.name for file in path.parent.iterdir()] == ["points.ply"]


@pytest.mark.parametrize("step", ["os.open", "os.write", "os.fsync", "pathlib.Path.replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, step, error):
    def fail(*_, **__):
        raise error

    path = data.write_atomic(tmp_path / "result", b"old")
    monkeypatch.setattr(step, fail)
    expected = "No space left" if isinstance(error, OSError) else None
    with pytest.raises(DataError if expected else KeyboardInterrupt, match=expected):
        data.write_atomic(path, b"new and longer")
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


@pytest.mark.parametrize(
    ("positions", "colours"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), np.uint8)),
        (np.zeros((2, 2)), np.zeros((2, 2), np.uint8)),
        (np.zeros((2, 3)), np.zeros((3, 3), np.uint8)),
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.full((2, 3), np.nan), np.zeros((2, 3), np.uint8)),
    ],
)
def test_a_point_cloud_that_makes_no_sense_is_refused(tmp_path, positions, colours):
    with pytest.raises(DataError):
        data.write_point_cloud(tmp_path / "points.ply", positions, colours)
    assert list(tmp_path.iterdir()) == []


def test_the_reason_why_a_folder_is_not_a_scene(scene, tmp_path):
    def refused(path, match):
        with pytest.raises(DataError, match=match):
            data.open(path)

    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "is empty")
    (tmp_path / "images").mkdir()
    Image.fromarray(scene.images[0]).save(tmp_path / "images" / "a.png")
    refused(tmp_path / "images", "holds images but no file of cameras; cameras are read from a Middlebury")
    refused(tmp_path / "images" / "a.png", "is an image; pass the folder of its cameras")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("nothing")
    refused(tmp_path / "other", "holds no known format; cameras are read from")
    chair = tmp_path / "tree" / "renders" / "03001627" / "chair"
    chair.mkdir(parents=True)
    (chair / "camera_0.mat").write_bytes(b"")
    refused(tmp_path / "tree", "is a tree of many objects; pass one of them, such as .*chair, or convert")


def test_a_scene_is_shown_in_a_line(scene, tmp_path):
    read = data.open(write_colmap(scene, tmp_path, form="binary"))
    assert repr(read) == "<PosedImages: 5 x 96 x 72, colmap, points>"
