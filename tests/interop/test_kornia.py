"""kornia's cameras in, and kornia and OpenCV as witnesses where they are right: no skew, points in front."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.camera.pinhole import PinholeCamerasList
from kornia.geometry.depth import DepthWarper
from torch import Tensor

from lsmgeo import CameraTensors, FrustumGrid, cameras, depth_planes, functional
from lsmgeo.cameras import as_tensors
from tests.interop.models import GRID, arguments, views

B, V = 2, 3
DEPTHS = depth_planes(1.5, 2.5, 6)


def four_by_four(K: Tensor) -> Tensor:
    matrix = torch.zeros(*K.shape[:-2], 4, 4, dtype=K.dtype)
    matrix[..., :3, :3] = K
    matrix[..., 3, 3] = 1.0
    return matrix


def forms(given: CameraTensors) -> dict[str, PinholeCamera | CameraTensors]:
    """The same B x V cameras in every form that is accepted, all of one image size."""
    K, E, height, width = given
    flat = (four_by_four(K).flatten(0, 1), E.flatten(0, 1), height.flatten().to(K), width.flatten().to(K))
    singles = [PinholeCamera(four_by_four(K[:, v]), E[:, v], height[:, v].to(K), width[:, v].to(K)) for v in range(V)]
    return {
        "kornia, B*V": PinholeCamera(*flat),
        "kornia, (B, V, 4, 4)": PinholeCamera(four_by_four(K), E, height[:, 0].to(K), width[:, 0].to(K)),
        "kornia list": PinholeCamerasList(singles),
        "ours, to kornia": given.to_kornia(),
        "ours, flat": CameraTensors(*(field.flatten(0, 1) for field in given)),
        "ours, ints": CameraTensors(K, E, 24, 32),
        "ours, 4x4": given._replace(intrinsics=four_by_four(K)),
        "ours, there and back": CameraTensors.from_kornia(given.to_kornia()),
    }


FORMS = list(forms(views(B, V)))


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_camera(form):
    features, *fields = arguments(B, V)
    plain = CameraTensors(*fields)
    given = forms(plain)[form]
    options = {"augment": ("depth", "direction")}
    expected = functional.unproject(features, plain, GRID, **options)
    assert expected.volume.abs().sum() > 0
    torch.testing.assert_close(
        tuple(functional.unproject(features, given, GRID, **options)), tuple(expected), rtol=0, atol=0
    )
    volume = torch.rand(B, 2, *GRID.shape, generator=torch.Generator().manual_seed(0))
    expected = functional.plane_sweep_project(volume, plain, GRID, DEPTHS, (7, 9))
    assert expected.maps.abs().sum() > 0
    actual = functional.plane_sweep_project(volume, given, GRID, DEPTHS, (7, 9))
    torch.testing.assert_close(tuple(actual), tuple(expected), rtol=0, atol=0)


@pytest.mark.parametrize("form", ["kornia, B*V", "kornia, (B, V, 4, 4)", "kornia list", "ours, to kornia"])
def test_fields_of_every_form(form):
    plain = views(B, V)
    taken = as_tensors(forms(plain)[form])
    for mine, other in zip(taken, plain, strict=True):
        matrix_axes = (other.dim() > 2) * 2
        assert torch.equal(mine.reshape(other.shape).to(other), other)
        assert tuple(mine.shape[: mine.dim() - matrix_axes]) in ((B, V), (B * V,))


def test_gradients_reach_a_kornia_camera():
    features, K, E, height, width = arguments(B, V)
    intrinsics, extrinsics = (m.flatten(0, 1).requires_grad_() for m in (four_by_four(K), E))
    camera = PinholeCamera(intrinsics, extrinsics, height.flatten().to(K), width.flatten().to(K))
    volume, _ = functional.unproject(features, camera, GRID)
    for gradient in torch.autograd.grad(volume.square().sum(), (intrinsics, extrinsics)):
        assert gradient.isfinite().all()
        assert gradient.flatten(1).abs().sum(1).min() > 0


def straight(count: int = V) -> CameraTensors:
    """Float64 cameras without skew, all of one size."""
    made = views(B, count, dtype=torch.float64)
    K = made.intrinsics.clone()
    K[..., 0, 1] = 0.0
    return made._replace(intrinsics=K)


def ramps(height: int, width: int) -> Tensor:
    """An image (2, height, width) that holds each pixel's u and v."""
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return torch.stack((u, v))


