"""`torch.func`, double backward, autocast, copies and files of layers, data loaders."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from lsmgeo import (
    CameraTensors,
    FrustumGrid,
    PlaneSweepProject,
    Unproject,
    VoxelGrid,
    depth_planes,
    functional,
)
from lsmgeo import rays as along_rays
from lsmgeo.errors import OptionError
from tests.abilities import needs_second_derivatives
from tests.interop.models import (
    GRID,
    UNPROJECTIONS,
    ThereAndBack,
    arguments,
    assert_same,
    points_arguments,
    read_at_points,
    views,
)

OPTIONS = {"augment": ("depth", "direction"), "padding_mode": "border"}
DEPTHS = depth_planes(1.5, 2.5, 6)


def test_vmap_over_scenes():
    features, K, E, height, width = arguments(3, 2)

    def one(features, K, E):
        scene = CameraTensors(K[None], E[None], 24, 32)
        return functional.unproject(features[None], scene, GRID, **OPTIONS).volume[0]

    expected = functional.unproject(features, CameraTensors(K, E, height, width), GRID, **OPTIONS).volume
    assert expected.abs().sum() > 0
    torch.testing.assert_close(torch.vmap(one)(features, K, E), expected, rtol=1e-5, atol=1e-5)


def test_vmap_over_statistics_and_sweeps():
    features, K, E, height, width = arguments(3, 2)

    def one(features, K, E):
        scene = CameraTensors(K[None], E[None], 24, 32)
        fused = functional.unproject(features[None], scene, GRID, reduce=("mean", "max")).volume
        maps, visible = functional.plane_sweep_project(fused, scene, GRID, DEPTHS, (7, 9))
        added = functional.splat(features[None], scene, GRID, DEPTHS, weights=weights)
        return maps[0], visible[0], added[0]

    weights = torch.rand(1, 2, 6, *features.shape[-2:], generator=torch.Generator().manual_seed(1))
    scenes = CameraTensors(K, E, height, width)
    fused = functional.unproject(features, scenes, GRID, reduce=("mean", "max")).volume
    expected = functional.plane_sweep_project(fused, scenes, GRID, DEPTHS, (7, 9))
    maps, visible, added = torch.vmap(one)(features, K, E)
    splatted = functional.splat(features, scenes, GRID, DEPTHS, weights=weights.expand(3, -1, -1, -1, -1))
    assert splatted.abs().sum() > 0
    torch.testing.assert_close(added, splatted, rtol=1e-5, atol=1e-5)
    assert expected.maps.abs().sum() > 0
    torch.testing.assert_close(maps, expected.maps, rtol=1e-5, atol=1e-5)
    assert torch.equal(visible, expected.visible)


def test_vmap_over_volumes_at_points():
    given = points_arguments(3)

    def one(*scene):
        return read_at_points(*(tensor[None] for tensor in scene))[:, 0]

    expected = read_at_points(*given)
    assert bool((expected.abs().amax((1, 2, 3)) > 0.1).all())
    torch.testing.assert_close(torch.vmap(one, out_dims=1)(*given), expected, rtol=1e-5, atol=1e-5)
    actual = torch.vmap(torch.func.grad(lambda *scene: one(*scene).square().sum(), argnums=4))(*given)
    depths = given[4].clone().requires_grad_()
    energy = read_at_points(*given[:4], depths, given[5]).square().sum()
    torch.testing.assert_close(actual, torch.autograd.grad(energy, depths)[0], rtol=1e-4, atol=1e-4)


def volume_of(features, K, E):
    return functional.unproject(features, CameraTensors(K, E, 24, 32), GRID, **OPTIONS).volume


# PyTorch's own forward-mode formulas are scripts, which warn of their age when first used.
@needs_second_derivatives
@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_forward_mode(dtype):
    """The tangent, in the features' dtype, is the transpose of the gradient."""
    features, K, E = (tensor.to(dtype) for tensor in arguments(2, 3)[:3])
    generator = torch.Generator().manual_seed(1)
    tangents = tuple(torch.randn(tensor.shape, generator=generator, dtype=dtype) for tensor in (features, K, E))
    value, tangent = torch.func.jvp(volume_of, (features, K, E), tangents)
    assert tangent.dtype == value.dtype == dtype
    torch.testing.assert_close(value, volume_of(features, K, E))

    cotangent = torch.randn(value.shape, generator=generator, dtype=dtype)
    _, pull = torch.func.vjp(volume_of, features, K, E)
    products = zip(pull(cotangent), tangents, strict=True)
    expected = sum((gradient * direction).double().sum() for gradient, direction in products)
    actual = (cotangent * tangent).double().sum()
    assert expected.abs() > 1.0
    torch.testing.assert_close(actual, expected, rtol=1e-3 if dtype == torch.float32 else 1e-9, atol=0.0)


