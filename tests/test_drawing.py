"""Images of voxels, depth and points: things are where cameras see them, and what is near hides what is far."""

import numpy as np
import pytest
import torch

from lsmgeo.cameras import orbit
from lsmgeo.drawing import draw_depth, draw_points, draw_voxels, tile
from lsmgeo.errors import DTypeError, OptionError, ShapeError


def covered(image):
    """Rows and columns of the pixels that are not white."""
    return np.argwhere((image < 250).any(-1))


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (40, 25), (200, -15), (300, 60)])
def test_a_voxel_is_drawn_where_the_camera_sees_it(azimuth, elevation):
    grid = torch.zeros(16, 16, 16, dtype=torch.bool)
    grid[3, 12, 10] = True  # z, y, x
    place = torch.tensor([10.5, 12.5, 3.5]) / 16 - 0.5
    R = orbit(float(azimuth), float(elevation), 2.0, focal_length=1.0, height=1, width=1).cam_from_world[:3, :3]
    x, y, _ = (R @ place).tolist()
    row, column = covered(draw_voxels(grid, azimuth, elevation, 200, reach=0.8)).mean(0)
    np.testing.assert_allclose([column, row], [100 + x * 125 - 0.5, 100 + y * 125 - 0.5], atol=1.0)


def test_a_full_grid_covers_a_square_and_its_three_faces_differ():
    front = draw_voxels(torch.ones(4, 4, 4, dtype=torch.bool), 0.0, 0.0, 100, reach=1.0)
    rows, columns = covered(front).T
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (25, 74, 25, 74)
    aslant = draw_voxels(torch.ones(1, 1, 1, dtype=torch.bool), 35.0, 25.0, 100, reach=1.0)
    pixels, counts = np.unique(aslant.reshape(-1, 3), axis=0, return_counts=True)
    assert (counts > 200).sum() == 4  # three faces and white
    assert draw_voxels(np.zeros((2, 3, 4), bool), size=8).min() == 255
    assert len(pixels) > 4  # edges are smooth


def test_near_voxels_hide_far_ones():
    wall = torch.zeros(8, 8, 8, dtype=torch.bool)
    wall[:, :, 7] = True  # at +x, towards azimuth 0
    with_more = wall.clone()
    with_more[3:5, 3:5, 1:4] = True
    assert np.array_equal(draw_voxels(wall, 0, 0, 64), draw_voxels(with_more, 0, 0, 64))
    assert not np.array_equal(draw_voxels(wall, 180, 0, 64), draw_voxels(with_more, 180, 0, 64))


def test_points_have_their_colours_and_near_ones_win():
    points = np.array([[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.0, 0.25, 0.0]])
    colours = np.array([[255, 0, 0], [0, 0, 255], [0, 128, 0]], np.uint8)
    image = draw_points(points, colours, 0.0, 0.0, 100, dot=5.0, reach=0.5)
    assert image[50, 50].tolist() == [255, 0, 0]  # the blue one is behind
    assert image[25, 50].tolist() == [0, 128, 0]  # up is up
    np.testing.assert_allclose(len(covered(image)), 50, atol=22)


def plane(height=40, width=40):
    """A square plate that faces a camera two units away."""
    camera = orbit(0.0, 0.0, 2.0, focal_length=40.0, height=height, width=width)
    depth = torch.zeros(height, width)
    depth[10:30, 10:30] = 2.0
    return depth, camera


def test_depth_is_drawn_where_it_is():
    depth, camera = plane()
    rows, columns = covered(draw_depth(depth, camera, turn=0.0, lift=0.0, size=100, reach=1.0)).T
    # From pixel centre 10 to 29 of 40: 19 pixels of 1/20 unit.
    np.testing.assert_allclose([rows.max() - rows.min(), columns.max() - columns.min()], 47.5, atol=1.5)
    aside = covered(draw_depth(depth, camera, turn=60.0, lift=0.0, size=100, reach=1.0))
    np.testing.assert_allclose(np.ptp(aside[:, 1]), 47.5 / 2, atol=1.5)


def test_a_shifted_viewer_goes_to_the_right_and_up():
    depth, camera = plane()
    depth[:] = 0
    depth[15:25, 15:25] = 1.7  # a plate before the middle: of a viewer to the right and above it moves left and down
    row, column = covered(draw_depth(depth, camera, turn=25.0, lift=20.0, size=100, reach=1.0)).mean(0)
    a, e = np.radians([25, 20])
    expected = [49.5 - 50 * 0.3 * np.sin(a), 49.5 + 50 * 0.3 * np.cos(a) * np.sin(e)]
    np.testing.assert_allclose([column, row], expected, atol=0.7)


def test_a_jump_of_depth_is_torn():
    depth, camera = plane()
    depth[10:30, 20:30] = 1.2
    whole = np.ptp(covered(draw_depth(depth, camera, turn=0.0, lift=0.0, size=100, reach=1.0))[:, 1])
    image = draw_depth(depth, camera, turn=-40.0, lift=0.0, size=100, reach=1.0)
    gaps = (image == 255).all(-1)[50]
    inside = covered(image)[:, 1]
    assert gaps[inside.min() : inside.max()].any()
    assert whole > 35


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda: draw_voxels(torch.ones(4, 4, 4)), DTypeError),
        (lambda: draw_voxels(torch.ones(4, 4, dtype=torch.bool)), ShapeError),
        (lambda: draw_voxels(torch.ones(4, 4, 4, dtype=torch.bool), float("nan")), OptionError),
        (lambda: draw_voxels(torch.ones(4, 4, 4, dtype=torch.bool), size=0), OptionError),
        (lambda: draw_depth(torch.ones(4, 4, dtype=torch.int64), plane()[1]), DTypeError),
        (lambda: draw_depth(torch.ones(4, 4, 4), plane()[1]), ShapeError),
    ],
)
def test_junk_is_named(call, error):
    with pytest.raises(error):
        call()


def test_nothing_is_drawn_of_nothing():
    assert draw_depth(torch.zeros(8, 8), plane(8, 8)[1], size=16).min() == 255
    assert draw_points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), size=16).min() == 255


def test_images_stand_in_rows():
    black = np.zeros((2, 3, 3), np.uint8)
    sheet = tile([[black, None], [None, black]], gap=1)
    assert sheet.shape == (5, 7, 3)
    assert (sheet[..., 0] == 0).sum() == 12
    assert sheet[3, 4, 0] == 0
