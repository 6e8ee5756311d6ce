"""Correlation with a reference: group means of reference times sample, for every option of `unproject`."""

from __future__ import annotations

import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import FrustumGrid, Unproject, VoxelGrid, cameras, depth_planes, functional
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from tests.kernels import cases
from tests.property import support
from tests.strategies import scenes

BACKENDS = ("auto", "reference")


def group_means(volume, reference, groups):
    """(B, V, C, ...) and (B, C, ...) -> (B, V, groups, ...)."""
    return (volume * reference[:, None]).unflatten(2, (groups, -1)).mean(3)


@given(
    scenes(),
    st.sampled_from(["bilinear", "nearest"]),
    st.sampled_from(["zeros", "border"]),
    st.sampled_from([(), ("depth",), ("direction", "depth")]),
    st.booleans(),
    st.booleans(),
    st.data(),
)
def test_it_is_the_group_means_of_the_products(scene, mode, padding, augment, masked, per_plane, data):
    features, views, grid = support.inputs(scene)
    groups = data.draw(st.sampled_from([n for n in range(1, scene.channels + 1) if scene.channels % n == 0]))
    planes = scene.shape[0] if per_plane else 1
    reference = torch.rand(
        scene.batch, scene.channels, planes, *scene.shape[1:], dtype=torch.float64,
        generator=torch.Generator().manual_seed(scene.seed),
    ) - 0.5  # fmt: skip
    options = {"mode": mode, "padding_mode": padding, "augment": augment}
    if masked:
        options["view_mask"] = torch.from_numpy(scene.view_mask)
    volume, visible = functional.unproject(features, views, grid, **options)
    found, seen = functional.unproject(features, views, grid, reference=reference, groups=groups, **options)
    support.assert_same(seen, visible)
    C = scene.channels
    torch.testing.assert_close(
        found[:, :, :groups], group_means(volume[:, :, :C], reference, groups), rtol=0, atol=1e-12
    )
    support.assert_same(found[:, :, groups:], volume[:, :, C:])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("names", ["mean", ("variance", "max"), ("max", "mean", "variance")])
@pytest.mark.parametrize("augment", [(), ("depth", "direction")])
def test_statistics_are_those_of_the_correlations(names, augment, backend):
    features = torch.cat((cases.FEATURES, 0.5 + cases.FEATURES[:, :, :1]), 2)
    reference = cases.REFERENCE[:, :6]
    grid = FrustumGrid(cases.CAMERA, cases.PIXEL_DEPTHS[:, 0])
    options = {"reference": reference, "groups": 3, "augment": augment, "view_mask": cases.MASK, "backend": backend}
    volume, visible = functional.unproject(features, cases.VIEWS, grid, **options)
    found, seen = functional.unproject(features, cases.VIEWS, grid, reduce=names, **options)
    support.assert_same(seen, visible)
    expected = functional.view_statistics(volume, visible, names)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    assert found[:, :3].abs().max() > 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_known_numbers(backend):
    """A camera against itself on its own frustum reads its own pixels: |f|^2 / C, and its halves."""
    camera = cameras.orbit(torch.zeros(1), 20.0, 2.0, focal_length=8.0, height=3, width=4)
    features = torch.tensor([1.0, 2.0, 3.0, 4.0])[:, None, None] * torch.arange(1.0, 13.0).reshape(3, 4)
    grid = FrustumGrid(camera, depth_planes(1.0, 3.0, 2))
    options = {"padding_mode": "border", "backend": backend}
    for groups, expected in ((1, [7.5]), (2, [2.5, 12.5]), (4, [1.0, 4.0, 9.0, 16.0])):
        volume, visible = functional.unproject(
            features[None, None], camera, grid, reference=features[None, :, None], groups=groups, **options
        )
        squares = torch.arange(1.0, 13.0).reshape(3, 4).square()
        wanted = torch.tensor(expected)[:, None, None, None] * squares.expand(2, 3, 4)
        torch.testing.assert_close(volume[0, 0], wanted, rtol=1e-5, atol=1e-4)
        assert bool(visible.all())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("reduce", [None, "mean", "variance"])
def test_hidden_sites_do_not_read_the_reference(reduce, backend):
    camera = cameras.orbit(torch.tensor([[0.0, 180.0]]), 0.0, 0.2, focal_length=8.0, height=6, width=7)
    grid = VoxelGrid((3, 4, 5))  # half of it is behind each camera
    features = torch.rand(1, 2, 4, 6, 7, requires_grad=True)
    mask = torch.tensor([[True, False]])
    depth = functional.unproject(features, camera, grid, augment="depth").volume[:, 0, -1]
    behind = depth <= 0
    assert 0 < int(behind.sum()) < behind.numel()
    reference = torch.where(behind[:, None], torch.nan, torch.rand(1, 4, 3, 4, 5)).requires_grad_()
    volume, _ = functional.unproject(
        features, camera, grid, view_mask=mask, reference=reference, reduce=reduce, backend=backend
    )
    assert bool(volume.isfinite().all())
    own = volume[:, 0] if reduce is None else volume
    assert bool((own[behind[:, None]] == 0).all())
    for gradient in torch.autograd.grad(volume.sum(), (features, reference)):
        assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("reduce", [None, "mean", ("variance", "max")])
