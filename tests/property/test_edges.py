"""Single cases at the edge of what floating point and autograd can do, each against its exact answer."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import forward_ad

from lsmgeo import FrustumGrid, PlaneSweepProject, VoxelGrid, depth_planes, functional, kernels, rays
from lsmgeo.cameras import CameraTensors, crop, from_opencv, orbit, select, to
from lsmgeo.cameras import rays as camera_rays
from lsmgeo.errors import CameraError, DeviceError, DTypeError, ShapeError
from lsmgeo.kernels import Options
from tests.abilities import needs_second_derivatives

VIEWS = orbit(torch.tensor([[0.0, 40.0]]), 10.0, 2.0, focal_length=50.0, height=24, width=32)
FEATURES = torch.rand(1, 2, 3, 12, 16, generator=torch.Generator().manual_seed(0))


def points(count: int) -> torch.Tensor:
    return torch.rand(1, count, 3, generator=torch.Generator().manual_seed(1)) - 0.5


def test_directions_do_not_depend_on_the_other_points():
    near = points(1000)
    far = torch.full((1, 1, 3), 1e7)
    alone = functional.unproject_points(FEATURES, VIEWS, near, augment="direction").volume
    beside = functional.unproject_points(FEATURES, VIEWS, torch.cat((near, far), 1), augment="direction").volume
    center = torch.tensor([2 * math.cos(math.radians(10)), 2 * math.sin(math.radians(10)), 0.0])
    expected = torch.nn.functional.normalize(near[0] - center, dim=-1).T
    torch.testing.assert_close(alone[0, 0, 3:], expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(beside[0, 0, 3:, :-1], expected, rtol=0, atol=1e-3)


def test_points_of_a_distant_world_keep_their_pixels():
    origin = torch.tensor([4e5, 5e6, 100.0], dtype=torch.float64)
    double = to(VIEWS, torch.float64)
    E = double.cam_from_world.clone()
    E[..., :3, 3] -= (E[..., :3, :3] * origin).sum(-1)
    there = double._replace(cam_from_world=E)
    expected = functional.unproject_points(FEATURES.double(), double, points(50).double()).volume
    found = functional.unproject_points(FEATURES, there, points(50).double() + origin).volume
    torch.testing.assert_close(found, expected.float(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("call", ["grid", "points", "sweep"])
def test_geometry_that_nothing_depends_on_gets_no_gradient(call):
    K = VIEWS.intrinsics.clone().requires_grad_()
    views = VIEWS._replace(intrinsics=K)
    if call == "grid":
        answer = functional.unproject(FEATURES, views, VoxelGrid(4), mode="nearest", reduce="mean").volume
    elif call == "points":
        answer = functional.unproject_points(FEATURES, views, points(7), mode="nearest", reduce="max").volume
    else:
        planes, weight = depth_planes(1.5, 2.5, 3), torch.ones(1, 9)
        volume = torch.rand(1, 3, 4, 4, 4)
        answer = rays.project_reduce(volume, views, VoxelGrid(4), planes, weight, size=(6, 8), mode="nearest").maps
    assert answer.abs().max() > 0
    (answer.sum() + 3.0 * K.sum()).backward()
    torch.testing.assert_close(K.grad, torch.full_like(K, 3.0), rtol=0, atol=0)


# PyTorch's own: its forward-mode rules are made by the deprecated script compiler.
@needs_second_derivatives
@pytest.mark.filterwarnings("ignore:.*torch.jit.script:FutureWarning")
def test_forward_mode_through_a_reduction():
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(FEATURES.clone().requires_grad_(), torch.ones_like(FEATURES))
        volume = functional.unproject(dual, VIEWS, VoxelGrid(2), reduce="mean", padding_mode="border").volume
        tangent = forward_ad.unpack_dual(volume).tangent
    torch.testing.assert_close(tangent, torch.ones_like(tangent), rtol=0, atol=1e-6)


def test_variance_of_the_largest_numbers_has_finite_gradients():
    values = torch.tensor([3e38, 3e38, 3e38, -3e38]).reshape(1, 4, 1, 1).requires_grad_()
    variance = functional.view_statistics(values, torch.ones(1, 4, 1, dtype=torch.bool), "variance")
    torch.testing.assert_close(variance, torch.full((1, 1, 1), torch.finfo(torch.float32).max))
    variance.sum().backward()
    assert values.grad.isfinite().all()


def test_reductions_along_rays_compute_in_float32():
    depths = torch.tensor([700.1, 700.2, 700.3])
    flat = torch.zeros(3, 1, 1, dtype=torch.bfloat16)
    torch.testing.assert_close(rays.expected_depth(flat, depths).float(), torch.full((1, 1), 700.0), rtol=0, atol=4.0)
    half = rays.expected_depth(flat.half(), 200.0 * depths)
    torch.testing.assert_close(half, torch.full((1, 1), 65504.0, dtype=torch.float16), rtol=0, atol=0)
    weight, bias = torch.full((1, 8), 0.0), torch.full((1,), 9e4)
    views = VIEWS._replace(**{name: getattr(VIEWS, name)[:, :1] for name in VIEWS._fields})
    volume = torch.ones(1, 8, 2, 2, 2, dtype=torch.float16)
    maps, _ = rays.project_reduce(volume, views, VoxelGrid(2), torch.tensor([2.0]), weight, bias, size=(3, 4))
    torch.testing.assert_close(maps, torch.full_like(maps, 65504.0), rtol=0, atol=0)


def test_hidden_samples_of_a_ray_are_unread():
    nan, visible = float("nan"), torch.tensor([True, False]).reshape(2, 1, 1)
    values = torch.tensor([5.0, nan]).reshape(1, 2, 1, 1)
    alpha = torch.tensor([0.5, 1.0]).reshape(2, 1, 1)
    seen = rays.composite(alpha, values, torch.tensor([1.0, 2.0]), visible)
    torch.testing.assert_close(seen.values, torch.full((1, 1, 1), 2.5), rtol=0, atol=0)
    scores = torch.tensor([nan, nan]).reshape(2, 1, 1).requires_grad_()
    depth = rays.expected_depth(scores, torch.tensor([1.0, 2.0]), torch.zeros(2, 1, 1, dtype=torch.bool))
    depth.sum().backward()
    torch.testing.assert_close(depth.detach(), torch.zeros(1, 1), rtol=0, atol=0)
    torch.testing.assert_close(scores.grad, torch.zeros(2, 1, 1), rtol=0, atol=0)


def test_a_hidden_sample_does_not_stand_for_minus_infinity():
    values = torch.tensor([5.0, -torch.inf, -torch.inf]).reshape(3, 1, 1).requires_grad_()
    visible = torch.tensor([False, True, True]).reshape(3, 1, 1)
    largest = rays.max_along_rays(values, visible)
    assert largest.item() == -torch.inf
    (gradient,) = torch.autograd.grad(largest.sum(), values)
    assert gradient.flatten().tolist() == [0.0, 1.0, 0.0]
    statistic = functional.view_statistics(values[None], visible[None, :, 0], "max")
    assert statistic.item() == -torch.inf
    nothing = rays.max_along_rays(values, torch.zeros_like(visible))
    assert nothing.item() == 0.0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_given_depth_beyond_float32_stays_finite(backend):
    features, pixels = FEATURES[:1, :1], torch.zeros(1, 1, 2, 2, dtype=torch.float64)
    depth = torch.tensor([[[1e300, 2.0]]], dtype=torch.float64, requires_grad=True)
    if backend not in {
        taken.name for taken in kernels.BACKENDS if not taken.why_not("sample_views", features, Options("bilinear"))
    }:
        pytest.skip("no C++ kernels")
    volume, _ = functional.sample_views(
        features, pixels, depth, torch.ones(1, 1, 2, dtype=torch.bool), augment="depth", backend=backend
    )
    assert volume[0, 0, -1].tolist() == [torch.finfo(torch.float32).max, 2.0]
    (gradient,) = torch.autograd.grad(volume.sum(), depth)
    assert gradient.flatten().tolist() == [0.0, 1.0]


def test_nearest_holds_the_number_just_below_a_half():
    below = torch.nextafter(torch.tensor(0.5), torch.tensor(0.0))
    pixels = torch.stack((below, torch.tensor(0.0))).reshape(1, 1, 1, 2)
    there = torch.ones(1, 1, 1)
    volume, visible = functional.sample_views(
        torch.full((1, 1, 1, 1, 1), 7.0), pixels, there, there.bool(), mode="nearest"
    )
    assert visible.all()
    torch.testing.assert_close(volume, torch.full_like(volume, 7.0), rtol=0, atol=0)


def test_rotation_matrices_broadcast_against_one_calibration():
    K = torch.tensor([[50.0, 0.0, 3.0], [0.0, 50.0, 4.0], [0.0, 0.0, 1.0]])
    turns = torch.linalg.qr(torch.rand(5, 3, 3, generator=torch.Generator().manual_seed(3))).Q
    turns = turns * torch.linalg.det(turns)[:, None, None]
    many = from_opencv(K, turns, torch.zeros(3), 24, 32)
    torch.testing.assert_close(many.cam_from_world[:, :3, :3], turns, rtol=0, atol=0)
    one = from_opencv(K.expand(3, 3, 3), turns[0], torch.zeros(3), 24, 32)
    torch.testing.assert_close(one.cam_from_world[:, :3, :3], turns[:1].expand(3, 3, 3), rtol=0, atol=0)


def test_cameras_keep_their_dtype():
    shifted = crop(VIEWS, torch.tensor(2.0, dtype=torch.float64), 1, 10, 12)
    assert shifted.intrinsics.dtype == torch.float32
    torch.testing.assert_close(shifted.intrinsics[..., 1, 2], VIEWS.intrinsics[..., 1, 2] - 2.0)
    _, directions = camera_rays(VIEWS)
    _, expected = camera_rays(to(VIEWS, torch.float64))
    assert directions.dtype == torch.float32
    torch.testing.assert_close(directions, expected.float(), rtol=0, atol=2e-7)


def test_modules_keep_no_state():
    planes = torch.nn.Parameter(depth_planes(1.0, 3.0, 4))
    with pytest.raises(DTypeError, match="depths must be a plain tensor; got a Parameter"):
        PlaneSweepProject(VoxelGrid(4), planes)
    with pytest.raises(ShapeError, match=r"size must be \(h, w\)"):
        rays.ProjectReduce(2, 3, VoxelGrid(4), depth_planes(1.0, 3.0, 4), size="x")


def test_grids_without_values_are_refused():
    pose = torch.eye(4, device="meta")
    with pytest.raises(DeviceError, match="world_from_grid must hold values"):
        functional.unproject(FEATURES, VIEWS, VoxelGrid(2, world_from_grid=pose))
    camera = CameraTensors(*(tensor[0, :1].to("meta") for tensor in VIEWS))
    frustum = FrustumGrid(camera, depth_planes(1.0, 3.0, 4).to("meta"), (3, 4))
    with pytest.raises(DeviceError, match="must hold values"):
        functional.unproject(FEATURES, VIEWS, frustum)


def test_three_rotation_vectors_are_no_matrix():
    K = torch.tensor([[50.0, 0.0, 3.0], [0.0, 50.0, 4.0], [0.0, 0.0, 1.0]])
    quarter = torch.pi / 2 * torch.eye(3)
    three = from_opencv(K, quarter, torch.zeros(3, 3), 24, 32)
    expected = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # a quarter turn about x
    torch.testing.assert_close(three.cam_from_world[0, :3, :3], expected, rtol=0, atol=1e-6)
    with pytest.raises(CameraError, match="rotation must not be three vectors and a matrix at once"):
        from_opencv(K, torch.eye(3), torch.zeros(3, 3), 24, 32)


def test_sizes_shared_by_the_views_and_a_selected_view():
    scenes = orbit(torch.zeros(2, 3), 10.0, 2.0, focal_length=50.0, height=24, width=32)
    shared = scenes._replace(height=torch.tensor([24, 12]), width=torch.tensor([32, 32]))
    lone = select(shared, 0, 1)
    torch.testing.assert_close(lone.height, torch.tensor([12, 12, 12]))
    reference = select(shared, 1, 2)
    torch.testing.assert_close(reference.height, torch.tensor([24, 12]))
    torch.testing.assert_close(reference.intrinsics, shared.intrinsics[:, 2], rtol=0, atol=0)
    with pytest.raises(ShapeError, match="index must be one of 3 cameras; got int 3"):
        select(shared, 1, 3)
    with pytest.raises(ShapeError, match="dim must be a leading axis"):
        select(shared, 2, 0)
