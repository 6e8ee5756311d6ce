"""Derivatives against finite differences, at kinks, and where they must vanish (P13)."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from torch import Tensor

from lsmgeo import CameraTensors, FrustumGrid, VoxelGrid, functional
from tests import oracle, tolerances
from tests.abilities import needs_second_derivatives
from tests.property.test_unproject import plain_camera

SHAPE = (2, 1, 3)
LOWER, UPPER = (-0.5, -0.3, -0.6), (0.4, 0.5, 0.7)
SIZE = (4, 5)
IMAGE = (11.0, 8.0)
PLANES = torch.tensor([1.3, 2.1, 3.2], dtype=torch.float64)


class Setup:
    """One scene of two skewed cameras; parameters as leaves: features, K (5), so(3), t, grid pose, depths."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.base = []
        for _ in range(2):
            eye = rng.normal(size=3)
            eye *= rng.uniform(1.6, 2.4) / np.linalg.norm(eye)
            self.base.append(oracle.look_at(eye, 0.2 * rng.normal(size=3), np.array([0.1, -1.0, 0.2])))
        focal = rng.uniform(7, 11, (2, 2))
        others = np.stack([rng.uniform(-2, 2, 2), rng.uniform(3, 4.5, 2), rng.uniform(4.5, 6, 2)])
        self.rotation = torch.from_numpy(np.stack([r for r, _ in self.base]))
        self.features = torch.from_numpy(rng.normal(size=(1, 2, 2, *SIZE)))
        self.volume = torch.from_numpy(rng.normal(size=(1, 2, *SHAPE)))
        self.pinhole = torch.from_numpy(np.stack([focal[:, 0], others[0], others[1], focal[:, 1], others[2]], 1))
        self.spin = torch.from_numpy(0.1 * rng.normal(size=(2, 3)))
        self.shift = torch.from_numpy(np.stack([t for _, t in self.base]) + 0.05 * rng.normal(size=(2, 3)))
        self.pose = torch.from_numpy(np.eye(4)[:3] + 0.1 * rng.normal(size=(3, 4)))
        self.points = torch.from_numpy(rng.uniform(-0.5, 0.5, (1, 4, 3)))

    def cameras(self, pinhole: Tensor, spin: Tensor, shift: Tensor) -> CameraTensors:
        fx, skew, cx, fy, cy = pinhole.unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        K = torch.stack([fx, skew, cx, zero, fy, cy, zero, zero, one], -1).reshape(2, 3, 3)
        x, y, z = spin.unbind(-1)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(2, 3, 3)
        R = torch.linalg.matrix_exp(cross) @ self.rotation
        rows = torch.cat([R, shift[..., None]], -1)
        last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 1, 4)
        height, width = (torch.full((1, 2), size, dtype=torch.float64) for size in IMAGE)
        return CameraTensors(K[None], torch.cat([rows, last], -2)[None], height, width)

    def grid(self, pose: Tensor) -> VoxelGrid:
        last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
        return VoxelGrid(SHAPE, LOWER, UPPER, torch.cat([pose, last]))

    def frustum(self, pinhole: Tensor, spin: Tensor, shift: Tensor, depths: Tensor) -> FrustumGrid:
        reference = self.cameras(pinhole, spin, shift)
        return FrustumGrid(CameraTensors(*(field[:, 1] for field in reference)), depths, (2, 2))


def unproject(setup, features, pinhole, spin, shift, pose, **options):
    cameras = setup.cameras(pinhole, spin, shift)
    return functional.unproject(features, cameras, setup.grid(pose), **options).volume


def unproject_frustum(setup, features, pinhole, spin, shift, depths, **options):
    grid = setup.frustum(pinhole, spin, shift, depths)
    return functional.unproject(features, setup.cameras(pinhole, spin, shift), grid, **options).volume[:, :1]


def unproject_points(setup, features, pinhole, spin, shift, points, **options):
    cameras = setup.cameras(pinhole, spin, shift)
    return functional.unproject_points(features, cameras, points, **options).volume


def plane_sweep(setup, volume, pinhole, spin, shift, pose, depths, **options):
    cameras = setup.cameras(pinhole, spin, shift)
    return functional.plane_sweep_project(volume, cameras, setup.grid(pose), depths, (2, 3), **options).maps