@needs_second_derivatives
@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
def test_forward_mode_of_a_sweep():
    volume = torch.rand(2, 4, *GRID.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scenes = views(2, 3, dtype=torch.float64)
    depths = DEPTHS.double()

    def maps_of(volume, depths):
        return functional.plane_sweep_project(volume, scenes, GRID, depths, (7, 9)).maps

    directions = (torch.ones_like(volume), torch.linspace(1.0, 2.0, 6, dtype=torch.float64))
    _, tangent = torch.func.jvp(maps_of, (volume, depths), directions)
    step = 1e-6
    ahead, behind = (maps_of(volume + s * directions[0], depths + s * directions[1]) for s in (step, -step))
    assert tangent.abs().max() > 1.0
    # Finite differences are wrong at kinks, of which there are few.
    difference = ((ahead - behind) / (2.0 * step) - tangent).abs()
    assert (difference < 1e-6).double().mean() > 0.99


def test_functional_gradient_is_the_gradient():
    features, K, E = arguments(2, 3)[:3]

    def energy(features, K, E):
        return volume_of(features, K, E).square().sum()

    actual = torch.func.grad(energy, argnums=(0, 1, 2))(features, K, E)
    leaves = [tensor.clone().requires_grad_() for tensor in (features, K, E)]
    expected = torch.autograd.grad(energy(*leaves), leaves)
    for mine, other in zip(actual, expected, strict=True):
        assert other.abs().max() > 0
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4)


def test_gradients_of_each_scene_at_once():
    features, K, E = arguments(3, 2)[:3]

    def energy(features, K, E):
        return volume_of(features[None], K[None], E[None]).square().sum()

    actual = torch.vmap(torch.func.grad(energy, argnums=2))(features, K, E)
    expected = torch.stack([torch.func.grad(energy, argnums=2)(*scene) for scene in zip(features, K, E, strict=True)])
    assert expected.abs().max() > 0
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