@pytest.mark.parametrize("planes", [1, 4])
def test_gradients(reduce, planes):
    views, camera = cases.VIEWS.to(torch.float64), cases.CAMERA.to(torch.float64)
    depths = cases.PIXEL_DEPTHS[:, 0].double().requires_grad_()
    features = cases.FEATURES[:, :, :4].double().requires_grad_()
    reference = cases.PLANE_REFERENCES[:, :4, :planes].double().requires_grad_()

    def run(features, reference, depths, E):
        moved = views._replace(cam_from_world=E)
        return functional.unproject(
            features, moved, FrustumGrid(camera, depths), reference=reference, groups=2, reduce=reduce,
            padding_mode="border", near=0.05,
        ).volume  # fmt: skip

    leaves = (features, reference, depths, views.cam_from_world.clone().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda *given: run(*given[:3], views.cam_from_world), leaves[:3], fast_mode=True, atol=1e-4
    )
    for gradient in torch.autograd.grad(run(*leaves).square().sum(), leaves):
        assert gradient.abs().max() > 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_large_numbers_saturate(backend):
    features = torch.full((1, 1, 3, 4, 5), 1e30)
    camera = cameras.orbit(torch.zeros(1), 20.0, 2.0, focal_length=8.0, height=4, width=5)
    grid = FrustumGrid(camera, depth_planes(1.0, 3.0, 2))
    reference = features[:, 0, :, None] * torch.tensor([1.0, -1.0, 1.0])[:, None, None, None]
    for groups in (1, 3):
        volume, _ = functional.unproject(
            features, camera, grid, reference=reference, groups=groups, padding_mode="border", backend=backend
        )
        assert bool(volume.isfinite().all())
        assert float(volume.abs().max()) > 1e37


def test_bad_arguments_are_named():
    grid = FrustumGrid(cases.CAMERA, cases.PIXEL_DEPTHS[:, 0])
    reference = cases.PLANE_REFERENCES[:, : cases.C]

    def run(**options):
        return functional.unproject(cases.FEATURES, cases.VIEWS, grid, **options)

    for error, text, options in (
        (OptionError, "groups must be 1 without a reference; got 5", {"groups": 5}),
        (OptionError, "groups must divide the C = 5 channels; got 2", {"reference": reference, "groups": 2}),
        (OptionError, "groups must be", {"reference": reference, "groups": 0}),
        (DTypeError, "reference must be of the features' torch.float32; got", {"reference": reference.double()}),
        (ShapeError, "reference must be (B, C, D or 1, H, W)", {"reference": reference[:, :, 0]}),
        (ShapeError, "got (2, 5, 2, 5, 6)", {"reference": reference[:, :, :2]}),
        (ShapeError, "(B, C) = (2, 5) and the grid's (D, H, W) = (4, 5, 6)", {"reference": reference[:, :4]}),
        (OptionError, "memory_format must be", {"memory_format": torch.channels_last}),
    ):  # fmt: skip
        with pytest.raises(error, match=re.escape(text)):
            run(**options)
    with pytest.raises(OptionError, match="groups"):
        Unproject(grid, groups=1.5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("reduce", [None, ("mean", "variance")])
def test_memory_format(reduce, backend):
    unproject = Unproject(cases.GRID, reduce=reduce, memory_format=torch.contiguous_format, backend=backend)
    volume, _ = unproject(cases.WIDE, cases.VIEWS)
    assert volume.is_contiguous()
    expected, _ = functional.unproject(cases.WIDE, cases.VIEWS, cases.GRID, reduce=reduce, backend=backend)
    torch.testing.assert_close(volume, expected, rtol=0, atol=0)
    for flatten in (True, False):
        maps, _ = functional.plane_sweep_project(
            *cases.SWEEP, flatten=flatten, memory_format=torch.contiguous_format, backend=backend
        )
        assert maps.is_contiguous()


def test_no_channels_and_no_scenes():
    volume, _ = functional.unproject(
        cases.FEATURES[:0], cases.VIEWS.at(slice(0, 0)), VoxelGrid(3), reference=torch.zeros(0, 5, 1, 3, 3)
    )
    assert tuple(volume.shape) == (0, 3, 1, 3, 3, 3)
    for reduce in (None, "mean", "max"):
        volume, _ = functional.unproject(
            cases.FEATURES[:, :, :0], cases.VIEWS, VoxelGrid(3), reference=torch.zeros(2, 0, 1, 3, 3), reduce=reduce
        )
        assert volume.shape[-4] == 1
        assert not bool(volume.any())