def indices(setup: Setup, kind: str) -> np.ndarray:
    """Every index the operator interpolates at, by the oracle."""
    cameras = (setup.pinhole, setup.spin, setup.shift)
    K = setup.cameras(*cameras)
    values = []
    for v in range(2):
        intrinsics = oracle.resize_intrinsics(K.intrinsics[0, v].numpy(), IMAGE, SIZE if kind != "sweep" else (2, 3))
        R, t = K.cam_from_world[0, v, :3, :3].numpy(), K.cam_from_world[0, v, :3, 3].numpy()
        pose = np.vstack([setup.pose.numpy(), [0, 0, 0, 1]])
        if kind == "sweep":
            lattice = oracle.world_from_lattice(SHAPE, np.array(LOWER), np.array(UPPER), pose)
            for depth in PLANES.numpy():
                X = oracle.backproject(intrinsics, R, t, oracle.pixel_lattice((2, 3)), np.full(6, depth))
                values.append(np.linalg.solve(lattice[:3, :3], (X - lattice[:3, 3]).T).ravel())
        else:
            sites = oracle.voxel_sites(SHAPE, np.array(LOWER), np.array(UPPER), pose)
            if kind == "points":
                sites = setup.points[0].numpy()
            elif kind == "frustum":
                sites = setup.frustum(*cameras, PLANES).centers().numpy()
            pixels, depth = oracle.project(intrinsics, R, t, sites.reshape(-1, 3))
            if kind != "frustum" or v == 0:
                values.append(pixels[depth > 0.02].ravel())
    return np.concatenate(values)


@functools.cache
def smooth_setup(kind: str, number: int) -> Setup:
    """The first setup none of whose samples is near a kink."""
    seed = 100 * number
    while True:
        setup = Setup(seed)
        index = indices(setup, kind)
        if np.abs(index - np.round(index)).min() > tolerances.KINK_GUARD:
            return setup
        seed += 1


def leaves(*tensors: Tensor) -> list[Tensor]:
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


OPTIONS = [
    {"padding_mode": "zeros"},
    {"padding_mode": "border", "augment": ("depth", "direction")},
    {"padding_mode": "border", "augment": ("direction",), "direction_frame": "camera"},
]


OPERATORS = {
    "grid": (unproject, lambda setup: (setup.features, setup.pinhole, setup.spin, setup.shift, setup.pose)),
    "frustum": (unproject_frustum, lambda setup: (setup.features, setup.pinhole, setup.spin, setup.shift, PLANES)),
    "points": (unproject_points, lambda setup: (setup.features, setup.pinhole, setup.spin, setup.shift, setup.points)),
    "sweep": (plane_sweep, lambda setup: (setup.volume, setup.pinhole, setup.spin, setup.shift, setup.pose, PLANES)),
}


@pytest.mark.parametrize("kind", OPERATORS)
@pytest.mark.parametrize("number", range(len(OPTIONS)))
def test_gradients_to_every_input(number, kind):
    """The first options entry by entry, the others along random directions."""
    operator, inputs = OPERATORS[kind]
    setup = smooth_setup(kind, number)
    call = functools.partial(operator, setup, **OPTIONS[number])
    assert torch.autograd.gradcheck(call, leaves(*inputs(setup)), fast_mode=number > 0)


@pytest.mark.parametrize("reduce", ["mean", "variance", ("max", "mean")])
def test_reduced_gradients(reduce):
    setup = smooth_setup("grid", 3)
    arguments = leaves(*OPERATORS["grid"][1](setup))
    call = functools.partial(unproject, setup, padding_mode="border", reduce=reduce)
    assert torch.autograd.gradcheck(call, arguments, fast_mode=True)


@needs_second_derivatives
def test_second_derivatives():
    """Features and t, grid pose and t, volume and depths."""
    setup = smooth_setup("grid", 4)

    def of_features(features, shift):
        return unproject(setup, features, setup.pinhole, setup.spin, shift, setup.pose, **OPTIONS[1])

    assert torch.autograd.gradgradcheck(of_features, leaves(setup.features, setup.shift))
    sweep = smooth_setup("sweep", 4)

    def of_volume(volume, depths):
        return plane_sweep(sweep, volume, sweep.pinhole, sweep.spin, sweep.shift, sweep.pose, depths)

    assert torch.autograd.gradgradcheck(of_volume, leaves(sweep.volume, PLANES))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
