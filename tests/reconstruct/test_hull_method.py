"""How a hull looks in its views, and what colours it takes from them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo import VoxelGrid
from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Mesh
from lsmgeo.reconstruct.hull_method import colour_vertices, hull_depth
from lsmgeo.reconstruct.write_results import ViewResult

K = torch.tensor([[20.0, 0.0, 7.5], [0.0, 20.0, 5.5], [0.0, 0.0, 1.0]])


def camera_at(z: float) -> CameraTensors:
    """On the z axis, looking along it."""
    E = torch.eye(4)
    E[2, 3] = -z
    return CameraTensors(K, E, 12, 16)


@pytest.mark.parametrize("thickness", [1.0, 0.02])
def test_depth_is_that_of_the_front_of_a_box(thickness):
    grid = VoxelGrid((4, 8, 8), (-0.5, -0.5, -thickness / 2), (0.5, 0.5, thickness / 2))
    depth = hull_depth(torch.ones(grid.shape, dtype=torch.bool), grid, camera_at(-3.0))
    front = 3.0 - thickness / 2
    on = (20 * 0.5 / front - 0.5) // 1
    expected = (2 * on + 2) ** 2
    assert int((depth > 0).sum()) == min(expected, 12 * (2 * on + 2))
    assert ((depth[depth > 0] - front).abs() <= thickness / 4).all()


@pytest.mark.parametrize("z", [0.0, 0.3, 0.4, 0.45, 0.499, 0.6])
def test_a_camera_within_a_hull_sees_what_lies_before_it(z):
    depth = hull_depth(torch.ones(8, 8, 8, dtype=torch.bool), VoxelGrid(8), camera_at(z))
    # A voxel before the camera is its own surroundings.
    assert bool((depth > 0).all()) == bool((depth > 0).any()) == (0.5 - z > 1.5 / 8)


@pytest.mark.parametrize("x", [-0.4, 0.0, 7.0, 15.4])
def test_vertices_take_the_colours_of_pictures_up_to_the_border(x):
    at = torch.linalg.inv(K) @ torch.tensor([x, 5.0, 1.0]) * 2
    vertices = (at.numpy() + 0.01 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])).astype(np.float32)
    mesh = Mesh(vertices, np.array([[0, 2, 1]]))
    picture = torch.tensor([1.0, 0.6, 0.2])[:, None, None].expand(3, 12, 16)
    view = ViewResult(0, picture, camera_at(0.0), torch.full((12, 16), 2.0), torch.ones(12, 16), "silhouette", ())
    coloured = colour_vertices(mesh, [view], 0.1)
    assert coloured.colours[0].tolist() == [255, 153, 51]
