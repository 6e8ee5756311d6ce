"""Depths that differ from pixel to pixel: frustums of them, and sweeps, by the oracle."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import lsmgeo
from lsmgeo import FrustumGrid, PlaneSweepProject, Unproject, VoxelGrid, functional
from lsmgeo.errors import GridError, ShapeError
from tests import oracle
from tests.abilities import needs_second_derivatives
from tests.kernels import cases
from tests.property import support
from tests.strategies import scenes

SIZE = (3, 4)
PLANES = 3


def pixel_depths(scene, *views):
    """(B, ..., P, h, w), in no order, some of them equal."""
    random = np.random.default_rng(scene.seed + 5)
    depths = random.uniform(0.3, 4.0, (scene.batch, *views, PLANES, *SIZE))
    depths[..., 1, :, :2] = depths[..., 0, :, :2]
    return depths


def backprojected(scene, view, depths):
    """World points (B, P, h, w, 3) of depths (B, P, h, w) of one view's pixels."""
    pixels = np.tile(oracle.pixel_lattice(SIZE), (PLANES, 1))
    points = []
    for b in range(scene.batch):
        K = oracle.resize_intrinsics(scene.intrinsics[b, view], tuple(scene.image_sizes[b, view]), SIZE)
        R, t = scene.rotations[b, view], scene.translations[b, view]
        points.append(oracle.backproject(K, R, t, pixels, depths[b].reshape(-1)))
    return np.stack(points).reshape(scene.batch, PLANES, *SIZE, 3)


def frustum(scene, depths, view=0):
    return FrustumGrid(support.cameras(scene).at((slice(None), view)), torch.from_numpy(depths))


@given(scenes(placements=("facing", "grazing", "inside")))
def test_sites_are_the_backprojected_pixels(scene):
    depths = pixel_depths(scene)
    grid = frustum(scene, depths)
    assert grid.shape == (PLANES, *SIZE)
    support.assert_within(support.array(grid.centers()), backprojected(scene, 0, depths), 1e-8)


@given(scenes(placements=("facing", "grazing")), st.sampled_from([(), ("depth", "direction")]), st.booleans())
def test_unproject_by_the_oracle(scene, augment, masked):
    depths = pixel_depths(scene)
    mask = scene.view_mask if masked else None
    options = {"padding_mode": "border", "augment": augment}
    expected = oracle.unproject(
        scene.features, scene.intrinsics, scene.rotations, scene.translations, scene.image_sizes,
        backprojected(scene, 0, depths).reshape(scene.batch, -1, 3), view_mask=mask, **options,
    )  # fmt: skip
    volume, visible = functional.unproject(
        torch.from_numpy(scene.features), support.cameras(scene), frustum(scene, depths),
        view_mask=None if mask is None else torch.from_numpy(mask), **options,
    )  # fmt: skip
    # Next to the camera's centre, or to the plane through it, rounding decides.
    values, seen = support.array(volume.flatten(3)), visible.flatten(2).numpy()
    sites = backprojected(scene, 0, depths).reshape(scene.batch, -1, 3)
    certain = support.is_certain(support.geometry(scene, torch.float64, sites), scene.size)
    np.testing.assert_array_equal(seen[certain], expected.visible[certain])
    clear = np.broadcast_to(certain[:, :, None], values.shape)
    support.assert_within(values[clear], expected.values[clear], 1e-6)


@given(scenes(placements=("facing", "grazing")), st.sampled_from([(), ("depth", "direction")]))
def test_sweep_by_the_oracle(scene, augment):
    """Pixel by pixel: each has the planes of its own depths."""
    depths = pixel_depths(scene, scene.views)
    maps, visible = functional.plane_sweep_project(
        torch.from_numpy(scene.volume), support.cameras(scene), support.grid(scene), torch.from_numpy(depths),
        flatten=False, padding_mode="border", augment=augment,
    )  # fmt: skip
    assert tuple(visible.shape) == depths.shape
    for j, i in ((0, 0), (1, 3), (2, 2)):
        expected = oracle.plane_sweep(
            scene.volume, scene.intrinsics, scene.rotations, scene.translations, scene.image_sizes,
            scene.lattice, depths[..., j, i], SIZE, padding_mode="border", augment=augment,
        )  # fmt: skip
        support.assert_within(support.array(maps[..., j, i]), expected.values[..., j, i], 1e-7)


