"""Learnt models on scenes: what a similarity moves away comes back, and what a model says lands where it belongs."""

import json
import re

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import VoxelGrid, cli, data
from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.classical import extract_mesh
from lsmgeo.data import Recipe
from lsmgeo.data.shards.shape_sources import Synthetic13
from lsmgeo.errors import OptionError
from lsmgeo.models import DepthResult, VoxelResult, create, write_weights
from lsmgeo.reconstruct.learnt_method import learnt_results, predict_scene
from lsmgeo.reconstruct.object_frame import crop_view, estimate_object_box, frame_of_box, in_model_frame, spread_views


def rotation(axis, degrees):
    """By the formula of Rodrigues."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


# About a level axis: what is up tells all of it.
MOVED = np.eye(4)
MOVED[:3, :3] = 7.0 * rotation((0.6, 0.0, -0.8), 70.0)
MOVED[:3, 3] = 30.0, -200.0, 5.0


def write_scene(folder, sample, matrix=MOVED, *, alpha=True):
    """A sample's views as a scene whose world is another, by a similarity."""
    (folder / "images").mkdir(parents=True)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    R, t = matrix[:3, :3] / scale, matrix[:3, 3]
    cameras = []
    for view, (image, mask) in enumerate(zip(sample.images, sample.mask, strict=True)):
        K, E = (part[view].double().numpy() for part in sample.cameras[:2])
        pixels = torch.cat((image, mask[None].float())).mul(255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels if alpha else np.ascontiguousarray(pixels[..., :3])).save(
            folder / "images" / f"{view}.png"
        )
        moved = np.eye(4)
        moved[:3, :3] = E[:3, :3] @ R.T
        moved[:3, 3] = scale * E[:3, 3] - moved[:3, :3] @ t
        entry = {"file": f"images/{view}.png", "width": image.shape[2], "height": image.shape[1]}
        cameras.append(entry | {"K": K.tolist(), "cam_from_world": moved.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    return folder


def moved(points, matrix=MOVED):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.fixture(scope="module")
def sample():
    """A chair, pictures as files hold them."""
    made = Synthetic13(13).render(4, Recipe(0, 6, 32, (16,))).sample
    return made._replace(images=(made.images * 255).round() / 255)


@pytest.fixture(scope="module")
def folder(sample, tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("chair") / "scene", sample)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights")
    names = ("voxel-lsm", "depth-lsm", "r2n2")
    return {name: write_weights(path / f"{name}.safetensors", create(name, preset="tiny")) for name in names}


def batch_of(sample, views):
    cameras = CameraTensors(*(torch.as_tensor(part)[None, list(views)] for part in sample.cameras))
    return sample.images[None, list(views)], cameras


def test_a_moved_scene_gives_the_occupancies_of_the_models_own_frame(sample, folder):
    torch.manual_seed(0)
    model = create("voxel-lsm", preset="tiny")
    found = predict_scene(data.open(folder), model)
    assert sorted(found.views) == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(found.frame.scene_from_model().numpy(), MOVED, atol=1e-5)
    expected = model.run(*batch_of(sample, found.views)).occupancy
    torch.testing.assert_close(found.result.occupancy, expected, rtol=1e-4, atol=1e-5)
    assert expected.std() > 1e-3
    # A frame that is off would be noticed.
    off = model.run(sample.images[None], orbit(torch.zeros(1, 6), 0.0, 2.0, focal_length=60.0, height=32, width=32))
    assert (off.occupancy - expected).abs().max() > 1e-2


def test_voxels_come_back_into_the_scene(sample, folder, weights, monkeypatch):
    """A model that says the truth."""
    truth = sample.occupancy.float()
    monkeypatch.setattr(
        "lsmgeo.models.voxel_lsm.VoxelLSM.run", lambda self, *given, **options: VoxelResult(truth[None], None)
    )
    scene = data.open(folder)
    results = learnt_results(scene, 2, "chair", method="v-lsm", weights=weights["voxel-lsm"], resolution=16)
    expected = moved(extract_mesh(truth, VoxelGrid(16), level=0.4).vertices)
    assert results.views[0].view == 2
    found = results.mesh.vertices
    # Specks are dropped, nothing is added.
    distances = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(1)
    assert len(found) > 0.8 * len(expected)
    assert distances.max() < 1e-3
    for one in results.views:
        mask, on = sample.mask[one.view], one.depth > 0
        assert (mask & on).sum() > 0.6 * (mask | on).sum()
        both = mask & on
        # Voxels are 1/16 of 7.
        assert (one.depth[both] - 7 * sample.depth[one.view][both]).abs().median() < 7 / 16
        assert one.confidence[on].min() > 0.1
        assert one.confidence[on].mean() > 2 * one.confidence[~on].mean()
    # The chair has its colours.
    assert results.mesh.colours.std() > 5


def test_depth_comes_back_into_the_scene(sample, folder, weights, monkeypatch):
    """A model that says the truth on the object, and anything off it."""
    read = []

    def run(self, images, cameras, **options):
        depth = torch.stack([sample.depth[view] for view in read[0]])
        return DepthResult(torch.where(depth > 0, depth, 2.1)[None], None)

    def spread(*arguments):
        read.append(spread_views(*arguments))
        return read[0]

    monkeypatch.setattr("lsmgeo.models.depth_lsm.DepthLSM.run", run)
    monkeypatch.setattr("lsmgeo.reconstruct.learnt_method.spread_views", spread)
    scene = data.open(folder)
    results = learnt_results(scene, None, "chair", method="d-lsm", weights=weights["depth-lsm"], resolution=64)
    for one in results.views:
        torch.testing.assert_close(one.depth, 7 * sample.depth[one.view], rtol=1e-5, atol=1e-5)
    # Points, seen in a camera by this file's own arithmetic, have the depth that they were made from.
    K, E = (part[read[0][0]].double().numpy() for part in sample.cameras[:2])
    inverse = np.linalg.inv(MOVED)
    points = moved(results.points.astype(float), inverse)
    assert len(points) > 200
    seen = points @ E[:3, :3].T + E[:3, 3]
    pixels = np.rint(seen @ K.T / seen[:, 2:])[:, :2].astype(int)
    depth = sample.depth[read[0][0]].numpy()[pixels[:, 1].clip(0, 31), pixels[:, 0].clip(0, 31)]
    own = np.abs(seen[:, 2] - depth) < 1e-4
    assert own.sum() >= (results.views[0].confidence > 0).sum() > 50
    vertices = moved(results.mesh.vertices.astype(float), inverse)
    distances = np.linalg.norm(vertices[:, None] - points[None], axis=-1).min(1)
    assert np.median(distances) < 0.05
    assert results.notes == ()


def test_windows_keep_geometry():
    """A picture of a ramp, cut, padded and resized: every pixel shows what its camera says."""
    rng = np.random.default_rng(0)

    class Scene:
        cut_out = False

        def __init__(self, size, K):
            self.height, self.width = size
            look = orbit(30.0, 20.0, 5.0, focal_length=1.0, height=4, width=4, target=(1.0, 2.0, 3.0))
            E = look.cam_from_world.double()
            self.cameras = CameraTensors(
                torch.tensor(K, dtype=torch.float64)[None], E[None], *(torch.tensor([side]) for side in size)
            )

        def camera(self, view):
            return CameraTensors(*(part[view] for part in self.cameras))

        def load(self, view):
            y, x = np.mgrid[: self.height, : self.width]
            ramp = np.stack([0.1 + 0.8 * x / self.width, 0.1 + 0.8 * y / self.height, np.full(x.shape, 0.5)])
            return torch.from_numpy(ramp).float()

    for focal, middle, size in (((150.0, 170.0), (90.0, 50.0), (120, 160)), ((60.0, 60.0), (10.0, 33.0), (70, 60))):
        K = [[focal[0], 0.7, middle[0]], [0.0, focal[1], middle[1]], [0.0, 0.0, 1.0]]
        scene = Scene(size, K)
        frame = frame_of_box(scene, (1.1, 2.0, 2.9, 2.0))
        framed = crop_view(scene, 0, frame, 24)
        assert framed.image.shape == (3, 24, 24)
        # The cube's middle is in the middle, as large as in training.
        camera = in_model_frame(framed.camera, frame)
        pixel = camera.intrinsics @ camera.cam_from_world[:3, 3]
        pixel = (pixel / pixel[2])[:2].numpy()
        np.testing.assert_allclose(pixel, 11.5, atol=0.5)
        depth = float(camera.cam_from_world[2, 3])
        assert float(camera.intrinsics[0, 0]) == pytest.approx(24 * depth / (16 / 15), rel=0.03)
        to_old = np.array(K) @ np.linalg.inv(framed.camera.intrinsics.numpy())
        checked = 0
        for y, x in rng.integers(0, 24, (200, 2)):
            u, v, _ = to_old @ (x, y, 1.0)
            if 4 < u < size[1] - 5 and 4 < v < size[0] - 5:
                expected = [0.1 + 0.8 * u / size[1], 0.1 + 0.8 * v / size[0], 0.5]
                np.testing.assert_allclose(framed.image[:, y, x].numpy(), expected, atol=2e-3)
                checked += 1
            elif u < -4 or v < -4 or u > size[1] + 3 or v > size[0] + 3:
                assert framed.image[:, y, x].tolist() == [1.0, 1.0, 1.0]
                assert not framed.inside[y, x]
        assert checked > 20


def scene_of(cameras, points=None):
    """What placing asks a scene."""

    class Scene:
        pass

    scene = Scene()
    scene.cameras, scene.points = cameras, None
    if points is not None:
        scene.points = data.SparsePoints(points, np.zeros((len(points), 3), np.uint8), ())
    type(scene).__len__ = lambda self: len(cameras.intrinsics)
    return scene


def around(azimuth, elevation, distance=2.0, target=(0.0, 0.0, 0.0), focal=1.875):
    azimuth = torch.tensor(azimuth, dtype=torch.float64)
    elevation = torch.tensor(elevation, dtype=torch.float64)
    return orbit(azimuth, elevation, distance, focal_length=100.0 * focal, height=100, width=100, target=target)


def turned_by(cameras, R):
    E = cameras.cam_from_world.clone()
    E[:, :3, :3] = E[:, :3, :3] @ torch.from_numpy(R.T)
    return cameras._replace(cam_from_world=E)


def test_up_is_told_by_the_cameras():
    for seed, cameras in enumerate([around([0.0, 80.0, 200.0], [10.0, -20.0, 30.0]), around([5.0, 6.0], [0.0, 0.0])]):
        for axis, degrees in (((1, 0, 0), 90), ((0, 0, 1), 180), ((1, 2, -1), 130)):
            R = rotation(axis, degrees)
            found = frame_of_box(scene_of(turned_by(cameras, R)), (0, 0, 0, 1)).rotation
            np.testing.assert_allclose(found @ R @ (0, 1, 0), (0, 1, 0), atol=1e-9, err_msg=f"{seed} {axis}")
            np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame_of_box(scene_of(cameras), (0, 0, 0, 1)).rotation, np.eye(3), atol=1e-9)


def test_the_object_is_told_by_points_then_by_where_cameras_look():
    rng = np.random.default_rng(0)
    target, spun = np.array([3.0, 1.0, -2.0]), rotation((0, 1, 0), 30)
    cameras = around([0.0, 70.0, 150.0, 260.0], [10.0, 20.0, -5.0, 15.0], 9.0, tuple(target))
    inside = target + (rng.random((4000, 3)) - 0.5) * (3.0, 0.5, 1.0) @ spun.T
    beyond = target + rng.normal(size=(500, 3)) * 40
    by_points = estimate_object_box(scene_of(cameras, np.concatenate([inside, beyond])), None, range(4))
    assert by_points.inferred_from == "sparse points"
    np.testing.assert_allclose(by_points.center, target, atol=0.15)
    assert by_points.side == pytest.approx(np.sqrt(3.0**2 + 0.5**2 + 1.0), rel=0.1)
    # Its box stands along the axes again.
    corner = by_points.rotation @ spun
    np.testing.assert_allclose(np.sort(np.abs(corner).max(0)), 1.0, atol=5e-3)
    by_cameras = estimate_object_box(scene_of(cameras), None, range(4))
    assert by_cameras.inferred_from == "the point that the cameras look at"
    np.testing.assert_allclose(by_cameras.center, target, atol=1e-9)
    assert by_cameras.side == pytest.approx(4.5)  # at a distance of 2 sides, as in training
    with pytest.raises(OptionError, match="give box"):
        estimate_object_box(scene_of(around([10.0], [10.0])), None, range(1))


def test_views_are_from_all_around():
    cameras = around([0.0, 5.0, 10.0, 90.0, 95.0, 180.0, 185.0, 270.0], [0.0] * 8)
    scene = scene_of(cameras)
    frame = frame_of_box(scene, (0, 0, 0, 1))
    assert spread_views(scene, frame, range(8), 2) == [0, 5]
    chosen = spread_views(scene, frame, [3, 0, 1, 2, 5, 7], 4)
    assert chosen[:2] == [3, 7]
    assert sorted(chosen) == [0, 3, 5, 7]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": None}, "method v-lsm needs weights"),
        ({"weights": "depth-lsm"}, "needs weights of a voxel-lsm; .* holds those of a depth-lsm: use method d-lsm"),
        ({"weights": "r2n2"}, "holds those of a r2n2: no method of reconstruct uses these"),
        ({"method": "d-lsm"}, "needs weights of a depth-lsm; .* use method v-lsm"),
        ({"box": "0,0,1"}, "box must be x,y,z,side"),
        ({"box": "0,0,0,-1"}, "box must be x,y,z,side"),
        ({"box": "900,0,0,1"}, "no image shows the centre of the object"),
        ({"threshold": 1.0}, "threshold must be a number between 0 and 1"),
        ({"views": 0}, "views must be a whole number"),
        ({"background": "1,a,0"}, "three numbers such as"),
    ],
)
def test_what_cannot_be_done_is_named(folder, weights, options, message):
    options = {"method": "v-lsm", "weights": "voxel-lsm"} | options
    options["weights"] = weights.get(options["weights"])
    with pytest.raises(OptionError, match=message):
        learnt_results(data.open(folder), None, "chair", **options)