def seen_pixels(given: CameraTensors, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (B, V, N, 2), depths (B, V, N) and visibility of points (B, N, 3) as the operator has them."""
    image = ramps(24, 32).expand(*given.intrinsics.shape[:2], 2, 24, 32)
    volume, visible = functional.unproject_points(image, given, points, augment="depth", padding_mode="border")
    return volume[:, :, :2].movedim(2, -1), volume[:, :, 2], visible


def points_in_view() -> Tensor:
    return 0.3 * torch.rand(B, 40, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.15


def interior(pixels: Tensor) -> Tensor:
    """Where a ramp is linear all around."""
    return ((pixels > 0.0) & (pixels < torch.tensor([31.0, 23.0], dtype=pixels.dtype))).all(-1)


def test_kornia_projects_to_the_same_pixels():
    given, points = straight(), points_in_view()
    pixels, depth, visible = seen_pixels(given, points)
    camera = given.to_kornia()
    repeated = points[:, None].expand(B, V, 40, 3).flatten(0, 1)
    expected = camera.project(repeated).unflatten(0, (B, V))
    inside = interior(expected)
    assert inside.double().mean() > 0.8
    assert visible[inside].all()
    torch.testing.assert_close(pixels[inside], expected[inside], rtol=0, atol=1e-9)
    back = camera.unproject(expected.flatten(0, 1), depth.flatten(0, 1)[..., None])
    torch.testing.assert_close(back, repeated, rtol=0, atol=1e-9)


def test_opencv_projects_to_the_same_pixels():
    given, points = straight(), points_in_view()
    pixels, depth, visible = seen_pixels(given, points)
    K, R, t = (tensor.numpy() for tensor in cameras.to_opencv(given))
    for b, v in np.ndindex(B, V):
        expected, _ = cv2.projectPoints(points[b].numpy(), cv2.Rodrigues(R[b, v])[0], t[b, v], K[b, v], None)
        expected = torch.from_numpy(expected[:, 0])
        inside = interior(expected)
        assert inside.sum() > 20
        assert visible[b, v][inside].all()
        torch.testing.assert_close(pixels[b, v][inside], expected[inside], rtol=0, atol=1e-9)
        np.testing.assert_allclose(depth[b, v].numpy(), (points[b].numpy() @ R[b, v].T + t[b, v])[:, 2], atol=1e-12)


@pytest.mark.parametrize("depth", [1.6, 2.0, 2.4])
def test_kornia_warps_a_plane_to_the_same_image(depth):
    """A plane of a frustum, unprojected from a second view, is kornia's warp of that view by the plane's depth."""
    given = straight(2)
    turned = cameras.perturb(CameraTensors(*(f[:, 0] for f in given)), 8.0, generator=torch.Generator().manual_seed(5))
    reference = CameraTensors(*(field[:, 0] for field in given))
    image = torch.rand(B, 3, 24, 32, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    plane = FrustumGrid(reference, torch.tensor([depth], dtype=torch.float64))
    pair = CameraTensors(*(field[:, None] for field in turned))
    volume, visible = functional.unproject(image[:, None], pair, plane, padding_mode="border")
    warper = DepthWarper(turned.to_kornia(), 24, 32, padding_mode="border", align_corners=True)
    warper.compute_projection_matrix(reference.to_kornia())
    expected = warper(torch.full((B, 1, 24, 32), depth, dtype=torch.float64), image)
    assert visible.double().mean() > 0.5
    torch.testing.assert_close(volume[:, 0, :, 0], expected, rtol=0, atol=1e-6)


def test_resizing_differs_from_kornias_scale_by_its_half_pixel():
    """Kornia scales the principal point about the corner's centre (kornia issue 4263); ours about the corner."""
    given = straight()
    ours = cameras.resize(given, 12, 16).to_kornia()
    theirs = given.to_kornia().scale(torch.tensor(0.5, dtype=torch.float64))
    torch.testing.assert_close(ours.fx, theirs.fx)
    torch.testing.assert_close(ours.fy, theirs.fy)
    torch.testing.assert_close(theirs.cx - ours.cx, torch.full_like(ours.cx, 0.25))
    torch.testing.assert_close(theirs.cy - ours.cy, torch.full_like(ours.cy, 0.25))
