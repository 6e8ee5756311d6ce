"""``sample_volume``: volumes on voxel grids and frustums, read at points."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import CameraTensors, FrustumGrid, VoxelGrid, cameras, depth_planes, functional
from lsmgeo.errors import DTypeError, GridError, OptionError, ShapeError
from tests import oracle, tolerances
from tests.abilities import needs_second_derivatives
from tests.kernels import cases
from tests.property import support
from tests.property.test_frustum import SIZE, frustum, frustum_depths
from tests.strategies import scenes

MODES = st.fixed_dictionaries(
    {"mode": st.sampled_from(("trilinear", "nearest")), "padding_mode": st.sampled_from(("zeros", "border"))}
)
PLACED = {"placements": ("facing", "grazing", "inside")}
COUNT = 40


def exact(values, dtype):
    """Rounded to what `dtype` holds."""
    return values if dtype == torch.float64 else values.astype(np.float32).astype(np.float64)


def read(volume, grid, points, dtype, **options):
    """``functional.sample_volume`` as arrays."""
    source, places = torch.from_numpy(volume).to(dtype), torch.from_numpy(points).to(support.camera_dtype(dtype))
    values, visible = functional.sample_volume(source, grid, places, **options)
    return support.array(values), visible.numpy()


def compare(actual, expected, index, front, certain, error, mode, dtype):
    """Against the oracle, but for what rounding may decide."""
    values, visible = actual
    counts = np.array(expected.shape)
    off_border = np.all((np.abs(index + 0.5) > error) & (np.abs(index - counts + 0.5) > error), -1)
    sure = certain & (off_border | ~front)
    np.testing.assert_array_equal(visible[sure], expected.sampled.visible[sure])
    if mode == "nearest":
        steady = np.all(np.abs(index + 0.5 - np.round(index + 0.5)) > error, -1)
        bound = np.where(steady, tolerances.termwise(dtype, 0.0), 2.0)
    else:
        bound = tolerances.value_error(dtype, error.max(-1), 1.0, axes=3)
    bound = np.where(certain, np.where(front, bound, 0.0), 2.0)
    support.assert_within(values, expected.sampled.values, np.broadcast_to(bound[:, None], values.shape))


class Expected:
    """What the oracle reads, and the x, y, z counts of the volume."""

    def __init__(self, volume, index, front, modes):
        self.sampled = oracle.sample_volume(volume, index, front, **modes)
        self.shape = volume.shape[:1:-1]


@given(scenes(), MODES)
def test_voxels_are_read_as_the_oracle_reads_them(scene, modes):
    rng = np.random.default_rng(scene.seed + 7)
    counts = np.array(scene.shape[::-1])
    index = rng.uniform(-1.7, counts + 0.7, (scene.batch, COUNT, 3))
    index[:, :6] = np.round(index[:, :6] * 2) / 2  # on centres and borders of cells
    lattice = scene.lattice
    for dtype in support.DTYPES:
        points = exact(np.einsum("bij,bnj->bni", lattice[:, :3, :3], index) + lattice[:, None, :3, 3], dtype)
        inverse = np.linalg.inv(lattice[:, :3, :3])
        there = np.einsum("bij,bnj->bni", inverse, points - lattice[:, None, :3, 3])
        front = np.ones(there.shape[:2], dtype=bool)
        norm = np.abs(inverse).sum(-1).max(-1)[:, None]
        reach = np.abs(points).max(-1) + np.abs(lattice[:, :3, 3]).max(-1)[:, None]
        error = np.broadcast_to(tolerances.length_error(dtype, norm * reach)[..., None], there.shape)
        actual = read(scene.volume, support.grid(scene), points, dtype, **modes)
        compare(actual, Expected(scene.volume, there, front, modes), there, front, front, error, modes["mode"], dtype)


@given(scenes(**PLACED), MODES, st.sampled_from((1, 2, 5)), st.booleans())
def test_frustums_are_read_as_the_oracle_reads_them(scene, modes, planes, shared):
    """Points in front of the first plane, between planes, behind the last, and behind the camera."""
    rng = np.random.default_rng(scene.seed + 8)
    volume = exact(rng.uniform(-1, 1, (scene.batch, scene.channels, planes, *SIZE)), torch.float32)
    table = frustum_depths(scene, planes) ** 1.3  # evenly spaced in nothing
    table = np.tile(table[:1], (scene.batch, 1)) if shared else table
    near = 0.05 * table[0, 0]
    pixels = rng.uniform(-1.7, np.array(SIZE[::-1]) + 0.7, (scene.batch, COUNT, 2))
    depth = rng.uniform(0.1, 1.6, (scene.batch, COUNT)) * rng.choice(table[0], (scene.batch, COUNT))
    depth[:, :5] *= -1
    for dtype in support.DTYPES:
        this, depths = scene.rounded(dtype), exact(table, dtype)
        index, z, points, error = [], [], [], []
        for b in range(scene.batch):
            K = oracle.resize_intrinsics(this.intrinsics[b, 0], tuple(this.image_sizes[b, 0]), SIZE)
            camera = K, this.rotations[b, 0], this.translations[b, 0]
            points.append(exact(oracle.backproject(*camera, pixels[b], depth[b]), dtype))
            found, distance = oracle.frustum_index(*camera, depths[b], points[b])
            magnitude = 3 * np.abs(points[b]).sum(-1).max() + np.linalg.norm(camera[2])
            norm = np.abs(K[:2]).sum(-1).max()
            of_pixel = tolerances.coordinate_error(dtype, norm, magnitude, distance, found[:, :2])
            # 1/z is off by the error of z over z^2, and the plane by that over the narrowest interval.
            narrowest = np.abs(np.diff(1 / depths[b])).min(initial=1e9)
            relative = tolerances.length_error(dtype, magnitude) / np.abs(distance) + tolerances.length_error(dtype, 4)
            of_plane = relative / np.abs(distance) / narrowest + tolerances.length_error(dtype, planes)
            index.append(found)
            z.append(distance)
            error.append(np.stack([of_pixel, of_pixel, of_plane], -1))
        index, z, points, error = (np.stack(rows) for rows in (index, z, points, error))
        front = z > near
        grid = frustum(this, depths[0] if shared else depths, dtype=dtype)
        actual = read(volume, grid, points, dtype, near=near, **modes)
        certain = np.abs(z - near) > 1e-4 * (1 + np.abs(points).max())
        compare(actual, Expected(volume, index, front, modes), index, front, certain, error, modes["mode"], dtype)


@given(scenes(**PLACED), st.sampled_from((1, 4)), st.sampled_from(("zeros", "border")))
def test_centres_give_the_volume_back(scene, planes, padding_mode):
    volume = torch.from_numpy(scene.volume)
    centres = support.grid(scene).centers()
    found, visible = functional.sample_volume(
        volume, support.grid(scene), centres.flatten(1, 3), padding_mode=padding_mode
    )
    torch.testing.assert_close(found.reshape(volume.shape), volume, rtol=0, atol=1e-8)
    assert bool(visible.all())
    grid = frustum(scene, frustum_depths(scene, planes))
    volume = torch.rand(scene.batch, 2, planes, *SIZE, dtype=torch.float64)
    found, visible = functional.sample_volume(volume, grid, grid.centers().flatten(1, 3), padding_mode=padding_mode)
    torch.testing.assert_close(found.reshape(volume.shape), volume, rtol=0, atol=1e-8)
    assert bool(visible.all())


@given(scenes(**PLACED), st.sampled_from(("zeros", "border")))
def test_points_of_a_frustum_are_read_as_by_a_plane_sweep(scene, padding_mode):
    depths = frustum_depths(scene)
    own = support.cameras(scene).at((slice(None), slice(0, 1)))
    volume, table = torch.from_numpy(scene.volume), torch.from_numpy(depths)
    maps, _ = functional.plane_sweep_project(
        volume, own, support.grid(scene), table, SIZE, flatten=False, padding_mode=padding_mode
    )
    points = frustum(scene, depths).centers().flatten(1, 3)
    found, _ = functional.sample_volume(volume, support.grid(scene), points, padding_mode=padding_mode)
    torch.testing.assert_close(found.reshape(maps[:, 0].shape), maps[:, 0], rtol=0, atol=1e-8)


def plain_frustum(dtype, depths=(1.0, 2.0, 4.0)):
    """Pixels are x / z and y / z; three planes evenly spaced neither in depth nor in its inverse."""
    camera = CameraTensors(torch.eye(3, dtype=dtype), torch.eye(4, dtype=dtype), torch.tensor(2), torch.tensor(3))
    return FrustumGrid(camera, torch.tensor(depths, dtype=dtype))


def on_axis(depths, dtype):
    """Points at these depths that pixel (1, 0) sees."""
    z = torch.tensor(depths, dtype=dtype)
    return torch.stack([z, torch.zeros_like(z), z], -1)[None]


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_planes_are_known(dtype):
    """1/depth is 1, 1/2, 1/4; between and beyond, the plane is linear in it."""
    depths = [1.0, 4 / 3, 2.0, 8 / 3, 4.0, 6.0, 0.9, 1e30, 0.25, -1.0]
    planes = [0.0, 0.5, 1.0, 1.5, 2.0, 7 / 3, -2 / 9, 3.0, -6.0]
    volume = torch.tensor([10.0, 20.0, 40.0], dtype=dtype)[:, None, None].expand(1, 1, 3, 2, 3)
    points = on_axis(depths, dtype)
    border, visible = functional.sample_volume(volume, plain_frustum(dtype), points, padding_mode="border")
    expected = [*np.interp(planes, [0, 1, 2], [10.0, 20.0, 40.0]).tolist(), 0.0]
    support.assert_known(border[0, 0], torch.tensor(expected, dtype=dtype))
    assert visible[0].tolist() == [True] * 7 + [False] * 3
    zeros, _ = functional.sample_volume(volume, plain_frustum(dtype), points)
    expected = [*np.interp(planes, [-1, 0, 1, 2, 3], [0.0, 10.0, 20.0, 40.0, 0.0]).tolist(), 0.0]
    support.assert_known(zeros[0, 0], torch.tensor(expected, dtype=dtype))


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_voxels_are_known(dtype):
    """Anisotropic voxels: x counts columns, y rows and z slices."""
    grid = VoxelGrid((3, 2, 4), lower=(0.0, 0.0, 0.0), upper=(4.0, 4.0, 9.0))
    volume = torch.arange(24.0, dtype=dtype).reshape(1, 1, 3, 2, 4)  # x + 4 y + 8 z
    points = torch.tensor([[[0.5, 1.0, 1.5], [1.25, 2.0, 6.0], [-0.25, 1.0, 1.5], [3.9, 3.9, 8.9], [4.0, 1.0, 1.5]]])
    values, visible = functional.sample_volume(volume, grid, points, padding_mode="border")
    support.assert_known(values[0, 0], torch.tensor([0.0, 0.75 + 2.0 + 12.0, 0.0, 23.0, 3.0], dtype=dtype))
    assert visible[0].tolist() == [True, True, False, True, False]
    nearest, _ = functional.sample_volume(volume, grid, points, mode="nearest")
    support.assert_known(nearest[0, 0], torch.tensor([0.0, 1.0 + 4.0 + 16.0, 0.0, 23.0, 0.0], dtype=dtype))


def test_one_plane_is_the_same_at_all_depths():
    volume = torch.arange(6.0).reshape(1, 1, 1, 2, 3).requires_grad_()
    points = on_axis([0.5, 1.0, 70.0, 1e-7, -1.0], torch.float32).requires_grad_()
    for padding_mode in ("zeros", "border"):
        values, visible = functional.sample_volume(
            volume, plain_frustum(torch.float32, (1.0,)), points, padding_mode=padding_mode
        )
        torch.testing.assert_close(values[0, 0], torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0]), rtol=0, atol=1e-5)
        assert visible[0].tolist() == [True, True, True, False, False]


@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
@pytest.mark.parametrize("near", [1e-6, 1.5])
def test_nothing_is_read_at_or_behind_near(padding_mode, near):
    """Not even a NaN; in the camera's centre too."""
    volume = torch.full((1, 2, 3, 2, 3), torch.nan, requires_grad=True)
    points = on_axis([near, 0.5 * near, 0.0, -0.0, -2.0], torch.float32).requires_grad_()
    K = torch.eye(3, requires_grad=True)
    depths = torch.tensor([1.0, 2.0, 4.0], requires_grad=True)
    grid = FrustumGrid(CameraTensors(K, torch.eye(4), torch.tensor(2), torch.tensor(3)), depths)
    values, visible = functional.sample_volume(volume, grid, points, padding_mode=padding_mode, near=near)
    assert values.count_nonzero() == 0
    assert not visible.any()
    for gradient in torch.autograd.grad(values.sum(), (volume, points, K, depths)):
        assert gradient.count_nonzero() == 0


