"""What holds for V-LSM and D-LSM: masked views change nothing, and every weight learns."""

from __future__ import annotations

import pytest
import torch

from lsmgeo.cameras import CameraTensors
from lsmgeo.models import create
from tests.models.inputs import look


@pytest.fixture(params=[("voxel-lsm", {}), ("depth-lsm", {}), ("depth-lsm", {"skips": False})])
def model(request):
    torch.manual_seed(0)
    name, settings = request.param
    return create(name, preset="tiny", **settings)


def test_what_a_masked_view_holds_reaches_nothing(model):
    mask = torch.tensor([[True, False, True]])

    def everything(filling):
        images, cameras = look(1, 3)
        images[:, 1] = filling
        poses = cameras.cam_from_world.clone()
        poses[:, 1] = filling
        images.requires_grad_()
        model.zero_grad()
        found = model(images, cameras._replace(cam_from_world=poses), mask)[0]
        found.square().sum().backward()
        return [found.detach(), images.grad, *(weights.grad.clone() for weights in model.parameters())]

    clean, dirty = everything(0.5), everything(torch.nan)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(clean, dirty, strict=True))
    assert torch.equal(clean[1][:, 1], torch.zeros_like(clean[1][:, 1]))
    assert all(bool(item.isfinite().all()) for item in clean)


def test_every_weight_learns_and_gradients_reach_the_cameras(model):
    images, cameras = look(1, 3)
    K, E = cameras.intrinsics.clone().requires_grad_(), cameras.cam_from_world.clone().requires_grad_()
    model(images, CameraTensors(K, E, cameras.height, cameras.width))[0].square().mean().backward()
    for name, weights in model.named_parameters():
        assert float(weights.grad.abs().sum()) > 0, name
    for gradient in (K.grad, E.grad):
        assert bool(gradient.isfinite().all())
        assert bool((gradient.abs().sum((-1, -2)) > 0).all())