@support.FEWER
@given(scenes(placements=("facing", "grazing")), st.sampled_from([torch.float64, torch.float32]))
def test_the_same_depths_at_all_pixels_are_planes(scene, dtype):
    exact = scene.rounded(dtype)
    depths = torch.tensor([0.7, 1.9, 3.1], dtype=dtype)
    features, cameras, _ = support.inputs(exact, dtype)
    own = cameras.at((slice(None), 0))
    options = {"padding_mode": "border", "augment": ("depth", "direction")}
    planes, seen = functional.unproject(features, cameras, FrustumGrid(own, depths, SIZE), **options)
    pixels = depths[:, None, None].expand(scene.batch, 3, *SIZE)
    found, visible = functional.unproject(features, cameras, FrustumGrid(own, pixels), **options)
    assert float((visible != seen).double().mean()) < 0.05  # but for rounding at edges
    close = ((found - planes).abs() < (1e-7 if dtype == torch.float64 else 3e-2)).double().mean()
    assert float(close) > 0.95


def test_gradients_to_the_depths_of_pixels():
    camera = cases.CAMERA.to(torch.float64)
    views = cases.VIEWS.to(torch.float64)
    features = cases.FEATURES.double()
    depths = cases.PIXEL_DEPTHS[:, 0, :2].double().requires_grad_()

    def unproject(depths):
        return functional.unproject(
            features, views, FrustumGrid(camera, depths), augment=("depth", "direction"), padding_mode="border"
        ).volume

    assert torch.autograd.gradcheck(unproject, depths, fast_mode=True)

    own = cases.PIXEL_DEPTHS[:, :, :2].double().requires_grad_()
    assert torch.autograd.gradcheck(_sweep, own, fast_mode=True)


def _sweep(depths):
    views = cases.VIEWS.to(torch.float64)
    return functional.plane_sweep_project(
        cases.VOLUME.double(), views, cases.GRID, depths, augment=("depth", "direction"), padding_mode="border"
    ).maps


@needs_second_derivatives
def test_second_derivatives_to_the_depths_of_pixels():
    own = cases.PIXEL_DEPTHS[:, :, :2].double().requires_grad_()
    assert torch.autograd.gradgradcheck(_sweep, own, fast_mode=True, atol=1e-3)


def test_planes_may_come_in_any_order():
    order = torch.tensor([2, 0, 3, 1])
    depths = cases.PIXEL_DEPTHS[:, 0]
    volume, visible = functional.unproject(cases.FEATURES, cases.VIEWS, FrustumGrid(cases.CAMERA, depths))
    moved, seen = functional.unproject(cases.FEATURES, cases.VIEWS, FrustumGrid(cases.CAMERA, depths[:, order]))
    support.assert_same(moved, volume[:, :, :, order])
    support.assert_same(seen, visible[:, :, order])


def test_slabs_are_the_whole():
    grid = FrustumGrid(cases.CAMERA, cases.PIXEL_DEPTHS[:, 0])
    options = {"reference": cases.PLANE_REFERENCES[:, : cases.C], "groups": cases.C, "augment": ("depth", "direction")}
    volume, visible = functional.unproject(cases.FEATURES, cases.VIEWS, grid, **options)
    for start, part, seen in functional.unproject_slabs(cases.FEATURES, cases.VIEWS, grid, 3, **options):
        support.assert_same(part, volume[:, :, :, start : start + 3])
        support.assert_same(seen, visible[:, :, start : start + 3])


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e20, 3e38])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_extreme_depths_give_finite_answers(scale, backend):
    for depths in (scale, scale * torch.rand(2, 4, *cases.SIZE).clamp_min(0.1)):
        depths = (torch.zeros(2, 4, *cases.SIZE) + depths).requires_grad_()
        features = cases.FEATURES.clone().requires_grad_()
        grid = FrustumGrid(cases.CAMERA, depths)
        volume, _ = functional.unproject(
            features, cases.VIEWS, grid, augment=("depth", "direction"), padding_mode="border", backend=backend
        )
        assert bool(volume.isfinite().all())
        volume[:, :, : cases.C].sum().backward()
        assert bool(features.grad.isfinite().all())
        assert bool(depths.grad.isfinite().all())


