"""Silhouettes of posed images: alpha, files, and the rule of the background."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import VoxelGrid
from lsmgeo.cameras import orbit
from lsmgeo.classical import hull_box, silhouettes, visual_hull
from lsmgeo.data import Lens, PosedImages, open_scene
from lsmgeo.errors import DataError, OptionError
from tests.data.real_sets import real_set

SIZE = (80, 100)


def disc(view, radius=20.0):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.hypot(y - 38 - view, x - 50) < radius


def posed_images(folder, draw, *, mode="RGB", cut_out=False, views=3, lens=None):
    """Posed images 0.png, 1.png, ... that ``draw(view)`` returns, (H, W, C) uint8."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = tuple(folder / f"{view}.png" for view in range(views))
    for view, path in enumerate(paths):
        Image.fromarray(draw(view), mode).save(path)
    angles = torch.linspace(0, 240, views, dtype=torch.float64)
    cameras = orbit(angles, 10.0, 2.0, focal_length=60.0, height=SIZE[0], width=SIZE[1])
    lenses = None if lens is None else (lens,) * views
    names = tuple(path.name for path in paths)
    return PosedImages(names, paths, cameras, None, "test", lenses=lenses, cut_out=cut_out)


def on_colour(colour):
    def draw(view):
        pixels = np.full((*SIZE, 3), colour, np.uint8)
        pixels[disc(view)] = (200, 90, 30)
        return pixels

    return draw


def write_masks(folder, names, mask=disc):
    folder.mkdir()
    for view, name in enumerate(names):
        Image.fromarray(np.where(mask(view), 255, 0).astype(np.uint8)).save(folder / name)


def check(masks, views=(0, 1, 2)):
    assert len(masks) == len(views)
    for view, mask in zip(views, masks, strict=True):
        assert mask.dtype == torch.bool
        np.testing.assert_array_equal(mask.numpy(), disc(view))


def test_alpha(tmp_path):
    def draw(view):
        alpha = np.where(disc(view), 255, 0).astype(np.uint8)
        alpha[0, :4] = (0, 127, 128, 255)
        return np.dstack((np.full((*SIZE, 3), 99, np.uint8), alpha))

    scene = posed_images(tmp_path, draw, mode="RGBA", cut_out=True)
    for view, mask in enumerate(silhouettes(scene)):
        expected = disc(view)
        expected[0, :4] = (False, False, True, True)
        np.testing.assert_array_equal(mask.numpy(), expected)


@pytest.mark.parametrize("place", ["masks", "../silhouettes", "derived_silhouettes"])
def test_a_folder_beside_the_images_is_found(tmp_path, place):
    scene = posed_images(tmp_path / "images", on_colour(0))
    write_masks(tmp_path / "images" / place, ["0.png", "1.png", "2.png"])
    check(silhouettes(scene))
    check(silhouettes(scene, [2, 0]), (2, 0))


def test_a_folder_may_be_named_and_names_may_have_two_endings(tmp_path):
    scene = posed_images(tmp_path / "images", on_colour(0))
    write_masks(tmp_path / "elsewhere", ["0.png.png", "1.png", "2.jpg"])
    check(silhouettes(scene, folder=tmp_path / "elsewhere"))
    check(silhouettes(scene, folder=str(tmp_path / "elsewhere")))


def test_a_transparent_pixel_of_a_mask_is_off_the_object(tmp_path):
    scene = posed_images(tmp_path / "images", on_colour(0))
    (tmp_path / "masks").mkdir()
    for view in range(3):
        alpha = np.where(disc(view), 255, 0).astype(np.uint8)
        Image.fromarray(np.dstack((np.full((*SIZE, 3), 255, np.uint8), alpha))).save(tmp_path / "masks" / f"{view}.png")
    check(silhouettes(scene))


def test_a_folder_that_lacks_a_mask_is_not_taken_for_one(tmp_path):
    scene = posed_images(tmp_path / "images", on_colour(0))
    write_masks(tmp_path / "images" / "masks", ["0.png", "1.png"])
    with pytest.raises(OptionError, match="name a folder of masks"):
        silhouettes(scene)
    with pytest.raises(DataError, match=r"holds no mask of 2\.png"):
        silhouettes(scene, folder=tmp_path / "images" / "masks")
    check(silhouettes(scene, [0, 1], folder=tmp_path / "images" / "masks"), (0, 1))


@pytest.mark.parametrize(
    ("colour", "background"),
    [(0, "black"), (255, "white"), ((10, 120, 240), (10 / 255, 120 / 255, 240 / 255)), (20, "black")],
)
def test_the_rule_of_the_background(tmp_path, colour, background):
    check(silhouettes(posed_images(tmp_path, on_colour(colour)), background=background))


def test_by_the_rule_specks_and_pinholes_are_noise_and_holes_are_not(tmp_path):
    def draw(view):
        pixels = on_colour(0)(view)
        pixels[2, 2:5] = 255  # 3 of 8000 pixels, less than 0.05 %
        pixels[70:72, 80:82] = 255  # 4
        pixels[38, 48:51] = 0
        pixels[30:34, 50] = 0
        return pixels

    for view, mask in enumerate(silhouettes(posed_images(tmp_path, draw), background="black")):
        expected = disc(view)
        expected[70:72, 80:82] = True
        expected[30:34, 50] = False
        np.testing.assert_array_equal(mask.numpy(), expected)


def test_masks_are_undistorted_with_their_images(tmp_path):
    K = np.array([[90.0, 0, 49.5], [0, 90, 39.5], [0, 0, 1]])
    lens = Lens("perspective", K, (-0.3, 0.05, 0.0, 0.0), *SIZE)
    scene = posed_images(tmp_path / "images", on_colour(0), lens=lens)
    write_masks(tmp_path / "masks", ["0.png", "1.png", "2.png"])
    for view, mask in enumerate(silhouettes(scene)):
        # Where the image mixes object and background, the nearest pixel may be either.
        assert (mask ^ (scene.load(view)[0] > 0.4)).sum() < 40
        assert (mask.numpy() ^ disc(view)).sum() > 100


def test_bad_input_is_refused(tmp_path):
    scene = posed_images(tmp_path / "images", on_colour(0))
    for options, expected in (
        ({}, "name a folder of masks"),
        ({"views": [3]}, "views must be numbers from 0 to 2"),
        ({"background": "green"}, "background must be one of"),
        ({"background": (0, 0)}, "background must be"),
        ({"background": (0, 0, 2)}, "background must be numbers"),
        ({"background": "black", "folder": tmp_path}, "not both"),
    ):
        with pytest.raises(OptionError, match=expected):
            silhouettes(scene, **options)
    write_masks(tmp_path / "masks", ["0.png", "1.png", "2.png"], lambda view: np.ones((8, 8), bool))
    with pytest.raises(DataError, match="is 8 x 8 pixels"):
        silhouettes(scene)


def test_the_temple_is_where_its_publisher_says():
    scene = open_scene(real_set("middlebury_temple"))
    masks = silhouettes(scene)
    grid = VoxelGrid((40, 72, 52), *hull_box(masks, scene.cameras))
    hull = visual_hull(masks, scene.cameras, grid, rule="all")
    index = hull.occupancy.nonzero().flip(1).double()
    T = grid.world_from_lattice
    box = torch.stack((index.amin(0) - 0.5, index.amax(0) + 0.5)) @ T[:3, :3].T + T[:3, 3]
    published = torch.tensor([(-0.073568, 0.021728, -0.012445), (0.028855, 0.181892, 0.062736)])
    assert float((box - published).abs().max()) < 0.020
