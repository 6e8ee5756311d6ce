"""The native function that checks cameras and composes matrices gives what PyTorch's operations give, and no errors."""

import math

import pytest
import torch
from hypothesis import given
from torch.testing import assert_close
from torch.utils.flop_counter import FlopCounterMode

import lsmgeo
from lsmgeo import FrustumGrid, VoxelGrid, _sites, depth_planes, functional
from lsmgeo.cameras import orbit
from lsmgeo.errors import CameraError
from lsmgeo.kernels.native import composing
from lsmgeo.kernels.native.loading import missing
from lsmgeo.kernels.request import Options, Sites
from tests import strategies
from tests.property import support

pytestmark = pytest.mark.skipif(missing() is not None, reason="the C++ library is not built")

FRAMES = ("", "world", "camera")
VIEWS = orbit(torch.tensor([[0.0, 80.0, 200.0], [10.0, 120.0, 300.0]]), 20.0, 2.0, focal_length=9.0, height=8, width=11)
FEATURES, VOLUME, DEPTHS = torch.ones(2, 3, 1, 5, 6), torch.ones(2, 1, 3, 3, 3), depth_planes(1.5, 2.5, 4)
FRUSTUM = FrustumGrid(VIEWS.at((slice(None), 0)), DEPTHS, size=(5, 6))


def watch(patch: pytest.MonkeyPatch) -> list[bool]:
    """Whether the native function answered, call by call; `[False]` in front turns it off."""
    found: list[bool] = []
    honest = composing.compose

    def compose(*arguments, **options):
        result = None if found[:1] == [False] else honest(*arguments, **options)
        found.append(result is not None)
        return result

    patch.setattr(_sites, "compose", compose)
    return found


@pytest.fixture
def answers(monkeypatch):
    return watch(monkeypatch)


def both_ways(answers, make):
    """The result of the native function, then that of PyTorch's operations."""
    answers.clear()
    native = make()
    assert answers
    assert all(answers)
    answers[:] = [False]
    return native, make()


def assert_sites_agree(native: Sites, expected: Sites) -> None:
    for actual, wanted in ((native.matrix, expected.matrix), (native.direction, expected.direction)):
        assert (actual is None) == (wanted is None)
        if wanted is None:
            continue
        assert actual.dtype == wanted.dtype == torch.float64
        assert actual.shape == wanted.shape
        # Entries cancel: rounding is relative to the terms, of the size of the largest entry of a view's matrix.
        scale = wanted.abs().amax((-1, -2), keepdim=True).clamp_min(1e-300)
        assert_close(actual / scale, wanted / scale, rtol=0.0, atol=1e-12)
    for actual, wanted in zip(native[2:5], expected[2:5], strict=True):
        assert_close(actual, wanted, rtol=1e-15, atol=0.0)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(scene=strategies.scenes())
@support.FEWER
def test_matrices_agree(frame, dtype, scene):
    features, cameras, grid = support.inputs(scene, dtype)
    options, depths = Options("bilinear", direction=frame), torch.tensor([0.5, 1.0, 7.0])
    with pytest.MonkeyPatch.context() as patch:
        found = watch(patch)
        for make in (
            lambda: _sites.image_sites("test", features, cameras, grid, None, options),
            lambda: _sites._frustum_sites(
                *("test", {"features": features}, cameras, features.shape[:2], grid, depths),
                *((1,), (7, 5), None, options),
            ),
        ):
            assert_sites_agree(*both_ways(found, make))


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("mask", [None, torch.tensor([[True, False, True], [False, True, True]])])
@pytest.mark.parametrize("grid", [VoxelGrid(3), VoxelGrid(3, world_from_grid=torch.eye(4).expand(2, 4, 4)), FRUSTUM])
def test_masked_views_and_grids_agree(answers, frame, mask, grid):
    views = VIEWS
    if mask is not None:
        bad = torch.where(mask[..., None, None], VIEWS.cam_from_world, torch.nan)
        views = VIEWS._replace(cam_from_world=bad)
    options = Options("bilinear", direction=frame)
    make = lambda: _sites.image_sites("test", FEATURES, views, grid, mask, options)  # noqa: E731
    assert_sites_agree(*both_ways(answers, make))