def smooth(index):
    return bool(((index - index.round()).abs() > tolerances.KINK_GUARD).all())


def test_gradients_on_a_voxel_grid():
    generator = torch.Generator().manual_seed(2)
    volume = torch.rand(2, 2, 2, 3, 4, generator=generator, dtype=torch.float64).requires_grad_()
    points = (torch.rand(2, 6, 3, generator=generator, dtype=torch.float64) - 0.5).requires_grad_()
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    pose[:, :3] += 0.2 * torch.rand(2, 3, 4, generator=generator, dtype=torch.float64) - 0.1
    pose.requires_grad_()

    def run(volume, points, pose, padding_mode):
        grid = VoxelGrid((2, 3, 4), world_from_grid=pose)
        return functional.sample_volume(volume, grid, points, padding_mode=padding_mode).values

    inverse = VoxelGrid((2, 3, 4), world_from_grid=pose.detach()).lattice_from_world
    assert smooth((inverse[:, None, :3, :3] * points.detach()[:, :, None]).sum(-1) + inverse[:, None, :3, 3])
    for padding_mode in ("zeros", "border"):
        assert torch.autograd.gradcheck(run, (volume, points, pose, padding_mode))


FRUSTUM_LEAVES = ("volume", "points", "K", "E", "depths")


def frustum_problem():
    """Leaves in float64 whose samples are off the kinks."""
    generator = torch.Generator().manual_seed(5)
    views = cameras.orbit(torch.tensor([10.0, 50.0]), 20.0, 2.0, focal_length=5.0, height=5, width=6)
    views = cameras.to(views, torch.float64)
    depths = torch.tensor([[1.2, 1.7, 2.1, 3.1], [1.0, 1.5, 2.5, 2.9]], dtype=torch.float64)
    volume = torch.rand(2, 2, 4, 5, 6, generator=generator, dtype=torch.float64)
    points = 1.2 * torch.rand(2, 8, 3, generator=generator, dtype=torch.float64) - 0.6
    for b in range(2):
        K, E = views.intrinsics[b].numpy(), views.cam_from_world[b].numpy()
        index, _ = oracle.frustum_index(K, E[:3, :3], E[:3, 3], depths[b].numpy(), points[b].numpy())
        assert smooth(torch.from_numpy(index))
    leaves = (volume, points, views.intrinsics, views.cam_from_world, depths)
    return tuple(leaf.detach().clone().requires_grad_() for leaf in leaves), views