def test_derivative_at_an_integer_pixel_is_that_of_the_cell_floor(dtype, padding_mode):
    """Sizes that are no power of two: coordinates that make a round trip through [-1, 1] must not fall off."""
    for size in (5, 7, 11, 13):
        row = torch.tensor([3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0, 5.0, 3.0, 5.0, 8.0, 9.0][:size], dtype=dtype)
        x = torch.arange(-1.0, size + 1.0, dtype=dtype)
        points = torch.stack([x, torch.zeros_like(x), torch.ones_like(x)], -1)[None].requires_grad_()
        values, _ = functional.unproject_points(
            row.expand(1, 1, 1, 1, size), plain_camera(dtype, (1, size)), points, padding_mode=padding_mode
        )
        values.sum().backward()
        padded = torch.nn.functional.pad(row, (2, 2))
        expected = padded[2:] - padded[1:-1] if padding_mode == "zeros" else torch.zeros(size + 2, dtype=dtype)
        if padding_mode == "zeros":
            expected = torch.cat([row[:1], padded[3:] - padded[2:-1]])[: size + 2]
        else:
            expected[2:-2] = (row[1:] - row[:-1])[1:]
        torch.testing.assert_close(points.grad[0, :, 0], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivative_at_an_integer_voxel_is_that_of_the_cell_floor(dtype, axis):
    """One ray along z through the voxel centres of a 5-voxel axis; moving the camera moves the index backwards."""
    line = torch.tensor([3.0, 1.0, 4.0, 1.5, 9.0], dtype=dtype)
    shape = [1, 1, 1]
    shape[2 - axis] = 5
    lower, upper = [-0.5] * 3, [0.5] * 3
    lower[axis], upper[axis] = -2.5, 2.5
    lower[2], upper[2] = lower[2] + 3, upper[2] + 3  # centred at depth 3
    grid = VoxelGrid(tuple(shape), tuple(lower), tuple(upper))
    for index in range(5):
        offset = [0.0, 0.0, 0.0]
        offset[axis] = index - 2.0
        pose = torch.eye(4, dtype=dtype)
        pose[:2, 3] = -torch.tensor(offset[:2], dtype=dtype)
        pose = pose[None, None].requires_grad_()
        depth = torch.tensor([3.0 + offset[2]], dtype=dtype, requires_grad=True)
        eye = torch.eye(3, dtype=dtype)[None, None]
        camera = CameraTensors(eye, pose, torch.tensor([[1]]), torch.tensor([[1]]))
        for padding_mode in ("zeros", "border"):
            maps, _ = functional.plane_sweep_project(
                line.reshape(1, 1, *shape), camera, grid, depth, (1, 1), padding_mode=padding_mode
            )
            grads = torch.autograd.grad(maps.sum(), (pose, depth))
            slope = -float(grads[0][0, 0, axis, 3])
            if axis == 2:
                torch.testing.assert_close(float(grads[1]), slope)
            following = float(line[index + 1]) if index < 4 else 0.0
            expected = following - float(line[index])
            if padding_mode == "border" and index in (0, 4):
                expected = 0.0
            np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-4)


def test_nearest_gives_no_gradient_to_geometry_but_to_features():
    setup = smooth_setup("grid", 0)
    arguments = leaves(setup.features, setup.pinhole, setup.spin, setup.shift, setup.pose)
    volume = unproject(setup, *arguments, mode="nearest", padding_mode="border")
    gradients = torch.autograd.grad(volume.sum(), arguments, allow_unused=True, materialize_grads=True)
    np.testing.assert_allclose(gradients[0].sum(), volume.numel(), rtol=1e-12)
    for gradient in gradients[1:]:
        assert not bool(gradient.any())
    sources = leaves(setup.volume, setup.pose, PLANES)
    maps = plane_sweep(
        setup, sources[0], setup.pinhole, setup.spin, setup.shift, *sources[1:], mode="nearest", padding_mode="border"
    )
    swept = torch.autograd.grad(maps.sum(), sources, allow_unused=True, materialize_grads=True)
    np.testing.assert_allclose(swept[0].sum(), maps.numel(), rtol=1e-12)
    assert not bool(swept[1].any())
    assert not bool(swept[2].any())
