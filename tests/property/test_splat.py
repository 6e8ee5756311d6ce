"""Splat: the oracle, the adjoint of the plane sweep, known numbers, gradients, what is not read, and bad input."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import CameraTensors, FrustumGrid, Splat, VoxelGrid, functional
from lsmgeo.errors import DTypeError, GridError, LsmGeoError, OptionError, ShapeError
from tests import oracle
from tests.kernels import cases
from tests.property import support
from tests.property.test_plane_sweep import sweeps, swept_points
from tests.property.test_unproject import plain_camera

MODES = {"mode": st.sampled_from(("trilinear", "nearest")), "padding_mode": st.sampled_from(("zeros", "border"))}
SIZE = (5, 4)


def random_maps(scene, depths, channels=2):
    """Features (B, V, C, h, w), weights (B, V, P, h, w), and depths of each pixel about the planes."""
    random = np.random.default_rng(scene.seed + 7)
    features = random.uniform(-1, 1, (*depths.shape[:2], channels, *SIZE))
    weights = random.uniform(0, 1, (*depths.shape, *SIZE))
    return features, weights, depths[..., None, None] * random.uniform(0.8, 1.2, weights.shape)


def splat(scene, values, depths, weights=None, **options):
    arrays = [None if array is None else torch.from_numpy(array) for array in (values, depths, weights)]
    return functional.splat(
        arrays[0], support.cameras(scene), support.grid(scene), arrays[1], weights=arrays[2], **options
    )


@given(sweeps(), st.fixed_dictionaries(MODES), st.booleans(), st.booleans(), st.booleans())
def test_splat_is_the_oracle(drawn, modes, weighted, per_pixel, masked):
    scene, planes = drawn
    features, weights, pixels = random_maps(scene, planes)
    depths = pixels if per_pixel else np.broadcast_to(planes[..., None, None], pixels.shape)
    if modes["mode"] == "nearest":  # not next to the borders of cells, where rounding decides
        _, index, _ = pixel_index(scene, depths)
        weights = np.where(np.abs(index - np.round(index + 0.5) + 0.5).min(-1) < 1e-6, 0.0, weights)
    mask = scene.view_mask if masked else None
    products = features[:, :, :, None] * weights[:, :, None]
    expected = oracle.splat(
        products, scene.intrinsics, scene.rotations, scene.translations, scene.image_sizes, scene.lattice, depths,
        scene.shape, view_mask=mask, **modes,
    )  # fmt: skip
    modes["view_mask"] = None if mask is None else torch.from_numpy(mask)
    given_depths = depths.copy() if per_pixel else planes
    if weighted:
        volume = splat(scene, features, given_depths, weights, **modes)
    else:
        volume = splat(scene, products, given_depths, **modes)
    support.assert_within(support.array(volume), expected, 1e-7 * weights.size)


def pixel_index(scene, depths):
    """As `swept_points`, at depths (B, V, P, h, w): the lattice index (B, V, P, h, w, 3)."""
    shape = depths.shape
    found = np.empty((*shape, 3))
    for j, i in np.ndindex(shape[3:]):
        points, index, inverse = swept_points(scene, depths[..., j, i], SIZE)
        found[..., j, i, :] = index.reshape(*shape[:3], *SIZE, 3)[..., j, i, :]
    return points, found, inverse


@given(sweeps(), st.fixed_dictionaries(MODES), st.booleans(), st.booleans())
def test_it_is_the_adjoint_of_the_plane_sweep(drawn, modes, weighted, per_pixel):
    """To 1e-12 of the sum of the terms' magnitudes."""
    scene, planes = drawn
    features, weights, pixels = random_maps(scene, planes, scene.channels)
    depths = torch.from_numpy(pixels if per_pixel else planes)
    products = torch.from_numpy(features[:, :, :, None] * weights[:, :, None])
    volume, cameras, grid = torch.from_numpy(scene.volume), support.cameras(scene), support.grid(scene)

    def projected(source):
        return functional.plane_sweep_project(source, cameras, grid, depths, SIZE, flatten=False, **modes).maps

    if weighted:
        summed = splat(scene, features, depths.numpy(), weights, **modes)
    else:
        summed = splat(scene, products.numpy(), depths.numpy(), **modes)
    terms = float((projected(volume.abs()) * products.abs()).sum())
    difference = float((projected(volume) * products).sum() - (volume * summed).sum())
    assert abs(difference) <= 1e-12 * terms


