"""On a GPU: analytic scenes give the pictures of a CPU, whatever TF32 says."""

from __future__ import annotations

import pytest
import torch

from lsmgeo import scenes
from lsmgeo.cameras import orbit, to
from lsmgeo.scenes import synthetic13

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("precision", ["highest", "high"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pictures_are_those_of_a_cpu(precision, dtype):
    shapes = [synthetic13.shape(0, index) for index in range(5)]
    solids = [shape.scene for shape in shapes]
    views = orbit(torch.tensor([[0.0, 70.0, 200.0]]).expand(5, 3), 20.0, 2.0, focal_length=90.0, height=48, width=48)
    sun = scenes.Lights(torch.tensor([[0.0, 1.0, 0.0]]), torch.full((1, 3), 0.6), torch.full((3,), 0.3))
    expected = scenes.render(solids, views, sun, shadows=True, dtype=dtype)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        found = scenes.render(solids, to(views, device="cuda"), sun, shadows=True, dtype=dtype)
    finally:
        torch.set_float32_matmul_precision(before)
    assert found.depth.is_cuda
    # Rounding differs between the devices, and decides at silhouettes and at shadows' edges.
    same = (found.mask.cpu() == expected.mask) & torch.isclose(found.depth.cpu(), expected.depth, atol=1e-4)
    assert float(same.double().mean()) > 0.999
    colours = torch.isclose(found.images.cpu(), expected.images, atol=1e-3).all(2)
    assert float(colours.double().mean()) > 0.995


def test_occupancy_is_that_of_a_cpu():
    solids = [synthetic13.shape(0, index).scene for index in range(3)]
    points = torch.rand(3, 1000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    found = scenes.occupancy(solids, points.cuda()).cpu()
    assert torch.equal(found, scenes.occupancy(solids, points))
