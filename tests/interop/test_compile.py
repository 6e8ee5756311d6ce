"""`torch.compile`, `torch.export` and ONNX give what eager mode gives."""

from __future__ import annotations

import io

import pytest
import torch

from lsmgeo import CameraTensors, FrustumGrid, Unproject, VoxelGrid, depth_planes, functional, rays
from lsmgeo.errors import CameraError
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

# One model always, all of them in the long run: each takes seconds to trace.
ONE_SOON_ALL_LATER = ["augmented", *(pytest.param(name, marks=pytest.mark.long) for name in ("reduced", "nearest"))]
SIZES = ((1, 1), (1, 4), (4, 5), (3, 2))


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def test_one_graph_of_any_number_of_scenes_and_views():
    graphs = []

    def backend(graph, _):
        graphs.append(graph)
        return graph

    model = ThereAndBack(augment=("depth", "direction"))
    compiled = torch.compile(model, fullgraph=True, backend=backend, dynamic=True)
    # Numbers that are no other size in the graph, which would be taken for the same.
    for size in ((7, 11), (11, 8), (13, 10)):
        given = arguments(*size)
        assert_same(compiled(*given), model(*given))
    assert len(graphs) == 1


def assert_same_gradients(compiled, energy, leaves):
    actual, expected = (torch.autograd.grad(run(*leaves), leaves) for run in (compiled, energy))
    for mine, other in zip(actual, expected, strict=True):
        assert other.abs().max() > 0
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4)


def test_gradients_of_a_graph():
    def energy(features, K, E):
        volume, _ = functional.unproject(features, CameraTensors(K, E, 24, 32), GRID, reduce=("mean", "max"))
        return volume.square().sum()

    leaves = [tensor.requires_grad_() for tensor in arguments(2, 3)[:3]]
    compiled = torch.compile(energy, fullgraph=True, backend="aot_eager")
    assert_same_gradients(compiled, energy, leaves)


def matching_costs(features, K, E, depths, reference):
    """Depths of pixels and correlation, what a cascade computes, and a splat."""
    cameras = CameraTensors(K, E, 24, 32)
    grid = FrustumGrid(CameraTensors(K[:, 0], E[:, 0], 24, 32), depths)
    cost = functional.unproject(features, cameras, grid, reference=reference, groups=2, reduce=("mean", "max"))
    own = depths[:, None].expand(-1, features.shape[1], -1, -1, -1)
    maps = functional.plane_sweep_project(cost.volume, cameras, VoxelGrid(grid.shape), own)
    added = functional.splat(features[..., :5, :6], cameras, VoxelGrid(grid.shape), own, weights=1.0 / own)
    return cost.volume, maps.maps, added


def matching_inputs():
    features, K, E, *_ = arguments(2, 3)
    generator = torch.Generator().manual_seed(3)
    depths = 1.5 + torch.rand(2, 4, 5, 6, generator=generator)
    return features, K, E, depths, torch.rand(2, features.shape[2], 1, 5, 6, generator=generator)