def read_frustum(volume, points, K, E, depths, **options):
    grid = FrustumGrid(CameraTensors(K, E, torch.tensor([5, 5]), torch.tensor([6, 6])), depths)
    return functional.sample_volume(volume, grid, points, **options).values


@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
def test_gradients_on_a_frustum(padding_mode):
    """To volume, points, K, R and t, and depths: finite differences leave R a rotation to first order."""
    leaves, _ = frustum_problem()
    spin = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)

    def run(volume, points, K, spin, shift, depths):
        x, y, z = spin.unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(2, 3, 3)
        turned = torch.linalg.matrix_exp(cross) @ leaves[3].detach()[:, :3, :3]
        rows = torch.cat((turned, shift[..., None]), -1)
        K = torch.cat((K, leaves[2].detach()[:, 2:]), -2)
        E = torch.cat((rows, leaves[3].detach()[:, 3:]), -2)
        return read_frustum(volume, points, K, E, depths, padding_mode=padding_mode)

    rows, shift = (x.detach().clone().requires_grad_() for x in (leaves[2][:, :2], leaves[3][:, :3, 3]))
    inputs = (leaves[0], leaves[1], rows, spin, shift, leaves[4])
    assert torch.autograd.gradcheck(run, inputs)
    for gradient in torch.autograd.grad(run(*inputs).square().sum(), inputs):
        assert gradient.abs().max() > 0