@pytest.mark.parametrize("scale", [1e-12, 1e-19, 3e-23, 1e-30, 1e-38])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_directions_next_to_the_camera_are_unit_vectors_or_0(scale, backend):
    depths = torch.full((2, 4, *cases.SIZE), scale).clamp_min(torch.finfo(torch.float32).tiny).requires_grad_()
    poses = cases.CAMERA.cam_from_world.clone().requires_grad_()
    volume, _ = functional.unproject(
        cases.FEATURES[:, :1], cases.CAMERA._replace(cam_from_world=poses), FrustumGrid(cases.CAMERA, depths),
        augment="direction", backend=backend,
    )  # fmt: skip
    directions = volume[:, :, cases.C :]
    expected = torch.ones(2, 1, 4, *cases.SIZE) if scale > 2.0**-59 else torch.zeros(2, 1, 4, *cases.SIZE)
    torch.testing.assert_close(directions.norm(dim=2), expected, rtol=0, atol=1e-6)
    weights = torch.rand(directions.shape, generator=torch.Generator().manual_seed(1))
    for gradient in torch.autograd.grad((directions * weights).sum(), (depths, poses)):
        assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_depths_of_a_masked_scene_are_not_read(backend):
    depths = cases.PIXEL_DEPTHS[:, 0].clone()
    depths[1] = torch.nan
    depths.requires_grad_()
    mask = torch.tensor([[True, False, True], [False] * 3])
    grid = FrustumGrid(cases.CAMERA, depths)
    volume, visible = functional.unproject(
        cases.FEATURES, cases.VIEWS, grid, view_mask=mask, augment=("depth", "direction"), backend=backend
    )
    assert bool(visible[0].any())
    (gradient,) = torch.autograd.grad(volume.square().sum(), depths)
    assert float(gradient[0].abs().max()) > 0.1
    assert not bool(gradient[1].any())  # nor NaN