BACKENDS = ["reference", "auto"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_the_nearest_is_an_indexed_sum_of_the_outer_product(backend, dtype):
    """At ``floor((X - lower) / step)`` of the frustums' centres; integers exactly, others to 1e-5 of their sum."""
    random = torch.Generator().manual_seed(4)
    B, V, C, P, size = 2, 3, 5, 7, (6, 9)
    views = cases.VIEWS.map(torch.Tensor.double)
    grid = VoxelGrid((5, 2, 8), (-0.61, -0.53, -0.72), (0.55, 0.47, 0.63))
    depths = torch.linspace(0.9, 2.7, P, dtype=torch.float64)
    sites = [FrustumGrid(views.at((slice(None), v)), depths, size).centers() for v in range(V)]
    sites = torch.stack(sites, 1)  # (B, V, P, h, w, 3)
    lower, upper = torch.as_tensor(grid.lower), torch.as_tensor(grid.upper)
    index = (sites - lower) / ((upper - lower) / torch.tensor(grid.shape[::-1]))
    clear = ((index - index.round()).abs() > 1e-4).all(-1)  # cells, from a border
    assert clear.double().mean() > 0.99
    cell = index.floor().long()
    inside = ((cell >= 0) & (cell < torch.tensor(grid.shape[::-1]))).all(-1)
    assert 0.05 < inside.double().mean() < 0.95
    flat = (cell[..., 2] * grid.shape[1] + cell[..., 1]) * grid.shape[2] + cell[..., 0]

    def both(features, weights):
        weights = torch.where(clear, weights, 0)
        outer = (features[:, :, :, None] * weights[:, :, None]).movedim(2, -1).double()
        expected = torch.stack([
            torch.zeros(40 * 2, C, dtype=torch.float64).index_add(0, flat[b][inside[b]], outer[b][inside[b]])
            for b in range(B)
        ])  # fmt: skip
        volume = functional.splat(features, views, grid, depths, weights=weights, mode="nearest", backend=backend)
        assert volume.dtype == dtype
        return volume.movedim(1, -1).flatten(1, 3).double(), expected

    integers = [torch.randint(-4, 5, (B, V, n, *size), generator=random).to(dtype) for n in (C, P)]
    found, expected = both(*integers)
    assert expected.any()
    assert torch.equal(found, expected)
    if dtype == torch.float32:
        features, weights = (torch.randn(B, V, n, *size, generator=random) for n in (C, P))
        found, expected = both(features, weights)
        _, magnitudes = both(features.abs(), weights.abs())
        assert bool(((found - expected).abs() <= 1e-5 * magnitudes).all())


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_weights_of_one_sample_are_known(dtype):
    """A feature of 2 with weight 3 at lattice (0.5, 0.25, 0.125) of 2 x 2 x 2 voxels."""
    grid = VoxelGrid(2, lower=(-1.0, -0.75, 0.375), upper=(1.0, 1.25, 2.375))
    feature, weight = torch.full((1, 1, 1, 1, 1), 2.0, dtype=dtype), torch.full((1, 1, 1, 1, 1), 3.0, dtype=dtype)
    camera, depth = plain_camera(dtype, (1, 1)), torch.ones(1, dtype=dtype)
    x, y, z = (torch.tensor([1 - a, a], dtype=dtype) for a in (0.5, 0.25, 0.125))
    expected = 6.0 * (z[:, None, None] * y[:, None] * x)[None, None]
    torch.testing.assert_close(Splat(grid, depth)(feature, camera, weights=weight), expected)
    nearest = Splat(grid, depth, mode="nearest")(feature, camera, weights=weight).flatten().tolist()
    assert nearest == [0.0, 6.0, *(0.0,) * 6]  # floor(0.5 + 0.5) is the second voxel


@pytest.mark.parametrize("backend", BACKENDS)
def test_many_small_numbers_are_not_lost_in_half_precision(backend):
    """A sum in float16 would stay at 2048."""
    camera = plain_camera(torch.float32, (64, 64))
    grid = VoxelGrid(1, lower=-100.0, upper=100.0)
    ones = torch.ones(1, 1, 1, 1, 64, 64, dtype=torch.float16)
    volume = functional.splat(ones, camera, grid, torch.ones(1), mode="nearest", backend=backend)
    assert volume.item() == 4096.0
    large = functional.splat(100.0 * ones, camera, grid, torch.ones(1), mode="nearest", backend=backend)
    assert large.item() == torch.finfo(torch.float16).max


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("per_pixel", [True, False])
def test_gradients(weighted, per_pixel):
    """To features, weights, K, R, t, depths and the grid's pose, by finite differences."""
    random = torch.Generator().manual_seed(2)
    size, planes = (2, 3), 2
    depths = 1.3 + 0.7 * torch.rand((1, 2, planes, *size) if per_pixel else (planes,), generator=random).double()
    depths = depths if per_pixel else depths.sort().values
    features = torch.randn(1, 2, 2, *(() if weighted else (planes,)), *size, generator=random).double()
    weights = torch.rand(1, 2, planes, *size, generator=random).double()
    views = cases.VIEWS.at(slice(0, 1)).map(torch.Tensor.double)
    views = CameraTensors(*(field[:, :2] for field in views))
    leaves = [features, views.intrinsics, views.cam_from_world, depths, cases.POSE.double()]
    leaves = [leaf.clone().requires_grad_() for leaf in (*leaves, *([weights] if weighted else []))]

    def run(features, K, E, depths, pose, weights=None):
        grid = VoxelGrid((3, 2, 3), -0.7, 0.7, pose)
        moved = views._replace(intrinsics=K, cam_from_world=E)
        # The last rows of K and E do not enter: `project` maps their perturbations to nothing.
        return functional.splat(features, moved, grid, depths, weights=weights)

    with torch.no_grad():
        assert run(*leaves).abs().sum() > 1.0
    free = [0, 3, 5] if weighted else [0, 3]
    chosen = [leaves[number] for number in free]

    def of_free(*values):
        every = list(leaves)
        for number, value in zip(free, values, strict=True):
            every[number] = value
        return run(*every)

    assert torch.autograd.gradcheck(of_free, chosen, eps=1e-7, atol=1e-5)
    # Cameras and pose move as they may: rotated a little, shifted, their upper rows.
    steps = torch.randn(4, generator=random).double()

    def of_geometry(step):
        every = list(leaves)
        turn = torch.linalg.matrix_exp(torch.stack([
            torch.stack([0 * step[0], -step[0], step[1]]),
            torch.stack([step[0], 0 * step[0], -step[2]]),
            torch.stack([-step[1], step[2], 0 * step[0]]),
        ]))  # fmt: skip
        E, shift = leaves[2].detach(), step[3] * torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
        upper = torch.cat((turn @ E[..., :3, :3], (E[..., :3, 3] + shift)[..., None]), -1)
        every[2] = torch.cat((upper, E[..., 3:, :]), -2)
        scale = torch.cat((torch.ones(2, 3).double() * (1.0 + 0.1 * step[0]), torch.ones(1, 3).double()))
        every[1] = leaves[1].detach() * scale
        every[4] = leaves[4].detach() + torch.nn.functional.pad(0.1 * step[3:4, None].expand(3, 4), (0, 0, 0, 1))
        return run(*every)

    assert torch.autograd.gradcheck(of_geometry, (0.01 * steps).requires_grad_(), eps=1e-7, atol=1e-4)


def test_second_derivatives():
    weights = torch.rand(2, 3, 5, *cases.SIZE).double().requires_grad_()
    depths = cases.DEPTHS.double().requires_grad_()
    volume = functional.splat(cases.MAPS.double(), cases.VIEWS, cases.GRID, depths, weights=weights)
    (first,) = torch.autograd.grad(volume.square().sum(), depths, create_graph=True)
    second = torch.autograd.grad(first.sum(), (depths, weights))
    assert all(bool(part.isfinite().all()) and bool(part.any()) for part in second)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
def test_masked_views_and_planes_behind_are_unread(backend, padding_mode):
    features, weights = cases.MAPS.clone(), cases.SHARES.clone()
    options = {"padding_mode": padding_mode, "near": 1.2, "backend": backend}
    expected = functional.splat(features, *cases.SPLAT, weights=weights, view_mask=cases.MASK, **options)
    assert expected.any()
    features[~cases.MASK] = torch.nan
    weights[~cases.MASK] = torch.nan
    weights[:, :, cases.DEPTHS <= 1.2] = torch.inf
    K = torch.where(cases.MASK[..., None, None], cases.VIEWS.intrinsics, torch.nan)
    leaves = [leaf.requires_grad_() for leaf in (features, weights, K)]
    views = cases.VIEWS._replace(intrinsics=K)
    found = functional.splat(features, views, *cases.SPLAT[1:], weights=weights, view_mask=cases.MASK, **options)
    assert torch.equal(found, expected)
    for gradient in torch.autograd.grad(found.sum(), leaves):
        assert bool(gradient[cases.MASK].any())
        assert not gradient[~cases.MASK].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mode", ["trilinear", "nearest"])
def test_a_nan_reaches_only_the_voxels_it_is_added_to(mode, backend):
    """Neither another scene, nor the gradients at samples outside the volume; nor does one in the incoming gradient."""
    grid = VoxelGrid((1, 1, 4), lower=(-2.0, -0.5, 0.5), upper=(2.0, 0.5, 1.5))
    camera = plain_camera(torch.float32, (1, 1))
    camera = CameraTensors(
        *(torch.as_tensor(field).expand(2, 1, *torch.as_tensor(field).shape[2:]) for field in camera)
    )
    depths = torch.tensor([1.0, 3.0])  # the second is outside
    features, weights = torch.ones(2, 1, 1, 1, 1), torch.ones(2, 1, 2, 1, 1)
    features[1] = torch.nan
    leaves = [leaf.requires_grad_() for leaf in (features, weights)]
    volume = functional.splat(features, camera, grid, depths, weights=weights, mode=mode, backend=backend)
    expected = [0.0, 0.5, 0.5, 0.0] if mode == "trilinear" else [0.0, 0.0, 1.0, 0.0]
    assert volume[0].flatten().tolist() == expected
    assert volume[1].isnan().flatten().tolist() == [value > 0 for value in expected]
    cotangent = torch.ones_like(volume)
    cotangent[0, ..., 0] = torch.nan  # read by no sample
    to_features, to_weights = torch.autograd.grad(volume, leaves, cotangent)
    assert to_features.flatten().tolist() == [1.0, 1.0]
    assert to_weights[:, 0, 1].flatten().tolist() == [0.0, 0.0]
    assert to_weights[0, 0, 0].item() == 1.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_batches_are_loops_and_views_add_up(backend):
    whole = functional.splat(cases.MAPS, *cases.SPLAT, weights=cases.SHARES, backend=backend)
    for b in range(cases.B):
        total = torch.zeros_like(whole[b])
        for v in range(cases.V):
            one = slice(b, b + 1), slice(v, v + 1)
            camera = CameraTensors(*(field[one] for field in cases.VIEWS))
            total += functional.splat(
                cases.MAPS[one], camera, *cases.SPLAT[1:], weights=cases.SHARES[one], backend=backend
            )[0]
        torch.testing.assert_close(whole[b], total, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_scenes_and_no_channels(backend):
    views = CameraTensors(*(field[:0] for field in cases.VIEWS))
    options = {"backend": backend}
    found = functional.splat(cases.MAPS[:0], views, *cases.SPLAT[1:], weights=cases.SHARES[:0], **options)
    assert found.shape == (0, cases.C, *cases.GRID.shape)
    maps = cases.MAPS[:, :, :0].requires_grad_()
    shares = cases.SHARES.clone().requires_grad_()
    found = functional.splat(maps, *cases.SPLAT, weights=shares, **options)
    assert found.shape == (cases.B, 0, *cases.GRID.shape)
    found.sum().backward()
    assert not shares.grad.any()


def test_a_layer_follows_its_call():
    layer = Splat(padding_mode="border", near=0.5)
    assert layer.state_dict() == {}
    assert "mode='trilinear', padding_mode='border', near=0.5" in repr(layer)
    with pytest.raises(GridError, match="Splat: grid must be given to the layer or to the call; got None"):
        layer(cases.MAPS, cases.VIEWS, weights=cases.SHARES)
    found = layer(cases.MAPS, cases.VIEWS, cases.MASK, weights=cases.SHARES, grid=cases.GRID, depths=cases.DEPTHS)
    options = {"view_mask": cases.MASK, "padding_mode": "border", "near": 0.5}
    assert torch.equal(found, functional.splat(cases.MAPS, *cases.SPLAT, weights=cases.SHARES, **options))
    layer.mode = "nearest"
    assert layer.options.mode == "nearest"


BAD = {
    "weights of another dtype": (
        {"weights": cases.SHARES.double()}, DTypeError,
        "Splat: weights must be of the features' torch.float32; got torch.float64",
    ),
    "weights of other planes": (
        {"weights": cases.SHARES[:, :, :3]}, ShapeError,
        "Splat: weights must be (B, V, P, h, w) = (2, 3, 5, 5, 6); got (2, 3, 3, 5, 6)",
    ),
    "no weights": (
        {"weights": None}, ShapeError,
        "got (2, 3, 5, 5, 6) without weights",
    ),
    "weights and planes": (
        {"features": cases.PLANE_MAPS}, ShapeError,
        "Splat: features must be (B, V, C, h, w) with B*V = 6 cameras; got (2, 3, 15, 5, 5, 6)",
    ),
    "other planes": (
        {"features": cases.PLANE_MAPS[:, :, :, :2], "weights": None}, ShapeError,
        "Splat: features must be (B, V, C, P, h, w) with the depths' P = 5; got (2, 3, 15, 2, 5, 6)",
    ),
    "a frustum": (
        {"grid": FrustumGrid(cases.CAMERA, cases.DEPTHS)}, DTypeError, "Splat: grid must be a VoxelGrid; got",
    ),
    "pixels of another size": (
        {"depths": cases.PIXEL_DEPTHS[..., :4]}, ShapeError,
        "Splat: depths must be (B, V, P, h, w) with the features' (h, w) = (5, 6); got (2, 3, 4, 5, 4)",
    ),
    "descending": (
        {"depths": cases.DEPTHS.flip(0)}, GridError, "Splat: depths must be positive, finite and strictly ascending",
    ),
    "a negative depth of a pixel": (
        {"depths": torch.where(cases.PIXEL_DEPTHS > 2.5, -1.0, cases.PIXEL_DEPTHS), "weights": cases.SHARES[:, :, :4]},
        GridError, "Splat: depths must be positive and finite; got -1",
    ),
    "mode": ({"mode": "bilinear"}, OptionError, "Splat: mode must be one of 'trilinear', 'nearest'"),
}  # fmt: skip


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, backend):
    changes, error, text = BAD[name]
    right = {"features": cases.MAPS, "cameras": cases.VIEWS, "grid": cases.GRID, "depths": cases.DEPTHS}
    assert issubclass(error, LsmGeoError)
    with pytest.raises(error, match=re.escape(text)):
        functional.splat(**{**right, "weights": cases.SHARES, "backend": backend, **changes})
