"""The C++ kernels against the reference, in every instruction set that the machine has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import FrustumGrid, functional, rays
from lsmgeo._sites import image_sites, splat_sites, sweep_sites
from lsmgeo.errors import BackendError
from lsmgeo.kernels import Options, explain
from lsmgeo.kernels.native import library, loading
from tests.kernels import cases
from tests.kernels.comparison import Call, compare, sweep_call, unproject_call
from tests.property import support
from tests.strategies import Scene, scenes, sweep_depths
from tests.tolerances import UNIT_ROUNDOFF

REASON = library.why_not("unproject", torch.zeros(1), Options("bilinear"))
pytestmark = pytest.mark.skipif(REASON is not None, reason=f"the C++ kernels: {REASON}")


def instruction_sets() -> list[str]:
    found = []
    if REASON is None:
        best = loading.instruction_set()
        for name in ("baseline", "avx2", "avx512"):
            try:
                found.append(loading.instruction_set(name))
            except ValueError:
                continue
        loading.instruction_set(best)
    return found


@pytest.fixture(params=instruction_sets() or ["none"])
def instruction_set(request):
    before = loading.instruction_set()
    loading.instruction_set(request.param)
    yield request.param
    loading.instruction_set(before)


@pytest.mark.parametrize("name", {**cases.CASES, **cases.HALF})
def test_it_does_what_the_reference_does(name, instruction_set):
    {**cases.CASES, **cases.HALF}[name]("cpu")


STATISTICS = st.sampled_from([None, "mean", "variance", ("mean", "max")])
MODES = st.sampled_from(["bilinear", "nearest"])
PADDING = st.sampled_from(["zeros", "border"])
EXTRA = st.sampled_from([(), ("depth",), ("direction",), ("depth", "direction")])


def _inputs(scene: Scene) -> support.Inputs:
    return support.inputs(scene.rounded(torch.float32), torch.float32)


@support.FEWER
@given(scenes(), STATISTICS, MODES, PADDING, EXTRA, st.booleans())
def test_unproject_in_ugly_scenes(scene, reduce, mode, padding, extra, masked):
    features, cameras, grid = _inputs(scene)
    # Not at the camera itself: next to it the rounding of one coordinate turns the ray.
    options = {"mode": mode, "padding_mode": padding, "augment": extra, "reduce": reduce, "near": 0.05}
    if masked:
        options["view_mask"] = torch.from_numpy(scene.view_mask)
    compare(unproject_call(features, cameras, grid, **options), "cpu", reduced=reduce is not None)


@st.composite
def sweeps(draw):
    scene = draw(scenes())
    return scene, draw(sweep_depths(scene))


@support.FEWER
@given(sweeps(), MODES, PADDING, EXTRA, st.booleans())
def test_plane_sweep_in_ugly_scenes(sweep, mode, padding, extra, flatten):
    scene, depths = sweep
    _, cameras, grid = _inputs(scene)
    volume = torch.from_numpy(scene.volume).float()
    options = {"mode": "trilinear" if mode == "bilinear" else mode, "padding_mode": padding, "augment": extra}
    call = sweep_call(volume, cameras, grid, torch.from_numpy(depths), scene.size, flatten=flatten, **options)
    compare(call, "cpu", flat=depths.shape[-1] if flatten else None)


# Layouts


def _answers(run, source: torch.Tensor, cotangent: torch.Tensor) -> list[torch.Tensor]:
    leaf = source.detach().requires_grad_()
    values, visible = run(leaf)
    return [values.detach(), visible, *torch.autograd.grad(values, leaf, cotangent)]


RUNS = {
    "unproject": (lambda source: functional.unproject(source, cases.VIEWS, cases.GRID, backend="cpu"), cases.WIDE),
    "mean": (
        lambda source: functional.unproject(source, cases.VIEWS, cases.GRID, reduce="mean", backend="cpu"),
        cases.WIDE,
    ),
    "sweep": (
        lambda source: functional.plane_sweep_project(
            source, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE, flatten=False, backend="cpu"
        ),
        cases.WIDE_VOLUME,
    ),
    "stacked": (
        lambda source: functional.plane_sweep_project(
            source, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE, backend="cpu"
        ),
        cases.WIDE_VOLUME,
    ),
    "splat": (
        lambda source: (
            functional.splat(source, *cases.SPLAT, weights=cases.SHARES, backend="cpu"),
            torch.empty(0),
        ),
        cases.WIDE_MAPS,
    ),
}


@pytest.fixture(params=RUNS)
def operator(request):
    return RUNS[request.param]


def _twice(tensor: torch.Tensor) -> torch.Tensor:
    """The same values with strides that no layout of PyTorch has."""
    return torch.stack((tensor, tensor + 1.0), -1)[..., 0]


def test_strides_change_nothing(operator):
    run, source = operator
    cotangent = torch.rand(run(source)[0].shape)
    axis = 1 if source is cases.WIDE_VOLUME else 2
    channels_last = source.movedim(axis, -1).contiguous().movedim(-1, axis)
    expected = _answers(run, source, cotangent)
    for other, incoming in ((channels_last, cotangent), (_twice(source), _twice(cotangent))):
        for found, wanted in zip(_answers(run, other, incoming), expected, strict=True):
            torch.testing.assert_close(found, wanted, rtol=0, atol=0)


def test_an_expanded_gradient_is_read_where_it_is(operator):
    run, source = operator
    shape = run(source)[0].shape
    one = torch.full((), 0.75).expand(shape)
    found = _answers(run, source, one)[2]
    torch.testing.assert_close(found, _answers(run, source, one.clone())[2], rtol=0, atol=0)
    assert found.abs().max() > 0


def test_the_layouts_are_those_promised():
    values, _ = RUNS["unproject"][0](cases.WIDE)
    assert values.stride(2) == 1
    maps, _ = RUNS["stacked"][0](cases.WIDE_VOLUME)
    assert maps.flatten(0, 1).is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_same_bits_from_run_to_run(operator, threads):
    run, source = operator
    cotangent = torch.rand(run(source)[0].shape)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        first = _answers(run, source, cotangent)
        for _ in range(3):
            for found, expected in zip(_answers(run, source, cotangent), first, strict=True):
                assert torch.equal(found, expected)
    finally:
        torch.set_num_threads(before)


def test_memory_that_is_given_is_written_to():
    options = Options.checked("test", "trilinear")
    volume = cases.WIDE_VOLUME
    sites = sweep_sites("test", volume, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE, None, options)
    expected, _ = library.plane_sweep_project(volume, sites, options)
    out = torch.full(expected.shape, torch.nan).movedim(2, 3).contiguous().movedim(3, 2)  # unlike what it would make
    found, _ = library.plane_sweep_project(volume, sites, options, out)
    assert found is out
    torch.testing.assert_close(out, expected, rtol=0, atol=0)
    needs = (True, False, False, False)
    gradient, *_ = library.plane_sweep_project_backward(expected, volume, sites, options, needs)
    into = torch.ones_like(gradient)
    library.plane_sweep_project_backward(expected, volume, sites, options, needs, into)
    torch.testing.assert_close(into, gradient + 1.0)


def test_half_volumes_swept_into_float32():
    options = Options.checked("test", "trilinear")
    volume = cases.VOLUME.bfloat16()
    sites = sweep_sites("test", volume, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE, None, options)
    expected, _ = library.plane_sweep_project(volume.float(), sites, options)
    out = torch.empty(expected.shape)
    library.plane_sweep_project(volume, sites, options, out)
    torch.testing.assert_close(out, expected, rtol=1e-6, atol=1e-6)


# Registration


# opcheck looks at the gradients of tensors that have none.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize(
    "operator",
    ["unproject", "correlation", "sample_views", "plane_sweep_project", "pixel_sweep", "project_reduce", "splat"],
)
def test_opcheck(operator):
    smooth = "bilinear" if operator in ("unproject", "correlation", "sample_views") else "trilinear"
    options = Options.checked("test", smooth, augment="depth", groups=5 if operator == "correlation" else 1).on("cpu")
    leaf = (cases.FEATURES if smooth == "bilinear" else cases.VOLUME).clone().requires_grad_()
    if operator == "sample_views":
        arguments = (leaf, cases.PIXELS.clone().requires_grad_(), cases.VALID, cases.DISTANCE[:, :, None])
    elif operator == "unproject":
        arguments = (leaf, None, *image_sites("test", leaf, cases.VIEWS, cases.GRID, cases.MASK, options))
    elif operator == "correlation":
        grid = FrustumGrid(cases.CAMERA, cases.PIXEL_DEPTHS[:, 0].clone().requires_grad_())
        other = cases.REFERENCE[:, : cases.C].clone().requires_grad_()
        arguments = (leaf, other, *image_sites("test", leaf, cases.VIEWS, grid, cases.MASK, options, other))
        operator = "unproject"
    elif operator == "splat":
        leaf = cases.MAPS.clone().requires_grad_()
        weights = cases.SHARES.clone().requires_grad_()
        options = Options.checked("test", "trilinear").on("cpu")
        sites = splat_sites("test", leaf, weights, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.MASK, options)
        arguments = (leaf, weights, cases.GRID.shape, *sites)
    else:
        depths = cases.PIXEL_DEPTHS.clone().requires_grad_() if operator == "pixel_sweep" else cases.DEPTHS
        sites = sweep_sites("test", leaf, cases.VIEWS, cases.GRID, depths, cases.SIZE, None, options)
        arguments = (leaf, *sites)
        operator = "plane_sweep_project" if operator == "pixel_sweep" else operator
        if operator == "project_reduce":
            planes = cases.DEPTHS.shape[0]
            arguments = (leaf, torch.rand(3, cases.C + 1, planes, requires_grad=True), None, *arguments[1:])
    # A gradient of the weights is a sum over all pixels, which a product of matrices may add up in another order.
    terms = cases.B * cases.V * cases.SIZE[0] * cases.SIZE[1]
    tolerance = {"rtol": terms * UNIT_ROUNDOFF[torch.float32], "atol": 1e-5} if operator == "project_reduce" else {}
    torch.library.opcheck(getattr(torch.ops.lsmgeo, operator).default, (*arguments, *options), **tolerance)


def test_second_derivatives_are_those_of_the_reference():
    def second(call: Call, backend: str) -> list[torch.Tensor]:
        leaves = [leaf.detach().clone().requires_grad_() for leaf in call.leaves]
        values, _ = call.run(*leaves, backend=backend)
        weights = torch.linspace(0.1, 1.0, values.numel()).reshape(values.shape)
        first = torch.autograd.grad((values * weights).sum(), leaves, create_graph=True)
        total = sum((part * part.detach().cos()).sum() for part in first if part.requires_grad)
        parts = torch.autograd.grad(total, leaves, allow_unused=True)
        return [torch.zeros_like(x) if p is None else p for p, x in zip(parts, leaves, strict=True)]

    for call in (
        unproject_call(cases.FEATURES, cases.VIEWS, cases.GRID, near=0.1),
        sweep_call(cases.VOLUME, cases.VIEWS, cases.GRID, cases.DEPTHS, cases.SIZE),
        cases.points_call(cases.FEATURES, cases.VIEWS, cases.POINTS, augment="depth", reduce="mean"),
        cases.splat_call(cases.MAPS, *cases.SPLAT, cases.SHARES),
        cases.views_call(cases.FEATURES, cases.PIXELS, cases.DISTANCE, cases.VALID, augment="depth"),
    ):
        for found, expected in zip(second(call, "cpu"), second(call, "reference"), strict=True):
            largest = float(expected.abs().max())
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3 * largest)


def test_autocast_changes_nothing(operator):
    run, source = operator
    expected, _ = run(source)
    with torch.autocast("cpu", torch.bfloat16):
        found, _ = run(source)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_nothing_of_the_size_of_all_views_is_kept():
    features = torch.rand(1, 12, 4, 6, 7, requires_grad=True)
    views = cases.cameras.orbit(torch.arange(12.0)[None] * 30.0, 10.0, 2.0, focal_length=20.0, height=12, width=14)
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor.nbytes) or tensor, lambda t: t):
        volume, _ = functional.unproject(features, views, cases.VoxelGrid(16), reduce="variance", backend="cpu")
    assert volume.requires_grad
    assert sum(kept) < 4 * features.numel() + 20_000


# What has gone wrong once


def test_channels_in_parts_where_only_geometry_needs_a_gradient():
    features = torch.rand(1, 2, 37, 5, 6)
    pixels, valid = cases.PIXELS[:1, :2], cases.VALID[:1, :2]
    found = []
    for backend in ("cpu", "reference"):
        depth = torch.linspace(0.5, 2.0, 22).reshape(1, 2, 11).requires_grad_()
        volume, _ = functional.sample_views(
            features, pixels, depth, valid, augment="depth", reduce="mean", backend=backend
        )
        found += torch.autograd.grad(volume.square().sum(), depth)
    torch.testing.assert_close(*found)
    assert found[1].abs().max() > 0


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_the_default_dtype_is_of_no_matter(dtype):
    call = cases.points_call(cases.FEATURES, cases.VIEWS, cases.POINTS, augment=("depth", "direction"))

    def gradients() -> list[torch.Tensor]:
        leaves = [leaf.clone().requires_grad_() for leaf in call.leaves]
        return list(torch.autograd.grad(call.run(*leaves, backend="cpu")[0].square().sum(), leaves))

    expected, before = gradients(), torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        found = gradients()
    finally:
        torch.set_default_dtype(before)
    for part, other in zip(found, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-4)


def test_no_sites_no_gradient():
    features = torch.rand(1, 2, 8, 40, 60, requires_grad=True)
    nowhere = torch.zeros(1, 2, 0, 2), torch.zeros(1, 2, 0), torch.zeros(1, 2, 0, dtype=torch.bool)
    torch.full(features.shape, 7.0)  # memory that has been written to
    volume, _ = functional.sample_views(features, *nowhere, backend="cpu")
    (gradient,) = torch.autograd.grad(volume.sum(), features)
    torch.testing.assert_close(gradient, torch.zeros_like(features), rtol=0, atol=0)


def test_gradients_of_held_deviations_are_the_references():
    """Where the square of one view's deviation overflows, the mean's share of the others' does not cancel."""
    features = 1e18 * cases.FEATURES + torch.tensor([4e19, 0.0, 0.0])[:, None, None, None]
    found = []
    for backend in ("cpu", "reference"):
        leaf = features.clone().requires_grad_()
        volume, _ = functional.unproject(
            leaf, cases.VIEWS, cases.GRID, reduce=("mean", "variance"), padding_mode="border", backend=backend
        )
        found += torch.autograd.grad(volume, leaf, torch.full_like(volume, 1e-20))
    largest = float(found[1].abs().max())
    assert 0.0 < largest < torch.inf
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-4 * largest)


