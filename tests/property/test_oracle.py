"""The oracle itself, against independent witnesses where they are right: OpenCV, SciPy, kornia."""

from __future__ import annotations

import ast
import pathlib

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from kornia.geometry.camera import PinholeCamera
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from tests import oracle
from tests.property import support
from tests.strategies import rotations, scenes, vectors


def test_oracle_imports_neither_the_library_nor_torch():
    for path in pathlib.Path(oracle.__file__).parent.glob("*.py"):
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module or "")
        assert not {name for name in names if name.split(".")[0] in ("lsmgeo", "torch", "kornia")}, path


@support.FEWER
@given(scenes(placements=("facing", "grazing", "inside", "on_pixel")))
def test_projection_is_opencv_and_kornia_without_skew(scene):
    K, R, t = scene.intrinsics[0, 0].copy(), scene.rotations[0, 0], scene.translations[0, 0]
    K[0, 1] = K[1, 0] = 0.0
    K[[0, 1], [0, 1]] = np.abs(K[:2, :2]).max()  # OpenCV and kornia know nothing else
    pixels, depth = oracle.project(K, R, t, scene.sites[0])
    front = depth > 0.05
    if not front.any():
        return
    expected, _ = cv2.projectPoints(scene.sites[0][front], cv2.Rodrigues(R)[0], t, K, None)
    np.testing.assert_allclose(pixels[front], expected[:, 0], rtol=1e-9, atol=1e-9)

    intrinsics, extrinsics = torch.eye(4, dtype=torch.float64)[None], torch.eye(4, dtype=torch.float64)[None]
    intrinsics[0, :3, :3], extrinsics[0, :3, :3], extrinsics[0, :3, 3] = map(torch.from_numpy, (K, R, t))
    size = torch.tensor([10.0])
    camera = PinholeCamera(intrinsics, extrinsics, size, size)
    np.testing.assert_allclose(
        pixels[front], camera.project(torch.from_numpy(scene.sites[0][front])), rtol=1e-9, atol=1e-9
    )


@support.FEWER
@given(rotations(), vectors())
def test_rotation_is_scipys_and_backprojection_inverts_projection(rotation, point):
    np.testing.assert_allclose(oracle.rotation(point), Rotation.from_rotvec(point).as_matrix(), atol=1e-14)
    K = np.array([[30.0, 4.0, 9.0], [0.0, 50.0, 7.0], [0.0, 0.0, 1.0]])
    t = np.array([0.1, -0.2, 5.0])
    pixels, depth = oracle.project(K, rotation, t, point[None])
    np.testing.assert_allclose(oracle.backproject(K, rotation, t, pixels, depth), point[None], atol=1e-12)
    np.testing.assert_allclose(rotation @ oracle.camera_center(rotation, t) + t, np.zeros(3), atol=1e-14)


@pytest.mark.parametrize("sizes", [(7, 9), (1, 9), (4, 5, 6)])
@pytest.mark.parametrize(("padding_mode", "scipy_mode"), [("zeros", "grid-constant"), ("border", "nearest")])
def test_sampling_is_scipys(sizes, padding_mode, scipy_mode):
    rng = np.random.default_rng(0)
    array = rng.normal(size=(2, *sizes))
    index = rng.uniform(-3, 10, (500, len(sizes)))
    expected = [map_coordinates(channel, index.T[::-1], order=1, mode=scipy_mode) for channel in array]
    np.testing.assert_allclose(oracle.sample(array, index, "linear", padding_mode), expected, atol=1e-12)


def test_nearest_takes_the_cell_that_contains_the_sample():
    array = np.arange(4.0)[None, None]
    index = np.array(
        [[-0.6, 0.0], [-0.5, 0.0], [0.49, 0.0], [0.5, 0.0], [1.5, 0.0], [2.5, 0.0], [3.49, 0.0], [3.5, 0.0]]
    )
    np.testing.assert_array_equal(oracle.sample(array, index, "nearest")[0], [0, 0, 0, 1, 2, 3, 3, 0])
    np.testing.assert_array_equal(oracle.is_inside(index, (1, 4)), [0, 1, 1, 1, 1, 1, 1, 0])


def test_rays_meet_plane_sphere_and_box():
    origins, directions = (
        np.array([[0.0, 0.0, -3.0]] * 3),
        np.array([[0.0, 0.0, 2.0], [0.0, 0.5, 2.0], [0.0, 3.0, 1.0]]),
    )
    inf = np.inf
    np.testing.assert_allclose(oracle.hit_plane(origins, directions, np.array([0.0, 0.0, 1.0]), 1.0), [2.0, 2.0, 4.0])
    np.testing.assert_allclose(oracle.hit_plane(origins, directions, np.array([0.0, 1.0, 0.0]), 3.0), [inf, 6.0, 1.0])
    sphere = oracle.hit_sphere(origins, directions, np.zeros(3), 1.0)
    np.testing.assert_allclose(sphere[[0, 2]], [1.0, inf])
    np.testing.assert_allclose(np.linalg.norm(origins[1] + sphere[1] * directions[1]), 1.0)
    box = oracle.hit_box(origins, directions, np.array([-1.0, -2.0, -0.5]), np.array([1.0, 2.0, 0.5]))
    np.testing.assert_allclose(box, [1.25, 1.25, inf])


def test_plane_homography_is_backprojection_then_projection():
    rng = np.random.default_rng(1)
    K = np.array([[30.0, 4.0, 9.0], [0.0, 50.0, 7.0], [0.0, 0.0, 1.0]])
    reference = (K, oracle.rotation(rng.normal(size=3)), rng.normal(size=3))
    source = (
        K + np.diag([3.0, 2.0, 0.0]),
        oracle.rotation(0.2 * rng.normal(size=3)) @ reference[1],
        rng.normal(size=3),
    )
    pixels = rng.uniform(0, 20, (50, 2))
    expected, _ = oracle.project(*source, oracle.backproject(*reference, pixels, np.full(50, 2.5)))
    warped = oracle.homography(reference, source, 2.5) @ np.concatenate([pixels, np.ones((50, 1))], 1).T
    np.testing.assert_allclose((warped[:2] / warped[2]).T, expected, rtol=1e-9, atol=1e-9)
