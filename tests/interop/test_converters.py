"""Cameras of other tools: each convention written out again in numpy, and compared pixel by pixel.

The pixels that the operator reads are those of `tests.interop.test_kornia.seen_pixels`: integer centres.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from lsmgeo import CameraTensors, cameras
from lsmgeo.errors import CameraError
from tests.interop.models import views
from tests.interop.test_kornia import B, V, interior, points_in_view, seen_pixels, straight

HEIGHT, WIDTH = 24, 32
RANDOM = np.random.default_rng(7)


def skewed() -> CameraTensors:
    return views(B, V, dtype=torch.float64)


def arrays(*tensors: torch.Tensor) -> list[np.ndarray]:
    return [tensor.numpy() for tensor in tensors]


def assert_reads(given: CameraTensors, pixels: np.ndarray, depth: np.ndarray) -> None:
    """The operator sees the points at these pixels (B, V, N, 2), integer centres, and depths."""
    actual, actual_depth, visible = seen_pixels(given, points_in_view())
    expected = torch.from_numpy(pixels)
    inside = interior(expected)
    assert inside.double().mean() > 0.8
    assert visible[inside].all()
    torch.testing.assert_close(actual[inside], expected[inside], rtol=0, atol=1e-9)
    torch.testing.assert_close(actual_depth, torch.from_numpy(depth), rtol=0, atol=1e-12)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions w, x, y, z: q p q* for the three axes."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


# How each tool gets from a world point to a pixel, in its own pixel coordinates.


def opencv_pixels(K, rotation, translation):
    points = points_in_view().numpy()[:, None]
    x = points @ rotation.swapaxes(-1, -2) + translation[..., None, :]
    homogeneous = x @ K.swapaxes(-1, -2)
    return homogeneous[..., :2] / homogeneous[..., 2:], x[..., 2]


def opengl_pixels(K, world_from_cam):
    """X right, y up, looking along -z: rows count downwards, so v falls as y rises."""
    points = points_in_view().numpy()[:, None]
    rotation, center = world_from_cam[..., :3, :3], world_from_cam[..., None, :3, 3]
    x, y, z = np.moveaxis((points - center) @ rotation, -1, 0)  # R^T (X - C), as rows
    right, down, ahead = x / -z, -y / -z, -z
    u = K[..., 0, 0, None] * right + K[..., 0, 1, None] * down + K[..., 0, 2, None]
    v = K[..., 1, 1, None] * down + K[..., 1, 2, None]
    return np.stack((u, v), -1), ahead


def pytorch3d_ndc(R, T, focal_length, principal_point):
    """Row vectors, x left, y up, z ahead; the shorter side of the image spans [-1, 1], +x to the left."""
    points = points_in_view().numpy()[:, None]
    x, y, z = np.moveaxis(points @ R + T[..., None, :], -1, 0)
    projected = np.stack((x / z, y / z), -1)
    return focal_length[..., None, :] * projected + principal_point[..., None, :], z


def screen_of(ndc):
    """Pixel coordinates whose origin is the corner of the image (centres at halves) from normalised ones."""
    return np.array([WIDTH, HEIGHT]) / 2.0 - 0.5 * min(HEIGHT, WIDTH) * ndc


class TestOpenCV:
    def test_to(self):
        given = skewed()
        assert_reads(given, *opencv_pixels(*arrays(*cameras.to_opencv(given))))

    def test_half_pixels_on_request(self):
        given = skewed()
        pixels, depth = opencv_pixels(*arrays(*cameras.to_opencv(given, pixel_center="half")))
        assert_reads(given, pixels - 0.5, depth)

    def test_rotation_vectors(self):
        vectors = RANDOM.uniform(-1.0, 1.0, (B, V, 3))
        matrices = np.array([[cv2.Rodrigues(vector)[0] for vector in row] for row in vectors])
        K, _, t = cameras.to_opencv(skewed())
        made = cameras.from_opencv(K, torch.from_numpy(vectors), t, HEIGHT, WIDTH)
        np.testing.assert_allclose(made.cam_from_world[..., :3, :3].numpy(), matrices, atol=1e-6)


class TestOpenGL:
    def test_to(self):
        given = skewed()
        pixels, depth = opengl_pixels(*arrays(*cameras.to_opengl(given)))
        assert_reads(given, pixels - 0.5, depth)

    def test_integer_centres_on_request(self):
        given = skewed()
        assert_reads(given, *opengl_pixels(*arrays(*cameras.to_opengl(given, pixel_center="integer"))))

    def test_a_blender_file(self):
        """``camera_angle_x``, principal point in the middle: the middle of the image is half a pixel off a centre."""
        focal = float(0.5 * WIDTH / np.tan(0.5 * 0.7))
        K = torch.tensor([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
        pose = torch.eye(4)
        pose[:3, 3] = torch.tensor([0.0, 0.0, 4.0])
        camera = cameras.from_opengl(K, pose, HEIGHT, WIDTH)
        torch.testing.assert_close(camera.intrinsics[:2, 2], torch.tensor([15.5, 11.5]))
        # A point up and to the right in the world is up and to the right in the image: smaller v, larger u.
        x = camera.cam_from_world[:3, :3] @ torch.tensor([1.0, 1.0, 0.0]) + camera.cam_from_world[:3, 3]
        torch.testing.assert_close(x, torch.tensor([1.0, -1.0, 4.0]))


class TestColmap:
    def test_to(self):
        given = skewed()
        K, quaternion, translation = arrays(*cameras.to_colmap(given))
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1.0, atol=1e-6)
        pixels, depth = opencv_pixels(K, rotation_of(quaternion), translation)
        assert_reads(given, pixels - 0.5, depth)

    def test_from(self):
        quaternion = RANDOM.normal(size=(B, V, 4))
        unit = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
        K, _, t = cameras.to_colmap(skewed())
        made = cameras.from_colmap(K, torch.from_numpy(quaternion), t, HEIGHT, WIDTH)
        np.testing.assert_allclose(made.cam_from_world[..., :3, :3].numpy(), rotation_of(unit), atol=1e-9)
        torch.testing.assert_close(made.intrinsics[..., :2, 2], K[..., :2, 2] - 0.5)


class TestPyTorch3D:
    def test_to_normalised_coordinates(self):
        given = straight()
        ndc, depth = pytorch3d_ndc(*arrays(*cameras.to_pytorch3d(given)))
        assert_reads(given, screen_of(ndc) - 0.5, depth)

    def test_to_screen_coordinates(self):
        """Screen focal lengths and principal points are normalised by the shorter side, about the image's middle."""
        given = straight()
        R, T, focal_length, principal_point = arrays(*cameras.to_pytorch3d(given, in_ndc=False))
        scale = 2.0 / min(HEIGHT, WIDTH)
        normalised = -(principal_point - np.array([WIDTH, HEIGHT]) / 2.0) * scale
        ndc, depth = pytorch3d_ndc(R, T, focal_length * scale, normalised)
        assert_reads(given, screen_of(ndc) - 0.5, depth)

    def test_one_focal_length_for_both_axes(self):
        R, T = torch.eye(3), torch.tensor([0.0, 0.0, 2.0])
        camera = cameras.from_pytorch3d(R, T, torch.tensor([1.5]), torch.zeros(2), HEIGHT, WIDTH)
        torch.testing.assert_close(camera.intrinsics.diagonal(), torch.tensor([18.0, 18.0, 1.0]))

    def test_skew_has_no_place_there(self):
        given = skewed()
        given.intrinsics[..., 0, 1] = given.intrinsics[..., 1, 0] = 0.0
        given.intrinsics[1, 0, 0, 1] = 0.5
        with pytest.raises(CameraError, match=r"cameras\[1, 0\]: .* no skew .* are 0.5 and 0.0$"):
            cameras.to_pytorch3d(given)