@needs_second_derivatives
def test_second_derivatives():
    (volume, points, K, E, depths), _ = frustum_problem()

    def run(volume, points, depths):
        return read_frustum(volume, points, K.detach(), E.detach(), depths)

    assert torch.autograd.gradgradcheck(run, (volume, points, depths), fast_mode=True, atol=1e-4)


@pytest.mark.parametrize("dtype", support.DTYPES)
@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
def test_derivative_on_a_plane_is_that_of_the_interval_behind_it(dtype, padding_mode):
    volume = torch.tensor([10.0, 20.0, 40.0], dtype=dtype)[:, None, None].expand(1, 1, 3, 2, 3)
    points = on_axis([1.0, 2.0, 4.0], dtype).requires_grad_()
    values, _ = functional.sample_volume(volume, plain_frustum(dtype), points, padding_mode=padding_mode)
    (gradient,) = torch.autograd.grad(values.sum(), points)
    # d plane / d depth is a b / (b - a) / depth^2; along the ray x grows with z, which moves no pixel of a constant.
    inner = [10.0 * 2.0, 20.0 * 4.0 / 4.0, -40.0 * 4.0 / 16.0]
    expected = torch.tensor(inner if padding_mode == "zeros" else [0.0, inner[1], 0.0], dtype=dtype)
    torch.testing.assert_close(gradient[0, :, 2], expected, rtol=1e-5, atol=1e-5)


