"""What the reference holds: no volumes of all views where views are reduced, no stacked channels where rays are.

Sizes are counted, not measured: every tensor that an operation makes, and every tensor kept for backward.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lsmgeo import FrustumGrid, VoxelGrid, cameras, depth_planes, functional, rays
from lsmgeo.kernels import Options
from lsmgeo.kernels.native import library

V, C, P = 12, 16, 24
MAP = (20, 26)
GRID = VoxelGrid((18, 20, 22))
VIEWS = cameras.orbit(30.0 * torch.arange(V)[None].float(), 20.0, 2.0, focal_length=40.0, height=24, width=32)
DEPTHS = depth_planes(1.0, 3.0, P)
GENERATOR = torch.Generator().manual_seed(0)
FEATURES = torch.rand(1, V, C, 12, 16, generator=GENERATOR)
SWEPT_GRID = VoxelGrid((6, 7, 8))
VOLUME = torch.rand(1, C, *SWEPT_GRID.shape, generator=GENERATOR)
WEIGHT = torch.rand(3, C * P, generator=GENERATOR)

SITES = torch.Size(GRID.shape).numel()
ALL_VIEWS = V * C * SITES  # elements of the volumes of all views
STACKED = V * C * P * MAP[0] * MAP[1]  # elements of the swept maps


class Largest(TorchDispatchMode):
    """Records the most elements that one operation's result takes of its own: a view takes none."""

    def __init__(self) -> None:
        super().__init__()
        self.elements = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self.elements = max(self.elements, leaf.untyped_storage().nbytes() // leaf.element_size())
        return result


def largest(run: Callable[[], Tensor], backward: bool) -> int:
    """Elements of the largest tensor made in forward, or in backward with everything recomputed there."""
    with Largest() as record:
        answer = run()
    if not backward:
        return record.elements
    with Largest() as record:
        answer.sum().backward()
    return record.elements


def kept(run: Callable[[], Tensor]) -> int:
    """Elements kept for backward, each storage once."""
    storages: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage.data_ptr()] = storage.nbytes() // tensor.element_size()
        return tensor

    with saved_tensors_hooks(pack, lambda tensor: tensor):
        answer = run()
    total = sum(storages.values())
    assert answer.requires_grad
    return total


def leaf(tensor: Tensor) -> Tensor:
    return tensor.clone().requires_grad_()


def reduced(names, features=None) -> Tensor:
    return functional.unproject(leaf(FEATURES) if features is None else features, VIEWS, GRID, reduce=names).volume


def swept() -> Tensor:
    return rays.project_reduce(leaf(VOLUME), VIEWS, SWEPT_GRID, DEPTHS, leaf(WEIGHT), None, MAP).maps


def test_the_counters_count():
    features = leaf(FEATURES)
    assert largest(lambda: functional.unproject(features, VIEWS, GRID).volume, backward=False) >= ALL_VIEWS

    def statistics() -> Tensor:
        return functional.view_statistics(*functional.unproject(features, VIEWS, GRID), "variance")

    def convolution() -> Tensor:
        maps = functional.plane_sweep_project(leaf(VOLUME), VIEWS, SWEPT_GRID, DEPTHS, MAP).maps
        assert maps.numel() == STACKED
        return torch.nn.functional.conv2d(maps[0], leaf(WEIGHT)[..., None, None])

    assert kept(statistics) >= ALL_VIEWS
    assert largest(convolution, backward=False) >= STACKED
    assert kept(convolution) >= STACKED


