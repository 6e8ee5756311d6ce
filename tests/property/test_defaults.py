"""PyTorch's default device and default dtype change no answer: what is made follows the tensors given."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from lsmgeo import VoxelGrid, cameras, depth_planes, functional, fusion, kernels, rays
from lsmgeo.kernels import Options
from tests.kernels import cases
from tests.kernels.comparison import Call, points_call, reduce_call, sweep_call, unproject_call, views_call

SCENE = (cases.FEATURES, cases.VIEWS, cases.GRID)
SWEEP = (cases.VOLUME, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE)
VECTORS, QUATERNIONS = torch.rand(2, 3, 3), torch.rand(2, 3, 4)
PLAIN = cameras.orbit(torch.tensor([[3.0, 60.0]]), 20.0, 2.0, focal_length=20.0, height=12, width=15)
GENERATOR = torch.Generator()
ALPHA, PLANES = torch.rand(5, 4, 4), torch.linspace(1.0, 2.0, 5)
VALUES, SEEN = torch.rand(2, 3, 4, 4, 4, 4), torch.rand(2, 3, 4, 4, 4) > 0.3
VIEW_MASK = torch.tensor([[True, False, True], [True, True, False]])
GRU = fusion.ConvGRU3d(4, 3)
GL, COLMAP, P3D = cameras.to_opengl(PLAIN), cameras.to_colmap(PLAIN), cameras.to_pytorch3d(PLAIN)
ENDS = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])
CALIBRATION, EXTRINSICS = cases.VIEWS.intrinsics, cases.VIEWS.cam_from_world
REDUCE = rays.ProjectReduce(cases.C, 4, cases.GRID, cases.DEPTHS, cases.SIZE)

CALLS: dict[str, Callable[[], Sequence[Any]]] = {
    "from_opencv": lambda: cameras.from_opencv(CALIBRATION, EXTRINSICS[..., :3, :3], EXTRINSICS[..., :3, 3], 12, 15),
    "from_opencv, vectors": lambda: cameras.from_opencv(CALIBRATION, VECTORS, VECTORS, 12, 15),
    "to_opencv": lambda: cameras.to_opencv(cases.VIEWS),
    "from_opengl": lambda: cameras.from_opengl(*GL, 12, 15),
    "to_opengl": lambda: cameras.to_opengl(cases.VIEWS),
    "from_colmap": lambda: cameras.from_colmap(*COLMAP, 12, 15),
    "to_colmap": lambda: cameras.to_colmap(cases.VIEWS),
    "from_pytorch3d": lambda: cameras.from_pytorch3d(*P3D, 12, 15),
    "to_pytorch3d": lambda: cameras.to_pytorch3d(PLAIN),
    "stack": lambda: cameras.stack([PLAIN, PLAIN]),
    "select": lambda: cameras.select(PLAIN, 1, 1),
    "to": lambda: cameras.to(PLAIN, torch.float64),
    "resize": lambda: cameras.resize(PLAIN, 24, 32),
    "crop": lambda: cameras.crop(PLAIN, 1, 2, 5, 5),
    "rays": lambda: cameras.rays(PLAIN),
    "project": lambda: cameras.project(PLAIN, VECTORS[:1]),
    "unproject_depth": lambda: (cameras.unproject_depth(PLAIN, ALPHA[None, :2]),),
    "camera centres": lambda: (cameras.centers(PLAIN),),
    "look_at": lambda: (cameras.look_at(VECTORS + 3.0),),
    "orbit": lambda: cameras.orbit(ENDS[0], 10.0, 2.0, focal_length=20.0, height=12, width=15),
    "perturb": lambda: cameras.perturb(PLAIN, 5.0, generator=GENERATOR.manual_seed(0)),
    "depth_planes": lambda: [depth_planes(*ENDS, 5, spacing) for spacing in ("depth", "inverse", "log")],
    "centers": lambda: (cases.GRID.centers(), cases.frustum().centers()),
    "slabs": lambda: [part for _, *slab in functional.unproject_slabs(*SCENE, 2) for part in slab],
    "no pose": lambda: functional.unproject(*SCENE[:2], VoxelGrid(3)),
    "ProjectReduce": lambda: REDUCE(cases.VOLUME, cases.VIEWS),
    "composite": lambda: rays.composite(ALPHA, ALPHA[None], PLANES, ALPHA > 0.4),
    "expected_depth": lambda: [rays.expected_depth(ALPHA, PLANES, visible) for visible in (None, ALPHA > 0.4)],
    "max_along_rays": lambda: [rays.max_along_rays(ALPHA, visible) for visible in (None, ALPHA > 0.4)],
    "view_statistics": lambda: (functional.view_statistics(VALUES, SEEN, ("mean", "variance", "max"), VIEW_MASK),),
    "ConvGRU3d": lambda: (GRU(VALUES), GRU(VALUES, None, VIEW_MASK)),
}
_BOTH = {"augment": ("depth", "direction")}
OPERATORS = {
    "unproject": unproject_call(*SCENE, **_BOTH),
    "reduced": unproject_call(*SCENE, reduce=("max", "mean", "variance"), view_mask=VIEW_MASK, **_BOTH),
    "half": unproject_call(cases.FEATURES.half(), *SCENE[1:], reduce="mean"),
    "points": points_call(*SCENE[:2], cases.POINTS, **_BOTH),
    "pixels": views_call(cases.FEATURES, cases.PIXELS, cases.DISTANCE, cases.VALID, augment="depth"),
    "sweep": sweep_call(*SWEEP, **_BOTH),
    "reduced sweep": reduce_call(*SWEEP, cases.WEIGHT, cases.BIAS),
}


def _with_gradients(call: Call, backend: str) -> list[Tensor]:
    leaves = [leaf.detach().clone().requires_grad_() for leaf in call.leaves]
    values, visible = call.run(*leaves, backend=backend)
    return [values.detach(), visible, *torch.autograd.grad(values.square().sum(), leaves)]


@contextlib.contextmanager
def _double() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


DEFAULTS = {"device": lambda: torch.device("meta"), "dtype": _double}


def _assert_unchanged(call: Callable[[], Sequence[Any]], default: str) -> None:
    expected = list(call())
    with DEFAULTS[default]():
        found = list(call())
    for part, other in zip(found, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("default", DEFAULTS)
@pytest.mark.parametrize("name", CALLS)
def test_of_cameras_grids_and_rays(name, default):
    _assert_unchanged(CALLS[name], default)


@pytest.mark.parametrize("default", DEFAULTS)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", OPERATORS)
def test_of_operators_and_their_gradients(name, backend, default):
    call = OPERATORS[name]
    reason = {b.name: b for b in kernels.BACKENDS}[backend].why_not(call.name, call.leaves[0], Options("bilinear"))
    if reason is not None:
        pytest.skip(reason)
    _assert_unchanged(lambda: _with_gradients(call, backend), default)