def test_without_silhouettes_a_warning_and_the_cameras_word(sample, tmp_path, weights):
    scene = data.open(write_scene(tmp_path / "scene", sample, alpha=False))
    found = predict_scene(scene, create("voxel-lsm", preset="tiny"), views=3)
    assert len(found.views) == 3
    assert "No silhouettes" in found.notes[0]
    assert found.frame.inferred_from == "the point that the cameras look at"
    np.testing.assert_allclose(found.frame.scene_from_model().numpy(), MOVED, atol=1e-4)
    far = predict_scene(scene, create("voxel-lsm", preset="tiny"), views=3, box=(30.0, -200.0, 5.0, 1.0))
    assert "14.0 sizes of the object away" in far.notes[1]
    # By the colour behind it the object is told, and nothing is to be warned of.
    found = predict_scene(scene, create("voxel-lsm", preset="tiny"), views=3, background="white")
    assert found.notes == ()
    assert found.frame.inferred_from == "silhouettes and cameras"


@pytest.mark.parametrize("method", ["v-lsm", "d-lsm"])
def test_the_command_leaves_what_the_classical_methods_leave(folder, weights, tmp_path, capsys, method):
    name = {"v-lsm": "voxel-lsm", "d-lsm": "depth-lsm"}[method]
    out = tmp_path / "out"
    arguments = ["reconstruct", str(folder), "--method", method, "--weights", str(weights[name]), "--out", str(out)]
    assert cli.main([*arguments, "--views", "3", "--resolution", "32", "--threshold", "0.3", "--view", "1"]) in (0, 1)
    printed = capsys.readouterr().out
    assert f"model:       {name}" in printed
    assert re.search(r"views: +3: 1, \d, \d", printed)
    assert {"report.html", "summary.png", "cameras.json", "images", "depth", "pictures"} <= {
        path.name for path in out.iterdir()
    }
    again = data.open(out)
    assert len(again) == 3
    first = again.cameras.cam_from_world[0]
    torch.testing.assert_close(first, data.open(folder).cameras.cam_from_world[1], rtol=1e-9, atol=1e-9)
    assert cli.main([*arguments[:-4], "--out", str(out)]) == 2
    assert "needs weights" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "validation", "words"),
    [
        (
            "voxel-lsm",
            {"step": 40, "measure": "iou", "by_view": [0.3, 0.21]},
            "IoU is 21 % on the validation split at step 40",
        ),
        ("voxel-lsm", {"step": 40, "measure": "iou", "by_view": [0.2, 0.31]}, None),
        ("depth-lsm", {"step": 7, "measure": "depth_error", "by_view": [0.25]}, "depth error is 0.25"),
        ("depth-lsm", {"step": 7, "measure": "depth_error", "by_view": [0.05]}, None),
        ("voxel-lsm", {"measure": "iou"}, None),
        ("voxel-lsm", None, None),
    ],
)
def test_a_network_that_is_barely_trained_is_warned_of(folder, tmp_path, name, validation, words):
    about = {} if validation is None else {"validation": validation}
    path = write_weights(tmp_path / "weights.safetensors", create(name, preset="tiny"), about=about)
    method = {"voxel-lsm": "v-lsm", "depth-lsm": "d-lsm"}[name]
    notes = learnt_results(data.open(folder), None, "chair", method=method, weights=path, views=2, resolution=16).notes
    barely = [note for note in notes if "barely trained" in note]
    assert len(barely) == (words is not None)
    assert all(words in note for note in barely)