def assert_cameras(actual: CameraTensors, expected: CameraTensors) -> None:
    torch.testing.assert_close(actual.intrinsics, expected.intrinsics, rtol=0, atol=1e-12)
    torch.testing.assert_close(actual.cam_from_world, expected.cam_from_world, rtol=0, atol=1e-6)
    assert torch.equal(actual.height.expand_as(expected.height), expected.height)
    assert torch.equal(actual.width.expand_as(expected.width), expected.width)


TOOLS = {
    "opencv": [{"pixel_center": center} for center in ("integer", "half")],
    "opengl": [{"pixel_center": center} for center in ("integer", "half")],
    "colmap": [{"pixel_center": center} for center in ("integer", "half")],
    "pytorch3d": [{"in_ndc": True}, {"in_ndc": False}],
}


def there_and_back(tool: str, given: CameraTensors, **options: object) -> CameraTensors:
    parts = getattr(cameras, f"to_{tool}")(given, **options)
    return getattr(cameras, f"from_{tool}")(*parts, HEIGHT, WIDTH, **options)


@pytest.mark.parametrize(("tool", "options"), [(tool, options) for tool in TOOLS for options in TOOLS[tool]])
def test_there_and_back(tool, options):
    given = straight() if tool == "pytorch3d" else skewed()
    assert_cameras(there_and_back(tool, given, **options), given)


@pytest.mark.parametrize("tool", TOOLS)
def test_gradients_go_through_every_converter(tool):
    given = straight()
    K, E = (matrix.clone().requires_grad_() for matrix in given[:2])
    back = there_and_back(tool, given._replace(intrinsics=K, cam_from_world=E))
    of_K, of_E = torch.autograd.grad((back.intrinsics[..., 0, 2] + back.cam_from_world[..., 0, 3]).sum(), (K, E))
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 2] = 1.0
    torch.testing.assert_close(of_K, expected.expand_as(of_K))
    torch.testing.assert_close(of_E[..., 0, 3], torch.ones(B, V, dtype=torch.float64))