@pytest.mark.parametrize("name", cases.NEAREST)
def test_the_nearest_cell_depends_on_no_geometry_on_any_backend(name):
    """A gradient is offered where the answer depends on an argument, and nowhere else."""
    call = cases.NEAREST[name]
    offered = []
    for backend in ("cpu", "reference"):
        offered.append([])
        for chosen in range(len(call.leaves)):
            leaves = [leaf.detach().requires_grad_(number == chosen) for number, leaf in enumerate(call.leaves)]
            offered[-1].append(call.run(*leaves, backend=backend)[0].requires_grad)
    assert offered[0] == offered[1]
    assert offered[0][0]
    if "depth" not in name and "direction" not in name:
        factors = cases.WEIGHT.shape, cases.SHARES.shape
        assert offered[0] == [True, *(leaf.shape in factors for leaf in call.leaves[1:])]


@pytest.mark.parametrize(
    ("channels", "outputs", "augment"), [(0, 2, "depth"), (3, 0, ()), (0, 2, ("depth", "direction"))]
)
def test_reduced_sweeps_of_nothing_saturate_as_the_references(channels, outputs, augment):
    width = channels + ("depth" in augment) + 3 * ("direction" in augment)
    given = cases.VIEWS, cases.GRID, cases.DEPTHS
    found = []
    for backend in ("cpu", "reference"):
        volume = torch.zeros(cases.B, channels, *cases.GRID.shape, dtype=torch.float16, requires_grad=True)
        weight = torch.full((outputs, width * len(cases.DEPTHS)), 5e4, requires_grad=True)
        maps, _ = rays.project_reduce(volume, *given, weight, None, cases.SIZE, augment=augment, backend=backend)
        found.append([maps, *torch.autograd.grad(maps, (volume, weight), torch.ones_like(maps))])
    for part, expected in zip(*found, strict=True):
        torch.testing.assert_close(part, expected)