@pytest.mark.parametrize("scale", [1e-300, 1e-42, 1e50])
def test_depths_beyond_float32_saturate(scale):
    near = 0.5 * float(torch.finfo(torch.float32).tiny)
    own = torch.full(cases.PIXEL_DEPTHS.shape, scale, dtype=torch.float64)
    answers = []
    for backend in ("auto", "reference"):
        depths, shared = own.clone().requires_grad_(), own[:, 0].clone().requires_grad_()
        maps, seen = functional.plane_sweep_project(
            cases.VOLUME, cases.VIEWS, cases.GRID, depths, near=near, augment="depth", flatten=False, backend=backend
        )
        volume, visible = functional.unproject(
            cases.FEATURES, cases.VIEWS, FrustumGrid(cases.CAMERA, shared), augment="depth", backend=backend
        )
        answers.append((maps, seen, volume, visible))
        gradients = torch.autograd.grad(maps.sum() + volume[:, :, : cases.C].sum(), (depths, shared))
        for tensor in (maps, volume, *gradients):
            assert bool(tensor.isfinite().all())
    assert bool((answers[0][0][:, :, -1] > 0).all())
    support.assert_same(answers[0][1], answers[1][1])
    torch.testing.assert_close(answers[0], answers[1], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_bad_depths_are_named(value, backend):
    depths = cases.PIXEL_DEPTHS.clone()
    depths[1, 2, 3, 4, 4] = value
    depths[1, 2, 3, 4, 5:] = -2.0  # later: the first is named
    message = re.escape(f"depths must be positive and finite; got {value:.6g} at [1, 3, 4, 4]") + "$"
    grid = FrustumGrid(cases.CAMERA, depths[:, 2])
    with pytest.raises(GridError, match=f"^Unproject: {message}"):
        Unproject(grid, backend=backend)(cases.FEATURES, cases.VIEWS)
    with pytest.raises(GridError, match=f"^unproject_slabs: {message}"):  # at the call
        functional.unproject_slabs(cases.FEATURES, cases.VIEWS, grid, 3, backend=backend)
    with pytest.raises(GridError, match=f"^FrustumGrid: {message}"):
        grid.centers()
    message = message.replace("1,", "1,\\ 2,", 1)
    with pytest.raises(GridError, match=f"^PlaneSweepProject: {message}"):
        PlaneSweepProject(cases.GRID, depths, backend=backend)
    project = PlaneSweepProject(cases.GRID, backend=backend)
    with pytest.raises(GridError, match=f"^PlaneSweepProject: {message}"):
        project(cases.VOLUME, cases.VIEWS, depths=depths)
    mask = torch.ones(2, 3, dtype=torch.bool)
    mask[1, 2] = False
    maps, visible = project(cases.VOLUME, cases.VIEWS, mask, depths=depths)  # of a masked view they are not read
    assert bool(maps.isfinite().all())
    assert bool(visible.any())


def test_shapes_are_checked():
    depths = cases.PIXEL_DEPTHS
    with pytest.raises(
        ShapeError, match=re.escape("size must be that of the depths of each pixel, (5, 6); got (5, 7)")
    ):
        FrustumGrid(cases.CAMERA, depths[:, 0], (5, 7))
    with pytest.raises(ShapeError, match=re.escape("PlaneSweepProject: size must be that of the depths of each pixel")):
        PlaneSweepProject(cases.GRID, depths, (5, 7))
    with pytest.raises(ShapeError, match=re.escape("depths must be (B, P, h, w) with B = 2 cameras; got (1, 4, 5, 6)")):
        FrustumGrid(cases.CAMERA, depths[:1, 0])
    with pytest.raises(ShapeError, match=re.escape("depths must be (P,), (B, P) or (B, P, h, w) with P at least 1")):
        FrustumGrid(cases.CAMERA, depths)
    with pytest.raises(ShapeError, match=re.escape("depths must be (B, V, P, h, w) with (B, V) = (2, 3)")):
        functional.plane_sweep_project(cases.VOLUME, cases.VIEWS, cases.GRID, depths[:, :2])
    with pytest.raises(ShapeError, match=re.escape("depths must be (P,), (B, P), (B, V, P) or (B, V, P, h, w)")):
        functional.plane_sweep_project(cases.VOLUME, cases.VIEWS, cases.GRID, depths[:, 0])
    with pytest.raises(
        ShapeError, match=re.escape("(P,), (B, P) or (B, V, P), the same for all pixels, with P at least")
    ):
        lsmgeo.rays.project_reduce(cases.VOLUME, cases.VIEWS, cases.GRID, depths, cases.WEIGHT)


def test_nothing_to_sample():
    camera = cases.CAMERA.at(slice(0, 0))
    grid = FrustumGrid(camera, torch.ones(0, 2, *SIZE))
    volume, visible = functional.unproject(cases.FEATURES[:0], cases.VIEWS.at(slice(0, 0)), grid)
    assert tuple(volume.shape) == (0, 3, cases.C, 2, *SIZE)
    assert tuple(visible.shape) == (0, 3, 2, *SIZE)
    maps, _ = functional.plane_sweep_project(
        cases.VOLUME[:, :0], cases.VIEWS, cases.GRID, torch.ones(2, 3, 2, *SIZE), flatten=False
    )
    assert tuple(maps.shape) == (2, 3, 0, 2, *SIZE)


def test_a_known_sample():
    """The camera looks along -x from x = 2; pixel (1, 1) is on the axis."""
    camera = lsmgeo.cameras.orbit(torch.tensor([0.0]), 0.0, 2.0, focal_length=8.0, height=3, width=3)
    grid = VoxelGrid(4)
    volume = grid.centers()[..., 0][None, None]  # each voxel holds its x
    depths = torch.full((1, 1, 2, 3, 3), 1.0)
    depths[0, 0, :, 1, 1] = torch.tensor([2.25, 1.875])
    maps, visible = functional.plane_sweep_project(volume, camera, grid, depths)
    support.assert_known(maps[0, 0, :, 1, 1], torch.tensor([-0.25, 0.125]))
    assert visible[0, 0, :, 0, 0].tolist() == [False, False]
