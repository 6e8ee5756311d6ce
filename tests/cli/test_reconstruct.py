"""``lsmgeo reconstruct`` on a plane known in closed form, from files in either format."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import cli, data
from lsmgeo.classical import DepthMap, default_depth_range, kept, reconstruct_view, select_neighbours
from lsmgeo.classical.plane_sweep import sweep
from lsmgeo.classical.views import common_point
from lsmgeo.errors import OptionError
from lsmgeo.grids import depth_planes
from tests.data.writers import make_scene, write_colmap, write_middlebury


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(scope="module", params=["middlebury", "text", "binary"])
def folder(request, scene, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param)
    if request.param == "middlebury":
        return write_middlebury(scene, path)
    return write_colmap(scene, path, form=request.param)


def read_picture(path):
    with Image.open(path) as picture:
        return np.array(picture)


def check_depth(depth, expected):
    """At least 30 % of the pixels, half of them within 0.1 % and 95 % within 1 %."""
    found = depth > 0
    assert found.mean() > 0.3
    errors = np.abs(depth - expected)[found] / expected[found]
    assert np.median(errors) < 1e-3
    assert np.quantile(errors, 0.95) < 1e-2


def read_results(out):
    """What a folder of results holds, read by code that shares nothing with the library: depth (V, h, w), entries."""
    entries = json.loads((out / "cameras.json").read_text())["cameras"]
    return [read_picture(out / entry["depth"]) * entry["depth_step"] for entry in entries], entries


FILES = ["cameras.json", "model.glb", "model.ply", "points.ply", "report.html", "summary.png"]
NORMAL = np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])


def test_one_view_is_swept_to_the_depth_of_the_scene(scene, folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["reconstruct", str(folder), "--method", "sweep", "--view", "1", "--out", str(out)]
    assert cli.main([*arguments, "--resolution", "96"]) == 0
    (depth,), (entry,) = read_results(out)
    check_depth(depth, scene.depth[1])
    np.testing.assert_allclose(entry["K"], scene.K[1], atol=1e-4)  # COLMAP's text keeps fewer digits
    np.testing.assert_allclose(np.array(entry["cam_from_world"])[:3, 3], scene.t[1], atol=1e-4)
    printed = capsys.readouterr().out
    is_colmap = "middlebury" not in folder.name
    assert ("depth error: median" in printed) == is_colmap
    assert sorted(path.name for path in out.iterdir() if path.is_file()) == FILES
    for name in ("model.glb", "points.ply", "report.html", "summary.png"):
        assert str((out / name).resolve()) in printed
    name = Path(entry["file"]).name
    assert read_picture(out / "pictures" / name).shape == (72, 96, 4)
    assert read_picture(out / "images" / name).shape == (72, 96, 3)
    assert min(read_picture(out / "summary.png").shape[:2]) > 300

    import trimesh

    for model in ("points.ply", "model.ply", "model.glb"):
        vertices = np.asarray(trimesh.load(out / model, force=None if "points" in model else "mesh").vertices)
        assert len(vertices) > 1000
        assert np.median(np.abs(vertices @ NORMAL)) < 2e-3


def test_all_views_are_swept_and_the_results_are_a_scene_again(scene, tmp_path, capsys):
    """By names with folders and blanks, of which two differ in capitals alone."""
    odd = scene._replace(names=["a/left.png", "a/Left.png", "b/left.png", "<b>&.png", "v 4.png"])
    for name in odd.names:
        (tmp_path / "scene" / "images" / name).parent.mkdir(parents=True, exist_ok=True)
    folder = write_colmap(odd, tmp_path / "scene", form="binary")
    out = tmp_path / "out"
    assert cli.main(["reconstruct", str(folder), "--out", str(out), "--resolution", "64"]) == 0
    depths, entries = read_results(out)
    images = [entry["photograph"] for entry in entries]
    assert sorted(images) == sorted(odd.names)
    assert len({Path(entry["file"]).name.lower() for entry in entries}) == 5
    for depth, image in zip(depths, images, strict=True):
        check_depth(depth, scene.depth[odd.names.index(image)])
    assert "&lt;b&gt;&amp;.png" in (out / "report.html").read_text()
    capsys.readouterr()
    # What is written agrees with itself where info measures it: depth of one view in another.
    assert cli.main(["info", str(out), "--out", str(tmp_path / "info")]) == 0
    assert "depth" in capsys.readouterr().out
    again = data.open(out)
    torch.testing.assert_close(again.load_depth(0).double(), torch.from_numpy(depths[0]), rtol=1e-6, atol=0)


def test_the_depth_range_and_the_planes_may_be_given(scene, folder, tmp_path):
    arguments = ["reconstruct", str(folder), "--view", "v0.png", "--out", str(tmp_path), "--resolution", "32"]
    assert cli.main([*arguments, "--near", "1.5", "--far", "2.6", "--planes", "48"]) == 0
    check_depth(read_results(tmp_path)[0][0], scene.depth[0])


def write_ball(folder, *, background=None, views=8):
    """A ball of radius 0.5 seen from all around: alpha, or before a colour."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    v, u = np.mgrid[:96, :128]
    rays = np.stack([(u - 63.5) / 150, (v - 47.5) / 150, np.ones_like(u)], -1)
    for view in range(views):
        angle, tilt = 2 * np.pi * view / views, 0.5 * (-1) ** view
        center = 2.5 * np.array([np.cos(angle) * np.cos(tilt), np.sin(tilt), np.sin(angle) * np.cos(tilt)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        directions = rays @ R
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        along = -(directions @ center)
        on = np.sum(center**2) - along**2 < 0.25
        picture = np.zeros((96, 128, 4), np.uint8)
        picture[on] = (200, 120, 40, 255)
        if background is not None:
            picture[~on] = (*background, 255)
        Image.fromarray(picture if background is None else picture[..., :3]).save(folder / f"{view}.png")
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = R, -R @ center
        K = [[150, 0, 63.5], [0, 150, 47.5], [0, 0, 1]]
        entries.append({"file": f"{view}.png", "width": 128, "height": 96, "K": K, "cam_from_world": E.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"cameras": entries}))
    return folder


@pytest.mark.parametrize("background", [None, (0, 0, 0)])
def test_a_hull_is_carved_coloured_and_written(tmp_path, capsys, background):
    folder, out = write_ball(tmp_path / "ball", background=background), tmp_path / "out"
    named = [] if background is None else ["--background", "black"]
    arguments = ["reconstruct", str(folder), "--method", "hull", "--out", str(out), "--resolution", "48"]
    assert cli.main([*arguments, *named]) == 0
    assert "IoU" in capsys.readouterr().out

    import trimesh

    mesh = trimesh.load(out / "model.ply", force="mesh")
    assert mesh.is_watertight
    # Of eight views' hull the volume lies between the ball's and that of the cylinders around it.
    assert 1.0 < mesh.volume / (4 / 3 * np.pi * 0.125) < 1.25
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert distance.min() > 0.48
    assert np.median(distance) < 0.53
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
    assert np.quantile(np.abs(colours - (200, 120, 40)).max(1), 0.9) < 40
    depths, entries = read_results(out)
    assert len(entries) == 8
    middle = [depth[47:49, 63:65].mean() for depth in depths]
    np.testing.assert_allclose(middle, 2.0, atol=0.06)


def test_a_scene_without_silhouettes_has_no_hull_and_says_what_to_name(folder, tmp_path, capsys):
    assert cli.main(["reconstruct", str(folder), "--method", "hull", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "--masks" in said
    assert "--background" in said
    assert not (tmp_path / "out").exists()


def test_images_without_texture_give_a_warning_and_status_1(scene, tmp_path, capsys):
    flat = scene._replace(images=np.full_like(scene.images, 90))
    out = tmp_path / "out"
    out.mkdir()
    for name in ("points.ply", "model.glb", "model.ply"):
        (out / name).write_text("of an earlier run")
    arguments = ["reconstruct", str(write_middlebury(flat, tmp_path / "scene")), "--near", "1.5", "--far", "2.6"]
    assert cli.main([*arguments, "--view", "0", "--planes", "16", "--out", str(out)]) == 1
    assert "warning: No pixel was kept" in capsys.readouterr().err
    assert "No pixel was kept" in (out / "report.html").read_text()
    for name in ("points.ply", "model.glb", "model.ply"):
        assert not (out / name).exists()


def test_a_damaged_image_is_left_out_and_named(scene, tmp_path, capsys):
    folder, out = write_middlebury(scene, tmp_path / "scene"), tmp_path / "out"
    content = (folder / "v1.png").read_bytes()
    (folder / "v1.png").write_bytes(content[: len(content) // 2])
    arguments = ["reconstruct", str(folder), "--planes", "64", "--out", str(out), "--resolution", "32"]
    assert cli.main(arguments) == 0
    said = capsys.readouterr().err
    assert "warning: Left out, unreadable" in said
    assert "v1.png" in said
    depths, entries = read_results(out)
    assert [entry["photograph"] for entry in entries] == ["v0.png", "v2.png", "v4.png", "view_3.png"]
    for depth, truth in zip(depths, scene.depth[[0, 2, 3, 4]], strict=True):
        check_depth(depth, truth)
    assert cli.main([*arguments, "--view", "v1.png"]) == 2
    assert "v1.png" in capsys.readouterr().err


def test_results_never_replace_the_images(scene, tmp_path, capsys):
    folder = write_colmap(scene, tmp_path / "scene", form="text")
    before = {path: path.read_bytes() for path in folder.rglob("*.png")}
    assert cli.main(["reconstruct", str(folder), "--out", str(folder)]) == 2
    assert "out must not contain the images" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*.png")} == before


def test_the_error_at_the_sparse_points_is_the_exact_one(scene, tmp_path):
    read = data.open(write_colmap(scene, tmp_path, form="binary"))
    result = reconstruct_view(read, 1, density=1.0)
    assert result.error.observed == 42
    assert result.error.points >= 30
    assert result.error.median < 2e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--view", "9"], "view must lie in 0..4; got 9"),
        (["--view=-1"], "view must lie in 0..4; got -1"),
        (["--view", "nobody.png"], "be the name of an image; got 'nobody.png'"),
        (["--density", "0"], "density must lie in"),
        (["--density", "2"], "density must lie in (0, 1]; got 2.0"),
        (["--neighbours", "0"], "neighbours must be a whole number, at least 1; got int 0"),
        (["--size", "0"], "size must be a whole number, at least 16; got int 0"),
        (["--planes", "0"], "planes must be a whole number from 3 to 1048576; got int 0"),
        (["--planes", "99999999999"], "planes must be a whole number from 3 to 1048576; got int 99999999999"),
        (["--near", "3", "--far", "1"], "near and far must be positive, finite and ascending; got 3.0 and 1.0"),
        (["--near", "-1"], "near and far must be positive"),
        (["--far", ".inf"], "near and far must be positive"),
        (["--resolution", "0"], "resolution must be a whole number from 8 to 1024; got int 0"),
        (["--view", "0", "--check", "0", "--resolution", "0"], "resolution must be a whole number from 8 to 1024"),
        (["--resolution", "100000"], "resolution must be a whole number from 8 to 1024; got int 100000"),
        (["--memory", "1"], "memory must be at least"),
        (["--method", "sweep", "--masks", "x"], "masks is for method hull, v-lsm, d-lsm; got method sweep"),
        (["--method", "hull", "--near", "1"], "near is for method sweep; got method hull"),
        (["--method", "hull", "--background", "0.1,x,2"], "background must be black, white or three numbers"),
        (["--memory", "-5"], "memory must be at least"),
        (["--view", "0", "--check=-1"], "check must be 0 or more; got -1"),
    ],
)
def test_wrong_options_give_one_line_and_status_2(folder, tmp_path, capsys, arguments, message):
    assert cli.main(["reconstruct", str(folder), "--out", str(tmp_path / "out"), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("lsmgeo: error: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "place",
    [
        "lsmgeo.classical.stereo.run_sweep",
        "lsmgeo.reconstruct.result_figures.coloured_depth",
        "lsmgeo.reconstruct.result_figures.summary",
        "os.fsync",
    ],
)
def test_an_interrupt_leaves_no_file(scene, tmp_path, monkeypatch, capsys, place):
    folder = write_middlebury(scene, tmp_path / "scene")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(place, interrupt)
    out = tmp_path / "out"
    small = ["--planes", "8", "--size", "48", "--resolution", "32"]
    assert cli.main(["reconstruct", str(folder), *small, "--out", str(out)]) == 130
    assert capsys.readouterr().err.endswith("lsmgeo: interrupted\n")
    assert list(out.rglob("*")) == []


def test_a_place_that_cannot_be_written_is_told_before_the_work(folder, tmp_path, monkeypatch, capsys):
    def work(*_, **__):
        raise AssertionError

    monkeypatch.setattr("lsmgeo.classical.stereo.run_sweep", work)
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        assert cli.main(["reconstruct", str(folder), "--out", str(out)]) == 2
        assert f"out must be a folder that can be written or created; got '{out}'" in capsys.readouterr().err


def test_views_of_which_one_end_of_the_range_leaves_nothing_are_left_out(scene, tmp_path, capsys):
    folder = write_colmap(scene, tmp_path / "scene", form="binary")
    ends = [default_depth_range(data.open(folder), view)[1] for view in range(5)]
    near = (sorted(ends)[0] + sorted(ends)[1]) / 2
    out = tmp_path / "out"
    cli.main(["reconstruct", str(folder), "--near", str(near), "--planes", "8", "--size", "32", "--out", str(out)])
    assert f"Not swept: {scene.names[int(np.argmin(ends))]}: near and far must be" in capsys.readouterr().err
    assert len(list((out / "depth").iterdir())) == 4


def test_two_images_are_enough(scene, tmp_path):
    file = write_middlebury(scene, tmp_path) / "scene_par.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(["2", *lines[1:3]]))
    assert cli.main(["reconstruct", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    check_depth(read_results(tmp_path / "out")[0][0], scene.depth[0])


def test_one_image_is_too_few(scene, tmp_path, capsys):
    file = write_middlebury(scene, tmp_path) / "scene_par.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(["1", *lines[1:2]]))
    assert cli.main(["reconstruct", str(tmp_path), "--near", "1", "--far", "3"]) == 2
    assert "has no usable neighbour" in capsys.readouterr().err


def test_views_are_chosen_by_angle_and_not_twice(scene, tmp_path):
    read = data.open(write_middlebury(scene, tmp_path))
    np.testing.assert_allclose(common_point(read.cameras), 0, atol=1e-9)  # all look at the origin
    chosen = select_neighbours(read, 0, 4)
    assert len(chosen) == len(set(chosen)) == 4
    assert 0 not in chosen
    double = scene._replace(**{name: np.concatenate([value[:4], value[:1]]) for name, value in (
        ("K", scene.K), ("R", scene.R), ("t", scene.t))})  # fmt: skip
    doubled = data.open(write_middlebury(double, tmp_path))
    assert 4 not in select_neighbours(doubled, 0, 4)  # stands where the reference stands
    assert sum(index in (0, 4) for index in select_neighbours(doubled, 1, 4)) == 1


def test_the_default_range_covers_the_scene(scene, folder):
    near, far = default_depth_range(data.open(folder), 0)
    depth = scene.points @ scene.R[0][2] + scene.t[0][2]
    assert 1.0 < near < depth.min()
    assert depth.max() < far < 3.0


def test_cameras_of_the_originals_give_what_resized_ones_give(scene, tmp_path):
    """Originals twice as large, half as large and stretched, all brought to one size."""
    read = data.open(write_middlebury(scene, tmp_path))
    images = torch.stack([read.load(index) for index in range(5)])
    scale_y, scale_x = np.array([1, 2, 0.5, 4, 1]), np.array([1, 2, 0.5, 1, 2])
    K = scene.K.copy()
    K[:, 0] *= scale_x[:, None]
    K[:, 1] *= scale_y[:, None]
    # The same area is tiled: the centre of pixel 0 lies half a pixel inside the border at every size.
    K[:, 0, 2] += 0.5 * scale_x - 0.5
    K[:, 1, 2] += 0.5 * scale_y - 0.5
    originals = read.cameras._replace(
        intrinsics=torch.from_numpy(K), height=torch.from_numpy(72 * scale_y).long(),
        width=torch.from_numpy(96 * scale_x).long()
    )  # fmt: skip
    depths = depth_planes(1.5, 2.6, 40, spacing="inverse")
    expected = sweep(images, read.cameras, depths)
    torch.testing.assert_close(sweep(images, originals, depths).depth, expected.depth, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(sweep(images, originals, depths).cost, expected.cost, rtol=1e-4, atol=1e-4)
    plain = sweep(images, read.cameras._replace(height=72, width=96), depths)
    torch.testing.assert_close(plain.depth, expected.depth, rtol=0, atol=0)
    check_depth((expected.depth * kept(expected, 0.4)).numpy(), scene.depth[0])


@pytest.mark.parametrize("folder_size", [(144, 192), (108, 72)])
def test_images_of_several_sizes_are_matched(scene, tmp_path, folder_size):
    """Some of the images are stored at another size, with the cameras that belong to it."""
    height, width = folder_size
    read = data.open(write_middlebury(scene, tmp_path))
    lines = (tmp_path / "scene_par.txt").read_text().splitlines()
    for view in (1, 3):
        with Image.open(read.paths[view]) as picture:
            resized = picture.resize((width, height), Image.Resampling.BICUBIC)
        resized.save(read.paths[view])
        index = next(index for index, line in enumerate(lines) if line.startswith(f"{read.names[view]} "))
        name, *numbers = lines[index].split()
        S = np.array([[width / 96, 0, 0.5 * width / 96 - 0.5], [0, height / 72, 0.5 * height / 72 - 0.5], [0, 0, 1]])
        K = S @ np.array(numbers[:9], dtype=float).reshape(3, 3)
        lines[index] = " ".join([name, *(repr(float(x)) for x in K.ravel()), *numbers[9:]])
    (tmp_path / "scene_par.txt").write_text("\n".join(lines) + "\n")
    result = reconstruct_view(data.open(tmp_path), 0, size=96)
    assert set(result.neighbours) & {1, 3}
    check_depth(torch.where(result.mask, result.depth_map.depth, 0.0).numpy(), scene.depth[0])


@pytest.mark.parametrize(("density", "expected"), [(0.25, 16), (0.29, 18), (0.999, 63), (1.0, 64), (0.01, 0)])
def test_never_more_pixels_are_kept_than_the_density_allows(density, expected):
    depth_map = DepthMap(torch.ones(8, 8), torch.full((8, 8), 0.5), torch.zeros(8, 8), torch.full((8, 8), 5.0))
    mask = kept(depth_map, density)
    assert int(mask.sum()) == expected
    assert bool(mask.flatten()[:expected].all())  # among equals the first


def test_a_density_that_is_whole_but_for_rounding_is_whole():
    tied = torch.full((10, 10), 0.5)
    assert int(kept(DepthMap(tied, tied, tied, tied), 0.29).sum()) == 29


def test_kept_pixels_are_the_best_and_specks_go():
    confidence = torch.linspace(0, 1, 64).reshape(8, 8)
    depth_map = DepthMap(torch.ones(8, 8), confidence, torch.zeros(8, 8), torch.full((8, 8), 5.0))
    assert int(kept(depth_map, 0.25).sum()) == 16
    assert int(kept(depth_map, 1.0, least=0.5).sum()) == 32
    for options, message in (({"density": "all"}, "density must be"), ({"density": 1.0, "specks": 1.5}, "specks must")):
        with pytest.raises(OptionError, match=message):
            kept(depth_map, **options)
    planes = torch.full((8, 8), 5.0)
    planes[6, 6] = 20.0
    mask = kept(depth_map._replace(planes=planes), 0.25, specks=4)
    assert int(mask.sum()) == 15
    assert not bool(mask[6, 6])