def test_nearest_has_no_gradient_to_geometry():
    (volume, points, K, E, depths), _ = frustum_problem()
    values = read_frustum(volume, points, K, E, depths, mode="nearest")
    assert values.abs().max() > 0
    gradients = torch.autograd.grad(values.sum(), (volume, points, K, E, depths), allow_unused=True)
    assert gradients[0].abs().max() > 0
    for gradient in gradients[1:]:
        assert gradient is None or gradient.count_nonzero() == 0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_computes_in_float32(dtype):
    volume = cases.VOLUME.to(dtype)
    points = torch.rand(2, 30, 3) - 0.5
    values, visible = functional.sample_volume(volume, cases.GRID, points.double())
    expected = functional.sample_volume(volume.float(), cases.GRID, points.double())
    assert values.dtype == dtype
    torch.testing.assert_close(values, expected.values.to(dtype), rtol=0, atol=0)
    support.assert_same(visible, expected.visible)


def test_autocast_changes_nothing():
    grid = FrustumGrid(cases.CAMERA, depth_planes(1.0, 3.0, 4), (5, 6))
    volume, points = torch.rand(2, 3, 4, 5, 6), torch.rand(2, 30, 3) - 0.5
    expected = functional.sample_volume(volume, grid, points)
    assert expected.values.abs().max() > 0
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = functional.sample_volume(volume, grid, points)
    support.assert_same(found.values, expected.values)
    support.assert_same(found.visible, expected.visible)