@needs_second_derivatives
def test_double_backward():
    features, K, E = (tensor.double().requires_grad_() for tensor in arguments(1, 2)[:3])

    def gradient(features, K):
        volume = functional.unproject(features, CameraTensors(K, E, 24, 32), GRID, reduce="variance").volume
        return torch.autograd.grad(volume.square().sum(), features, create_graph=True)[0]

    weight = torch.rand(features.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    second = torch.autograd.grad((gradient(features, K) * weight).sum(), (features, K))
    step = 1e-5
    with torch.no_grad():
        ahead, behind = features + step * weight, features - step * weight
    difference = (gradient(ahead.requires_grad_(), K) - gradient(behind.requires_grad_(), K)) / (2.0 * step)
    # The second derivative is symmetric: the gradient of <gradient, w> is the derivative of the gradient along w.
    assert difference.abs().max() > 0.01
    torch.testing.assert_close(second[0], difference, rtol=1e-6, atol=1e-6)
    assert second[1].abs().max() > 0


def test_autocast_leaves_the_reduction_along_rays_alone():
    volume = torch.rand(2, 4, *GRID.shape, generator=torch.Generator().manual_seed(0))
    layer = along_rays.ProjectReduce(4, 3, GRID, DEPTHS, (7, 9))
    expected = layer(volume, views(2, 3)).maps
    with torch.autocast("cpu", dtype=torch.bfloat16):
        actual = layer(volume, views(2, 3)).maps
        assert (volume[0, 0, 0] @ volume[0, 0, 0].mT).dtype == torch.bfloat16  # it is in force
    assert actual.dtype == torch.float32
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(actual, expected, rtol=0, atol=0)


LAYERS = {
    "Unproject": lambda: Unproject(GRID, augment="depth", reduce=("mean", "max")),
    "Unproject to a frustum": lambda: Unproject(FrustumGrid(CameraTensors(*(f[:, 0] for f in views(2, 3))), DEPTHS)),
    "PlaneSweepProject": lambda: PlaneSweepProject(GRID, DEPTHS, (7, 9), flatten=False),
    "ProjectReduce": lambda: along_rays.ProjectReduce(4, 3, GRID, DEPTHS, (7, 9)),
}


def answer(name, layer):
    generator = torch.Generator().manual_seed(0)
    shape = (2, 3, 4, 12, 16) if name.startswith("Unproject") else (2, 4, *GRID.shape)
    return layer(torch.rand(shape, generator=generator), views(2, 3))


@pytest.mark.parametrize("name", LAYERS)
def test_copies_of_layers(name):
    layer = LAYERS[name]()
    copies = {"deepcopy": copy.deepcopy(layer), "pickle": pickle.loads(pickle.dumps(layer))}
    expected = answer(name, layer)
    assert expected[0].abs().sum() > 0
    for made in copies.values():
        assert repr(made) == repr(layer)
        torch.testing.assert_close(tuple(answer(name, made)), tuple(expected), rtol=0, atol=0)


@pytest.mark.parametrize("name", ["Unproject", "Unproject to a frustum", "PlaneSweepProject"])
def test_layers_without_state(name):
    layer = LAYERS[name]()
    assert layer.state_dict() == {}
    assert list(layer.parameters()) == []
    layer.load_state_dict({})
    before = answer(name, layer)
    # Grids and depths are no part of the module: a cast of the module does not round them.
    torch.testing.assert_close(tuple(answer(name, layer.half())), tuple(before), rtol=0, atol=0)


def test_state_of_a_reduction_along_rays():
    first, second = (along_rays.ProjectReduce(4, 3, GRID, DEPTHS, (7, 9)) for _ in range(2))
    state = first.state_dict()
    assert {key: tuple(value.shape) for key, value in state.items()} == {"weight": (3, 24, 1, 1), "bias": (3,)}
    assert not torch.equal(answer("", first).maps, answer("", second).maps)
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    torch.testing.assert_close(answer("", first).maps, answer("", second).maps, rtol=0, atol=0)
    convolution = torch.nn.Conv2d(24, 3, 1)
    convolution.load_state_dict(state)
    assert torch.equal(convolution.weight, first.weight)


def test_options_of_layers_can_be_set():
    layer, other = Unproject(VoxelGrid(3)), Unproject(VoxelGrid(3), mode="nearest", near=0.5)
    layer.mode, layer.near = "nearest", 0.5
    assert repr(layer) == repr(other)
    assert layer.options == other.options
    with pytest.raises(OptionError, match="Unproject: backend must be"):
        layer.backend = "fast"
    assert layer.options == other.options


def test_layers_print_themselves():
    layer = Unproject(VoxelGrid((2, 3, 4)), augment="depth", near=0.5)
    assert repr(layer) == (
        "Unproject(VoxelGrid((2, 3, 4), lower=(-0.5, -0.5, -0.5), upper=(0.5, 0.5, 0.5)), mode='bilinear', "
        "padding_mode='zeros', augment='depth', direction_frame='world', reduce=None, near=0.5, "
        "groups=1, memory_format=None, backend='auto')"
    )


class Scenes(Dataset):
    """Features and cameras of five scenes with three views."""

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> tuple[torch.Tensor, CameraTensors]:
        features, *fields = arguments(1, 3, seed=index)
        return features[0], CameraTensors(*(field[0] for field in fields))


@pytest.mark.parametrize("workers", [0, 1])
def test_a_data_loader_makes_batches_of_cameras(workers):
    loader = DataLoader(
        Scenes(), batch_size=2, num_workers=workers, multiprocessing_context="fork" if workers else None
    )
    batches = list(loader)
    assert [tuple(features.shape[:2]) for features, _ in batches] == [(2, 3), (2, 3), (1, 3)]
    for number, (features, batch) in enumerate(batches):
        assert isinstance(batch, CameraTensors)
        volume = functional.unproject(features, batch, GRID).volume
        for place in range(len(features)):
            alone, scene = Scenes()[2 * number + place]
            lone = CameraTensors(*(field[None] for field in scene))
            expected = functional.unproject(alone[None], lone, GRID).volume[0]
            assert expected.abs().sum() > 0
            torch.testing.assert_close(volume[place], expected, rtol=1e-6, atol=1e-6)


def test_every_unprojection_model_differs():
    """The models that compilers are tested with are different models."""
    given = arguments(2, 3)
    answers = [ThereAndBack(**options)(*given)[2] for options in UNPROJECTIONS.values()]
    assert len({tuple(answer.shape) for answer in answers}) == 3
    assert_same(ThereAndBack()(*given), ThereAndBack()(*given), tolerance=0.0)