@pytest.mark.parametrize("names", ["mean", "variance", "max", ("mean", "variance", "max")])
class TestReductionOverViews:
    def test_nothing_of_all_views_is_made(self, names):
        for backward in (False, True):
            assert largest(lambda: reduced(names), backward) <= ALL_VIEWS / 4

    def test_nothing_of_all_views_is_kept(self, names):
        # The features themselves, and matrices.
        assert kept(lambda: reduced(names)) <= 2 * FEATURES.numel() + 1e4

    def test_the_answer_is_that_of_the_whole_volumes(self, names):
        features, whole = leaf(FEATURES), leaf(FEATURES)
        answer = reduced(names, features)
        volume, visible = functional.unproject(whole, VIEWS, GRID)
        expected = functional.view_statistics(volume, visible, names)
        torch.testing.assert_close(answer, expected)
        cotangent = torch.rand(answer.shape, generator=torch.Generator().manual_seed(1))
        answer.backward(cotangent)
        expected.backward(cotangent)
        assert features.grad.abs().max() > 0
        torch.testing.assert_close(features.grad, whole.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("names", ["mean", "variance"])
def test_correlations_are_reduced_without_volumes_of_all_views(names):
    frustum = FrustumGrid(VIEWS.at((slice(None), 0)), DEPTHS, MAP)
    volumes = (V - 1) * C * P * MAP[0] * MAP[1]
    own = torch.rand(1, C, 1, *MAP, generator=torch.Generator().manual_seed(2))

    def correlated(reference: Tensor) -> Tensor:
        return functional.unproject(
            leaf(FEATURES), VIEWS, frustum, reference=reference, groups=4, reduce=names, backend="reference"
        ).volume

    for backward in (False, True):
        assert largest(lambda: correlated(leaf(own)), backward) <= volumes / 3
    assert kept(lambda: correlated(leaf(own))) <= 2 * FEATURES.numel() + own.numel() + 1e4


class TestReductionOverRays:
    def test_the_channels_are_never_stacked(self):
        for backward in (False, True):
            assert largest(swept, backward) <= STACKED / 4

    def test_the_channels_are_not_kept(self):
        assert kept(swept) <= VOLUME.numel() + WEIGHT.numel() + 1e4

    def test_no_tensor_of_one_views_channels(self):
        """With one view too, no tensor of C*P*h*w elements is made."""
        one = cameras.CameraTensors(*(field[:, :1] for field in VIEWS))

        def run() -> Tensor:
            return rays.project_reduce(leaf(VOLUME), one, SWEPT_GRID, DEPTHS, leaf(WEIGHT), None, MAP).maps

        for backward in (False, True):
            assert largest(run, backward) <= C * P * MAP[0] * MAP[1] / 2

    def test_the_answer_is_that_of_a_convolution(self):
        volume, whole = leaf(VOLUME), leaf(VOLUME)
        weight, kernel = leaf(WEIGHT), leaf(WEIGHT)
        bias = torch.tensor([1.0, -2.0, 3.0])
        answer = rays.project_reduce(volume, VIEWS, SWEPT_GRID, DEPTHS, weight, bias, MAP)
        maps, visible = functional.plane_sweep_project(whole, VIEWS, SWEPT_GRID, DEPTHS, MAP)
        expected = torch.nn.functional.conv2d(maps.flatten(0, 1), kernel[..., None, None], bias)[None]
        torch.testing.assert_close(answer.maps, expected, rtol=1e-4, atol=1e-4)
        assert torch.equal(answer.visible, visible)
        cotangent = torch.rand(expected.shape, generator=torch.Generator().manual_seed(1))
        answer.maps.backward(cotangent)
        expected.backward(cotangent)
        assert weight.grad.abs().max() > 1.0
        torch.testing.assert_close(weight.grad, kernel.grad, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(volume.grad, whole.grad, rtol=1e-3, atol=1e-3)


@pytest.mark.skipif(library.why_not("splat", FEATURES, Options("trilinear")) is not None, reason="no C++ kernels")
def test_features_times_weights_are_never_held():
    """Nor does backward."""
    weights = torch.rand(1, V, P, 12, 16, generator=GENERATOR)

    def splatted(backend: str) -> Tensor:
        arguments = VIEWS, SWEPT_GRID, DEPTHS
        return functional.splat(leaf(FEATURES), *arguments, weights=leaf(weights), backend=backend)

    product = FEATURES.numel() * P
    assert largest(lambda: splatted("reference"), backward=False) >= product
    for backward in (False, True):
        assert largest(lambda: splatted("cpu"), backward) <= product / 8
    assert kept(lambda: splatted("cpu")) <= FEATURES.numel() + weights.numel() + 1e4


def test_slabs_hold_one_slab():
    def run() -> Tensor:
        for _, volume, _ in functional.unproject_slabs(FEATURES, VIEWS, GRID, 2):
            assert volume.shape[3] <= 2
        return volume

    assert largest(run, backward=False) <= 2 * ALL_VIEWS / GRID.shape[0]
