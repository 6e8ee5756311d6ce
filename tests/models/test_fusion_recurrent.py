"""The recurrent fusions against their equations, and what holds for any number of views."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.fusion import ConvGRU3d, ConvLSTM3d
from tests.models.inputs import count
from tests.models.recurrences import run_gru, run_lstm
from tests.tolerances import TERMWISE

RECURRENCES = (ConvGRU3d, ConvLSTM3d)


def build(recurrence, **options):
    torch.manual_seed(0)
    module = recurrence(3, 2, **options)
    for name, parameter in module.named_parameters():
        if "norm" in name:  # gains of 1 and shifts of 0 would hide where they go
            torch.nn.init.uniform_(parameter, 0.5, 1.5)
    return module


def volumes(*shape, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1), dtype=dtype)


def widened(weight):
    """A kernel as one of 3^3 that is 0 beside its middle."""
    return weight if weight.ndim != 5 or weight.shape[-1] == 3 else np.pad(weight, ((0, 0),) * 2 + ((1, 1),) * 3)


@pytest.mark.parametrize(("recurrence", "run"), [(ConvGRU3d, run_gru), (ConvLSTM3d, run_lstm)])
@pytest.mark.parametrize("kernels", [(3, None), (1, None), (1, 3), (3, 1)])
def test_states_are_those_of_the_equations(recurrence, run, kernels):
    module = build(recurrence, kernel_size=kernels[0], state_kernel_size=kernels[1], eps=1e-3).double()
    volume = volumes(2, 3, 3, 3, 2, 4, dtype=torch.float64)
    weights = {name: widened(value.numpy()) for name, value in module.state_dict().items()}
    expected = np.stack([np.stack(run(scene, weights, 2, 1e-3)) for scene in volume.numpy()])
    found = module.states(volume).detach().numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(module(volume).detach().numpy(), found[:, -1])


def test_a_gru_of_constants_in_closed_form():
    """Without norm, one voxel, kernel 1 and all weights 0 but the candidate's bias: h = (1 - 2^-n) tanh(b)."""
    module = ConvGRU3d(1, 1, kernel_size=1, norm=False)
    for parameter in module.parameters():
        torch.nn.init.zeros_(parameter)
    with torch.no_grad():
        module.input.bias[2] = 0.7
    states = module.states(torch.zeros(1, 4, 1, 1, 1, 1)).flatten()
    torch.testing.assert_close(states, torch.tensor([0.5, 0.75, 0.875, 0.9375]) * np.tanh(0.7))


@pytest.mark.parametrize("recurrence", RECURRENCES)
@pytest.mark.parametrize("norm", [True, False])
def test_a_state_knows_nothing_of_later_views(recurrence, norm):
    module, volume = build(recurrence, norm=norm), volumes(2, 5, 3, 4, 4, 4)
    found = module.states(volume)
    torch.testing.assert_close(module.states(volume[:, :3]), found[:, :3], rtol=0, atol=TERMWISE[torch.float32])
    changed = volume.clone()
    changed[:, 3:] += 1.0
    assert torch.equal(module.states(changed)[:, :3], found[:, :3])
    assert not torch.allclose(module.states(changed)[:, 3:], found[:, 3:])


@pytest.mark.parametrize("recurrence", RECURRENCES)
def test_states_stay_in_range(recurrence):
    module = build(recurrence)
    states = module.states(100.0 * volumes(1, 12, 3, 4, 4, 4))
    assert states.abs().max() <= 1.0
    assert states.abs().max() > 0.5


@pytest.mark.parametrize("recurrence", RECURRENCES)
def test_a_masked_view_is_not_there(recurrence):
    module = build(recurrence)
    volume = volumes(2, 4, 3, 4, 4, 4)
    mask = torch.tensor([[False, True, False, True], [True, True, False, False]])
    found = module.states(volume, None, mask)
    assert torch.equal(found[0, 0], torch.zeros_like(found[0, 0]))
    assert torch.equal(found[0, 2], found[0, 1])
    assert torch.equal(found[1, 2], found[1, 1])
    assert torch.equal(found[1, 3], found[1, 1])
    first = module.states(volume[:1, [1, 3]])
    second = module.states(volume[1:, :2])
    torch.testing.assert_close(found[0, [1, 3]], first[0], rtol=0, atol=TERMWISE[torch.float32])
    torch.testing.assert_close(found[1, :2], second[0], rtol=0, atol=TERMWISE[torch.float32])


@pytest.mark.parametrize("recurrence", RECURRENCES)
def test_what_a_masked_view_holds_reaches_nothing(recurrence):
    mask = torch.tensor([[True, False, True]])

    def gradients(filling):
        module, volume = build(recurrence), volumes(1, 3, 3, 4, 4, 4)
        volume[:, 1] = filling
        volume.requires_grad_()
        states = module.states(volume, None, mask)
        states.square().sum().backward()
        return [states.detach(), volume.grad, *(parameter.grad for parameter in module.parameters())]

    clean, dirty = gradients(0.0), gradients(torch.nan)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(clean, dirty, strict=True))
    assert torch.equal(clean[1][:, 1], torch.zeros_like(clean[1][:, 1]))
    assert all(float(item.abs().sum()) > 0 for item in clean)


@pytest.mark.parametrize("recurrence", RECURRENCES)
def test_gradients_are_those_of_differences(recurrence):
    module = build(recurrence, eps=1e-2).double()
    volume = volumes(1, 2, 3, 2, 2, 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: module.states(x), (volume,), atol=1e-7)


def test_counts_of_parameters():
    assert count(ConvGRU3d(33, 32)) == 168_672
    # 27 (33 + 32) 4 32 weights, 5 norms of 2 x 32
    assert count(ConvLSTM3d(33, 32)) == 224_960


@pytest.mark.parametrize("recurrence", RECURRENCES)
def test_arguments_are_checked(recurrence):
    with pytest.raises(OptionError, match="kernel_size must be odd; got 2"):
        recurrence(3, 2, kernel_size=2)
    with pytest.raises(OptionError, match="state_kernel_size must be odd; got 4"):
        recurrence(3, 2, state_kernel_size=4)
    with pytest.raises(OptionError, match="hidden_channels must be a whole number"):
        recurrence(3, 0)
    module = recurrence(3, 2)
    with pytest.raises(ShapeError, match=r"C = 3; got \(1, 2, 4, 2, 2, 2\)"):
        module(torch.zeros(1, 2, 4, 2, 2, 2))
    with pytest.raises(ShapeError, match="V at least 1"):
        module(torch.zeros(1, 0, 3, 2, 2, 2))
    with pytest.raises(DTypeError, match="view_mask must be a bool tensor"):
        module(torch.zeros(1, 2, 3, 2, 2, 2), None, torch.ones(1, 2))