def test_batches_are_loops_in_any_layout():
    depths = torch.stack((depth_planes(1.0, 3.0, 4), depth_planes(1.2, 2.0, 4, spacing="log")))
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, :3, 3] = torch.tensor([0.1, -0.2, 0.3])
    volume, points = torch.rand(2, 3, 4, 5, 6), torch.rand(2, 30, 3) - 0.5
    spread = volume.permute(0, 2, 3, 4, 1).contiguous().permute(0, 4, 1, 2, 3)
    turned = points.transpose(1, 2).contiguous().transpose(1, 2)
    grids = (
        lambda part: VoxelGrid((4, 5, 6), world_from_grid=pose[part]),
        lambda part: FrustumGrid(cases.CAMERA.at(part), depths[part], (5, 6)),
    )
    for grid in grids:
        whole = functional.sample_volume(volume, grid(slice(0, 2)), points)
        other = functional.sample_volume(spread, grid(slice(0, 2)), turned)
        assert 0 < int(whole.visible.sum()) < whole.visible.numel()
        torch.testing.assert_close(tuple(other), tuple(whole), rtol=0, atol=1e-6)
        for b in range(2):
            one = functional.sample_volume(volume[b : b + 1], grid(slice(b, b + 1)), points[b : b + 1])
            torch.testing.assert_close(one.values[0], whole.values[b], rtol=0, atol=1e-5)


