"""The drawing of cameras: coordinates are those of the labelled axes."""

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lsmgeo.data.posed_images import Voxels
from lsmgeo.diagnosis.camera_drawing import Content, draw_cameras, surface_of
from lsmgeo.diagnosis.two_view_geometry import Geometry
from lsmgeo.grids import VoxelGrid

K = np.array([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]])


def ring(world, count=8):
    """Cameras around the point (1, 2, 3) that look at it from two above; then the world is rotated."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 2.0])
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append((R @ world.T, -R @ world.T @ (world @ (center + np.array([1, 2, 3])))))
    R, t = map(np.array, zip(*poses, strict=True))
    return Geometry(np.repeat(K[None], count, 0), R, t)


def drawn(cameras, content=Content(np.zeros((0, 3)))):  # noqa: B008
    figure = Figure(figsize=(14, 8), layout="constrained")
    FigureCanvasAgg(figure)
    count = len(cameras.K)
    draw_cameras(figure, cameras, content, np.tile([48, 64], (count, 1)), np.zeros((count, 3)))
    figure.draw_without_rendering()
    return figure


WORLDS = {
    "z": np.eye(3),
    "-y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


@pytest.mark.parametrize("name", WORLDS)
def test_positions_are_those_of_the_named_axes(name):
    cameras = ring(WORLDS[name])
    for axes in drawn(cameras).axes:
        place = np.array(next(text.xy for text in axes.texts if text.get_text() == "3"))
        for axis, value in zip((axes.xaxis, axes.yaxis), place, strict=True):
            letter, world = axis.get_label_text().split(" ")
            assert world == "(world)"
            ticks = [text.get_text().replace("\N{MINUS SIGN}", "-") for text in axis.get_majorticklabels()]
            shown = np.polyval(np.polyfit(axis.get_majorticklocs(), [float(text) for text in ticks], 1), value)
            np.testing.assert_allclose(shown, cameras.centers[3]["xyz".index(letter)], atol=1e-4)


def test_a_tilted_world_is_drawn_rotated():
    c, s = np.cos(0.7), np.sin(0.7)
    figure = drawn(ring(np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])))
    assert "rotated so that up is up; origin at the mean of the cameras" in figure.get_supxlabel()
    assert [axes.get_ylabel() for axes in figure.axes] == ["away", "up"]
    assert all("common point of the optical axes" in axes.get_legend_handles_labels()[1] for axes in figure.axes)


def test_thirty_cameras_on_a_ring_are_all_numbered_and_a_single_one_is_inside_the_drawing():
    above, _ = drawn(ring(np.eye(3), 30)).axes
    assert sorted(int(text.get_text()) for text in above.texts) == list(range(30))
    (axes, _) = drawn(ring(np.eye(3), 1)).axes
    assert axes.get_title() == "1 camera from above"
    for lines in axes.collections:
        for path in lines.get_paths():
            assert (path.vertices.min(0) > [axes.get_xlim()[0], axes.get_ylim()[0]]).all()
            assert (path.vertices.max(0) < [axes.get_xlim()[1], axes.get_ylim()[1]]).all()


def test_only_the_surface_of_voxels_is_drawn():
    occupancy = torch.zeros(6, 6, 6, dtype=torch.bool)
    occupancy[1:5, 1:5, 1:5] = True
    content = surface_of(Voxels(occupancy, VoxelGrid(6, 0.0, 3.0)))
    assert len(content.points) == 4**3 - 2**3
    assert content.cell == pytest.approx(0.5)
    middle = content.points.mean(0)
    np.testing.assert_allclose(middle, 1.5)
    assert (((content.points - middle) * content.normals).sum(1) > 0).all()
    assert len(drawn(ring(np.eye(3)), content).axes) == 2