def test_gradients_of_far_planes_are_finite():
    depths = torch.tensor([1.0, 2.0, 1e20, 1e25, 3e30])
    found = []
    for backend in ("cpu", "reference"):
        leaf = depths.clone().requires_grad_()
        maps, _ = functional.plane_sweep_project(
            cases.VOLUME, cases.VIEWS, cases.GRID, leaf, cases.SIZE, augment="depth", backend=backend
        )
        found += torch.autograd.grad(maps.sum(), leaf)
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-4)


# Absence


def _child(code: str, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, check=True
    )
    return result.stdout


def test_it_can_be_turned_off():
    code = (
        "import torch; from lsmgeo import kernels;"
        "kernels.explain('unproject', torch.zeros(1, 2, 3, 4, 5));"
        "print(kernels.native.loading.empty((2, 3), torch.float32).shape)"
    )
    text = _child(code, LSMGEO_NATIVE="0")
    assert "cpu: turned off by LSMGEO_NATIVE=0" in text
    assert "reference: taken" in text
    assert "torch.Size([2, 3])" in text


def test_a_file_that_is_no_library_is_a_reason(tmp_path: Path):
    broken = tmp_path / "_native.abi3.so"
    broken.write_bytes(b"not a library")
    reason = loading.load(broken)
    assert isinstance(reason, str)
    assert "_native.abi3.so does not load" in reason


def test_another_library_is_a_reason():
    reason = loading.load(Path(torch.__file__).parent / "lib" / "libtorch_global_deps.so")
    assert isinstance(reason, str)


def test_explain_takes_it(capsys):
    explain("unproject", cases.FEATURES)
    assert "  cpu: taken" in capsys.readouterr().out


def test_named_for_float64_it_says_why():
    with pytest.raises(BackendError, match="cpu: float64 stays on the reference path"):
        functional.unproject(cases.FEATURES.double(), cases.VIEWS, cases.GRID, backend="cpu")


@pytest.mark.parametrize("planes", [1, 5])
def test_reduced_sweep_in_half_precision(planes):
    weight = torch.rand(3, cases.C * planes)
    given = (cases.VIEWS, cases.GRID, cases.DEPTHS[:planes], weight, None, cases.SIZE)
    found, _ = rays.project_reduce(cases.VOLUME.half(), *given, backend="cpu")
    expected, _ = rays.project_reduce(cases.VOLUME.half(), *given, backend="reference")
    assert found.dtype == torch.float16
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=2e-3)