def test_a_known_matrix():
    """A camera at the origin that looks along z, at half its resolution: cx' = (cx + 0.5) / 2 - 0.5."""
    K = torch.tensor([[4.0, 0.0, 3.0], [0.0, 6.0, 1.0], [0.0, 0.0, 1.0]]).reshape(1, 1, 3, 3)
    sizes = torch.full((1, 1), 8)
    grid = torch.eye(4, dtype=torch.float64)
    E = torch.eye(4).reshape(1, 1, 4, 4)
    matrix, direction = composing.compose(composing.IMAGES, K, E, sizes, sizes, None, grid, (4, 4), "world")
    assert matrix[0, 0].tolist() == [[2.0, 0.0, 1.25, 0.0], [0.0, 3.0, 0.25, 0.0], [0.0, 0.0, 1.0, 0.0]]
    assert direction[0, 0].tolist() == torch.eye(4)[:3].tolist()


BAD = {
    "K NaN": ("intrinsics", (1, 2, 0, 0), math.nan),
    "K infinite": ("intrinsics", (0, 1, 1, 2), math.inf),
    "E NaN": ("cam_from_world", (1, 0, 2, 3), math.nan),
    "last row of K": ("intrinsics", (1, 1, 2, 1), 0.01),
    "singular K": ("intrinsics", (0, 2, 0, 0), 0.0),
    "last row of E": ("cam_from_world", (0, 0, 3, 3), 1.1),
    "scaled": ("cam_from_world", (1, 1, slice(3), slice(3)), 1.01),
    "mirrored": ("cam_from_world", (1, 2, 0, slice(3)), -1.0),
    "height": ("height", (1, 2), 0.0),
}


@pytest.mark.parametrize("fault", BAD)
@pytest.mark.parametrize("call", ["unproject", "sweep", "frustum"])
def test_errors_have_the_same_text(answers, fault, call):
    name, index, value = BAD[fault]
    field = getattr(VIEWS, name).clone().double() if name == "height" else getattr(VIEWS, name).clone()
    field[index] = field[index] * value if isinstance(index[-1], slice) else value
    views = VIEWS._replace(**{name: field})
    if name == "height":
        views = views._replace(width=views.width.double())

    def make():
        if call == "unproject":
            functional.unproject(FEATURES, views, VoxelGrid(3))
        elif call == "sweep":
            functional.plane_sweep_project(VOLUME, views, VoxelGrid(3), DEPTHS, (5, 6))
        else:
            FrustumGrid(views.at(index[:2]), DEPTHS, (5, 6))

    with pytest.raises(CameraError) as native:
        make()
    assert answers
    assert not any(answers)
    answers[:] = [False]
    with pytest.raises(CameraError) as expected:
        make()
    assert str(native.value) == str(expected.value)


@pytest.mark.parametrize("name", ["intrinsics", "cam_from_world"])
@pytest.mark.parametrize("call", ["unproject", "sweep"])
def test_gradients_take_the_differentiable_path(answers, name, call):
    field = getattr(VIEWS, name).clone().requires_grad_()
    views = VIEWS._replace(**{name: field})
    features = torch.arange(30.0).reshape(1, 1, 1, 5, 6).expand(2, 3, 1, 5, 6)
    volume = torch.arange(27.0).reshape(1, 1, 3, 3, 3).expand(2, 1, 3, 3, 3)
    if call == "unproject":
        values = functional.unproject(features, views, VoxelGrid(3)).volume
    else:
        values = functional.plane_sweep_project(volume, views, VoxelGrid(3), DEPTHS, (5, 6)).maps
    (gradient,) = torch.autograd.grad(values.sum(), field)
    assert not all(answers)
    assert bool((gradient != 0).any())
    with torch.no_grad():
        answers.clear()
        functional.unproject(FEATURES, views, VoxelGrid(3))
    assert answers
    assert all(answers)


def test_what_the_native_function_must_not_see():
    cameras = (VIEWS.intrinsics, VIEWS.cam_from_world, VIEWS.height, VIEWS.width)
    check = lambda *fields: composing.compose(composing.CHECKS, *fields)  # noqa: E731
    assert check(*cameras) is not None
    negated = torch.imag(torch.complex(torch.zeros_like(cameras[1]), -cameras[1]).conj())
    assert negated.is_neg()
    assert bool((negated == cameras[1]).all())
    pose = cameras[1].clone().requires_grad_()
    for other in (negated, pose, cameras[1].to("meta"), cameras[1][:0]):
        assert check(cameras[0], other, *cameras[2:]) is None
    with FlopCounterMode(display=False):
        assert check(*cameras) is None
    with torch.device("meta"), lsmgeo.debug():  # a default device, which its outputs are not on
        assert check(*cameras) is not None
