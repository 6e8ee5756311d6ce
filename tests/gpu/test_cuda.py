"""On a GPU: the same values and gradients as on a CPU, whatever TF32 says, and no waiting for the device."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from lsmgeo import FrustumGrid, VoxelGrid, depth_planes, functional
from lsmgeo.cameras import CameraTensors, orbit, to

pytestmark = pytest.mark.gpu

VIEWS = orbit(torch.tensor([[0.0, 40.0, 80.0], [10.0, 50.0, 200.0]]), 10.0, 2.0, focal_length=50.0, height=24, width=32)
FEATURES = torch.rand(2, 3, 4, 12, 16, generator=torch.Generator().manual_seed(0))
VOLUME = torch.rand(2, 4, 5, 6, 7, generator=torch.Generator().manual_seed(1))
GRID = VoxelGrid((5, 6, 7))
PLANES = depth_planes(1.5, 2.5, 8)


@pytest.fixture(params=["highest", "high"])
def _precision(request: pytest.FixtureRequest) -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(request.param)
    yield
    torch.set_float32_matmul_precision(before)


def lifted(features: torch.Tensor, views: CameraTensors, **options: object) -> torch.Tensor:
    return functional.unproject(features, views, GRID, augment=("depth", "direction"), **options).volume


def swept(volume: torch.Tensor, views: CameraTensors, **options: object) -> torch.Tensor:
    return functional.plane_sweep_project(
        volume, views, GRID, PLANES.to(volume.device), (9, 11), augment="direction", **options
    ).maps


def matched(features: torch.Tensor, views: CameraTensors, **options: object) -> torch.Tensor:
    reference = CameraTensors(*(torch.as_tensor(field)[:, 0] for field in views))
    frustum = FrustumGrid(reference, PLANES.to(features.device), (9, 11))
    return functional.unproject(features, views, frustum, reduce="variance", padding_mode="border", **options).volume


def at_points(volume: torch.Tensor, views: CameraTensors, **options: object) -> torch.Tensor:
    reference = CameraTensors(*(torch.as_tensor(field)[:, 0] for field in views))
    points = GRID.centers().reshape(1, -1, 3).expand(2, -1, 3).to(volume.device)
    frustum = FrustumGrid(reference, PLANES.to(volume.device)[:5], (6, 7))
    read = [functional.sample_volume(volume, grid, 1.1 * points, **options).values for grid in (GRID, frustum)]
    return torch.stack(read)


def added(features: torch.Tensor, views: CameraTensors, **options: object) -> torch.Tensor:
    weights = torch.linspace(0.1, 1.0, 8, device=features.device)[:, None, None].expand(2, 3, 8, 12, 16)
    return functional.splat(features, views, GRID, PLANES.to(features.device), weights=weights, **options)


CASES = {
    "added": (added, FEATURES),
    "lifted": (lifted, FEATURES),
    "swept": (swept, VOLUME),
    "matched": (matched, FEATURES),
    "at points": (at_points, VOLUME),
}


@pytest.mark.usefixtures("_precision")
@pytest.mark.parametrize("case", CASES)
def test_a_gpu_computes_what_a_cpu_does(case):
    run, source = CASES[case]
    answers = []
    for device in ("cpu", "cuda"):
        leaf = source.to(device).requires_grad_()
        views = to(VIEWS, device)
        E = views.cam_from_world.clone().requires_grad_()
        answer = run(leaf, views._replace(cam_from_world=E))
        cotangent = torch.rand(answer.shape, generator=torch.Generator().manual_seed(2)).to(device)
        gradients = torch.autograd.grad(answer, (leaf, E), cotangent)
        answers.append([tensor.detach().cpu() for tensor in (answer, *gradients)])
    for expected, found in zip(*answers, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("case", ["lifted", "swept"])
def test_no_call_waits_for_the_device(case):
    run, source = CASES[case]
    leaf, views = source.cuda().requires_grad_(), to(VIEWS, "cuda")
    expected = run(leaf, views).detach().cpu()
    planes_on_device = PLANES.cuda()  # a depth table of the caller's is where the caller put it
    torch.cuda.set_sync_debug_mode("error")
    try:
        if case == "swept":
            answer = functional.plane_sweep_project(
                leaf, views, GRID, planes_on_device, (9, 11), augment="direction"
            ).maps
        else:
            answer = run(leaf, views)
        answer.sum().backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.testing.assert_close(answer.detach().cpu(), expected, rtol=0, atol=0)