def test_depths_of_pixels_and_correlation_compile():
    def energy(*leaves):
        return sum(answer.square().sum() for answer in matching_costs(*leaves))

    leaves = [tensor.requires_grad_() for tensor in matching_inputs()]
    compiled = torch.compile(energy, fullgraph=True, backend="aot_eager")
    assert_same_gradients(compiled, energy, leaves)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_depths_of_pixels_and_correlation_export():
    class Costs(torch.nn.Module):
        def forward(self, *given):
            return matching_costs(*given)

    given = matching_inputs()
    program = torch.export.export(Costs(), given)
    for found, expected in zip(program.module()(*given), matching_costs(*given), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
        assert expected.abs().sum() > 0


def test_volumes_at_points_compile():
    """One graph, with its gradients, for any number of scenes."""

    def energy(*leaves):
        return read_at_points(*leaves).square().sum()

    compiled = torch.compile(energy, fullgraph=True, backend="aot_eager", dynamic=True)
    for scenes in (2, 3):
        leaves = [tensor.requires_grad_() for tensor in points_arguments(scenes)]
        assert_same_gradients(compiled, energy, leaves)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_volumes_at_points_export():
    class Read(torch.nn.Module):
        def forward(self, *given):
            return read_at_points(*given)

    given = points_arguments(2)
    found, expected = torch.export.export(Read(), given).module()(*given), read_at_points(*given)
    assert bool((expected.abs().amax((1, 2, 3)) > 0.1).all())
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", UNPROJECTIONS)
def test_one_graph(name):
    model = ThereAndBack(**UNPROJECTIONS[name])
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    for size in ((2, 3), (3, 2)):
        given = arguments(*size)
        assert_same(compiled(*given), model(*given))


class Rest(torch.nn.Module):
    """The operators that the other model does not hold."""

    def __init__(self) -> None:
        super().__init__()
        self.reduce = rays.ProjectReduce(2, 3, GRID, depth_planes(1.5, 2.5, 6), size=(7, 9))

    def forward(self, features, intrinsics, cam_from_world, height, width, points):
        cameras = CameraTensors(intrinsics, cam_from_world, height, width)
        sampled = functional.unproject_points(features, cameras, points, augment="direction", reduce="mean")
        pixels, depth = points[:, None, :, :2] * 5.0 + 5.0, points[:, None, :, 2]
        pixels, depth = (tensor.expand(-1, features.shape[1], *tensor.shape[2:]) for tensor in (pixels, depth))
        read = functional.sample_views(features, pixels, depth, depth > 0.1)
        first = CameraTensors(*(field[:, 0] for field in cameras))
        cost = functional.unproject(
            features, cameras, FrustumGrid(first, depth_planes(1.5, 2.5, 4), (6, 8)), reduce="variance"
        )
        volume = functional.unproject(features, cameras, GRID, reduce="mean").volume
        maps = self.reduce(volume, cameras)
        return (*sampled, *read, *cost, *maps)


@pytest.mark.long
def test_one_graph_of_the_other_operators():
    model = Rest()
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    given = (*arguments(2, 3), torch.rand(2, 11, 3, generator=torch.Generator().manual_seed(0)) - 0.3)
    expected = model(*given)
    assert all(tensor.float().abs().sum() > 0 for tensor in expected)
    torch.testing.assert_close(compiled(*given), expected, rtol=1e-4, atol=1e-4)


def test_generated_code():
    layer = Unproject(VoxelGrid(3))
    given = arguments(1, 2)
    volume, visible = torch.compile(lambda f, *c: layer(f, CameraTensors(*c)), fullgraph=True)(*given)
    expected = layer(given[0], CameraTensors(*given[1:]))
    torch.testing.assert_close(volume, expected.volume, rtol=1e-5, atol=1e-5)
    assert torch.equal(visible, expected.visible)
    assert volume.abs().sum() > 0


@pytest.mark.long
@pytest.mark.parametrize("name", UNPROJECTIONS)
def test_generated_code_of_both_operators(name):
    model = ThereAndBack(**UNPROJECTIONS[name])
    compiled = torch.compile(model, fullgraph=True)
    for size in ((2, 3), (3, 2), (4, 5)):
        given = arguments(*size)
        assert_same(compiled(*given), model(*given))


def test_sizes_that_values_decide_are_asked_for():
    project = torch.compile(
        lambda volume, *c: functional.plane_sweep_project(volume, CameraTensors(*c), GRID, depth_planes(1.0, 2.0, 3)),
        fullgraph=True,
        backend="eager",
    )
    # PyTorch 2.6 does not quote the exception that it observed.
    message = "size must be given|Observed exception"
    with pytest.raises((CameraError, torch._dynamo.exc.TorchDynamoException), match=message):
        project(torch.rand(1, 2, *GRID.shape), *views(1, 2))


def dynamic_shapes():
    scenes, count = torch.export.Dim("scenes", min=1, max=64), torch.export.Dim("views", min=1, max=64)
    return ({0: scenes, 1: count},) * 5


@pytest.mark.timeout(600)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("name", ONE_SOON_ALL_LATER)
def test_export_and_onnx(name, tmp_path):
    """A program for any number of scenes and views, through its file and back; and the same program as ONNX."""
    model = ThereAndBack(**UNPROJECTIONS[name]).eval()
    program = torch.export.export(model, arguments(2, 3), dynamic_shapes=dynamic_shapes())
    file = io.BytesIO()
    torch.export.save(program, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    for size in SIZES:
        given = arguments(*size, seed=3)
        assert_same(loaded(*given), model(*given))

    onnxruntime = pytest.importorskip("onnxruntime", reason="the onnx extra is not installed")
    pytest.importorskip("onnxscript", reason="the onnx extra is not installed")
    torch.onnx.export(program, dynamo=True, opset_version=20, verbose=False).save(tmp_path / "model.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "model.onnx"), providers=["CPUExecutionProvider"])
    names = [item.name for item in session.get_inputs()]
    for size in ((2, 3), *SIZES):
        given = arguments(*size, seed=5)
        answers = session.run(None, {key: tensor.numpy() for key, tensor in zip(names, given, strict=True)})
        assert_same([torch.from_numpy(answer) for answer in answers], model(*given), tolerance=1e-4)


def test_cameras_are_a_pytree():
    class Layer(torch.nn.Module):
        def forward(self, features, cameras):
            return functional.unproject(features, cameras, GRID)

    features, *fields = arguments(2, 3)
    cameras = CameraTensors(*fields)
    program = torch.export.export(Layer(), (features, cameras))
    actual, expected = program.module()(features, cameras), Layer()(features, cameras)
    torch.testing.assert_close(tuple(actual), tuple(expected))