def test_a_distant_world_keeps_its_samples():
    origin = torch.tensor([4e5, 5e6, 100.0], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = origin
    views = cameras.to(cases.CAMERA, torch.float64)
    E = views.cam_from_world.clone()
    E[..., :3, 3] -= (E[..., :3, :3] * origin).sum(-1)
    depths = depth_planes(1.0, 3.0, 4)
    volume, points = torch.rand(2, 3, 4, 5, 6), torch.rand(2, 30, 3, dtype=torch.float64) - 0.5
    for here, there in (
        (VoxelGrid((4, 5, 6)), VoxelGrid((4, 5, 6), world_from_grid=pose)),
        (FrustumGrid(views, depths, (5, 6)), FrustumGrid(views._replace(cam_from_world=E), depths, (5, 6))),
    ):
        expected = functional.sample_volume(volume.double(), here, points).values
        found = functional.sample_volume(volume, there, points + origin).values
        assert found.abs().max() > 0.1
        torch.testing.assert_close(found, expected.float(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-30, 1e10, 3e38])
@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
def test_extreme_numbers_give_finite_answers(scale, padding_mode):
    directions = torch.tensor([[1.0, 1, 1], [-1, 0, 1], [0, 0, -1], [0, 0, 1], [0.1, 0.0, 1e-30]])
    volume = torch.rand(1, 2, 3, 2, 3, requires_grad=True)
    for points in (scale * directions, torch.cat((scale * directions, on_axis([1.5], torch.float32)[0]))):
        points = points[None].clone().requires_grad_()
        for table in ((1.0, 2.0, 4.0), (scale, 1.1 * scale, 1.11 * scale)):
            depths = torch.tensor(table, dtype=torch.float64, requires_grad=True)
            grid = FrustumGrid(plain_frustum(torch.float32).camera, depths)
            for where in (grid, VoxelGrid((3, 2, 3))):
                values, _ = functional.sample_volume(volume, where, points, padding_mode=padding_mode, near=0.0)
                leaves = (volume, points, depths) if where is grid else (volume, points)
                for tensor in (values, *torch.autograd.grad(values.sum(), leaves)):
                    assert bool(tensor.isfinite().all())


def test_planes_that_float32_cannot_tell_apart_stay_finite():
    depths = (1.0, 1.0 + 1e-12, 1.0 + 2e-12)
    grid = FrustumGrid(plain_frustum(torch.float64).camera, torch.tensor(depths, dtype=torch.float64))
    points = on_axis([0.5, 1.0, 1.0000001, 2.0], torch.float32).requires_grad_()
    values, _ = functional.sample_volume(torch.ones(1, 1, 3, 2, 3), grid, points, padding_mode="border")
    support.assert_known(values, torch.ones(1, 1, 4))
    assert bool(torch.autograd.grad(values.sum(), points)[0].isfinite().all())


def test_a_nan_reaches_only_samples_next_to_it():
    volume = torch.ones(1, 1, 4, 4, 4)
    volume[..., 3, 3, 3] = torch.nan
    points = VoxelGrid(4).centers().reshape(1, -1, 3)[:, [0, 21, 63]] - 0.05
    values, _ = functional.sample_volume(volume, VoxelGrid(4), points, padding_mode="border")
    assert values[0, 0].isnan().tolist() == [False, False, True]


@pytest.mark.parametrize(("scenes", "channels", "count"), [(0, 3, 5), (2, 0, 5), (2, 3, 0), (0, 0, 0)])
def test_nothing_to_sample(scenes, channels, count):
    volume, points = torch.rand(scenes, channels, 4, 5, 6, requires_grad=True), torch.zeros(scenes, count, 3)
    frustum = FrustumGrid(cases.CAMERA.at(slice(0, scenes)), depth_planes(1.0, 3.0, 4), (5, 6))
    for grid in (VoxelGrid((4, 5, 6)), frustum):
        values, visible = functional.sample_volume(volume, grid, points)
        assert tuple(values.shape) == (scenes, channels, count)
        assert tuple(visible.shape) == (scenes, count)
        assert torch.autograd.grad(values.sum(), volume)[0].shape == volume.shape


def test_bad_arguments_are_named():
    grid, volume, points = VoxelGrid((4, 5, 6)), torch.rand(2, 3, 4, 5, 6), torch.zeros(2, 7, 3)
    pixels = FrustumGrid(cases.CAMERA, torch.ones(2, 4, 5, 6))
    planes = FrustumGrid(cases.CAMERA, torch.tensor([[1.0, 2.0], [1.0, 3.0]]), (5, 6))
    for error, text, arguments in (
        (ShapeError, "volume must be (B, C, D, H, W); got (3, 4, 5, 6)", {"volume": volume[0]}),
        (ShapeError, "with the grid's (D, H, W) = (4, 5, 6); got (2, 3, 4, 5, 5)", {"volume": volume[..., 1:]}),
        (DTypeError, "volume must be of float16", {"volume": volume.long()}),
        (DTypeError, "grid must be a VoxelGrid or a FrustumGrid; got", {"grid": cases.CAMERA}),
        (ShapeError, "depths (P,) or (B, P), not of each pixel; got (2, 4, 5, 6)", {"grid": pixels}),
        (ShapeError, "as many as scenes, B = 1; got 2", {"volume": volume[:1, :, :2], "grid": planes}),
        (ShapeError, "points must be (B, N, 3) with B = 2; got (1, 7, 3)", {"points": points[:1]}),
        (ShapeError, "points must be (B, N, 3) with B = 2; got (2, 7, 2)", {"points": points[..., :2]}),
        (DTypeError, "points must be of float32, float64; got torch.float16", {"points": points.half()}),
        (GridError, "points must be finite", {"points": points.log() + points.log().neg()}),
        (OptionError, "mode must be one of 'trilinear', 'nearest'; got str 'bilinear'", {"mode": "bilinear"}),
        (OptionError, "padding_mode must be", {"padding_mode": "reflection"}),
        (OptionError, "near must be a finite number, at least 0; got", {"near": -1.0}),
    ):
        with pytest.raises(error, match=re.escape("sample_volume: ") + ".*" + re.escape(text)):
            functional.sample_volume(**{"volume": volume, "grid": grid, "points": points, **arguments})
