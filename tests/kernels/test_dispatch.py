"""Which backend runs a call, and what is said where none can."""

from __future__ import annotations

import re

import pytest
import torch

from lsmgeo import PlaneSweepProject, Unproject, VoxelGrid, cameras, depth_planes, functional, kernels, rays
from lsmgeo.errors import BackendError, OptionError
from lsmgeo.kernels import OPERATORS, Backend, Options, reference

GRID = VoxelGrid((3, 4, 5))
DEPTHS = depth_planes(1.0, 3.0, 6)
AZIMUTH = torch.tensor([[0.0, 50.0, 130.0], [10.0, 90.0, 250.0]])
VIEWS = cameras.orbit(AZIMUTH, 20.0, 2.0, focal_length=20.0, height=12, width=14)
GENERATOR = torch.Generator().manual_seed(0)
FEATURES = torch.rand(2, 3, 4, 6, 7, generator=GENERATOR)
VOLUME = torch.rand(2, 4, *GRID.shape, generator=GENERATOR)
PIXELS = 6.0 * torch.rand(2, 3, 9, 2, generator=GENERATOR)
POINTS = torch.rand(2, 9, 3, generator=GENERATOR) - 0.5
WEIGHT = torch.rand(2, 24, generator=GENERATOR)

CALLS = {
    "unproject": lambda **options: functional.unproject(FEATURES, VIEWS, GRID, **options),
    "unproject_points": lambda **options: functional.unproject_points(FEATURES, VIEWS, POINTS, **options),
    "sample_views": lambda **options: functional.sample_views(
        FEATURES, PIXELS, PIXELS[..., 0] + 1.0, PIXELS[..., 0] < 4.0, **options
    ),
    "plane_sweep_project": lambda **options: functional.plane_sweep_project(
        VOLUME, VIEWS, GRID, DEPTHS, (8, 9), **options
    ),
    "project_reduce": lambda **options: rays.project_reduce(
        VOLUME, VIEWS, GRID, DEPTHS, WEIGHT, None, (8, 9), **options
    ),
    "splat": lambda **options: functional.splat(
        FEATURES, VIEWS, GRID, DEPTHS, weights=FEATURES[:, :, :1].expand(2, 3, 6, 6, 7), **options
    ),
}
SOURCES = {"plane_sweep_project": VOLUME, "project_reduce": VOLUME}
OPTIONS = Options.checked("test", "bilinear")


def fake(reason: str | None, calls: list[str], name: str = "fake") -> Backend:
    """A backend that gives the reference's answers plus one, and writes down what it ran."""

    def operator(key: str):
        def run(*args):
            calls.append(key)
            answer = reference.OPERATORS[key](*args)
            return answer + 1.0 if isinstance(answer, torch.Tensor) else (answer[0] + 1.0, answer[1])

        return run

    return Backend(name, lambda key, source, options: reason, {key: operator(key) for key in OPERATORS})


@pytest.fixture(autouse=True)
def _reference_alone(monkeypatch):
    """What is built on this machine is of no matter here."""
    monkeypatch.setattr(kernels, "BACKENDS", tuple(b for b in kernels.BACKENDS if b.name == "reference"))


@pytest.fixture(params=OPERATORS)
def operator(request):
    return request.param


def test_every_operator_has_a_call():
    assert set(CALLS) == set(OPERATORS) == set(reference.OPERATORS)


def test_automatic_is_the_reference(operator):
    automatic, named = CALLS[operator](), CALLS[operator](backend="reference")
    torch.testing.assert_close(tuple(automatic), tuple(named), rtol=0, atol=0)
    assert automatic[0].abs().sum() > 0
    if operator != "splat":  # no visibility
        assert 0 < automatic[1].sum() < automatic[1].numel()


def test_a_backend_that_can_is_taken_first(operator, monkeypatch):
    expected = CALLS[operator]()[0]
    calls: list[str] = []
    monkeypatch.setattr(kernels, "BACKENDS", (fake(None, calls), *kernels.BACKENDS))
    for backend in ("auto", "fake"):
        torch.testing.assert_close(CALLS[operator](backend=backend)[0], expected + 1.0, rtol=0, atol=0)
    assert calls == [operator, operator]
    torch.testing.assert_close(CALLS[operator](backend="reference")[0], expected, rtol=0, atol=0)
    assert len(calls) == 2


def test_a_backend_that_cannot_is_passed_over(operator, monkeypatch):
    expected = CALLS[operator]()[0]
    calls: list[str] = []
    monkeypatch.setattr(kernels, "BACKENDS", (fake("no compiler was found", calls), *kernels.BACKENDS))
    torch.testing.assert_close(CALLS[operator]()[0], expected, rtol=0, atol=0)
    assert calls == []


def test_a_named_backend_that_cannot_says_why(operator, monkeypatch):
    monkeypatch.setattr(kernels, "BACKENDS", (*kernels.BACKENDS, fake("no compiler was found", [])))
    text = f"{operator}: backend 'fake' cannot run this call (fake: no compiler was found)"
    with pytest.raises(BackendError, match=re.escape(text)):
        CALLS[operator](backend="fake")


def test_every_reason_is_told_where_no_backend_can(monkeypatch):
    monkeypatch.setattr(kernels, "BACKENDS", (fake("is slow", [], "slow"), fake("is old", [], "old")))
    text = "unproject: backend 'auto' cannot run this call (slow: is slow; old: is old)"
    with pytest.raises(BackendError, match=re.escape(text)):
        CALLS["unproject"]()


def test_a_reason_may_depend_on_the_call(monkeypatch):
    calls: list[str] = []
    picky = Backend(
        "picky",
        lambda key, source, options: "only float64" if source.dtype != torch.float64 else None,
        fake(None, calls).operators,
    )
    monkeypatch.setattr(kernels, "BACKENDS", (picky, *kernels.BACKENDS))
    single = functional.unproject(FEATURES, VIEWS, GRID).volume
    double = functional.unproject(FEATURES.double(), VIEWS, GRID).volume
    assert calls == ["unproject"]
    torch.testing.assert_close(double.float(), single + 1.0)


@pytest.mark.parametrize("name", ["cuda", "", "Reference", None, 0, ("reference",)])
def test_an_unknown_backend_is_named_with_the_choices(name):
    expected = "backend must be one of 'auto', 'reference'; got"
    makers = (
        lambda: Unproject(GRID, backend=name),
        lambda: PlaneSweepProject(GRID, DEPTHS, (8, 9), backend=name),
        lambda: rays.ProjectReduce(4, 2, GRID, DEPTHS, (8, 9), backend=name),
        *((lambda call=call: call(backend=name)) for call in CALLS.values()),
    )
    for make in makers:
        with pytest.raises(OptionError, match=expected):
            make()


def test_a_new_backend_is_among_the_choices(monkeypatch):
    monkeypatch.setattr(kernels, "BACKENDS", (*kernels.BACKENDS, fake(None, [])))
    assert Unproject(GRID, backend="fake").backend == "fake"
    with pytest.raises(OptionError, match="'auto', 'reference', 'fake'; got str 'cuda'"):
        Unproject(GRID, backend="cuda")


def test_the_layers_pass_their_backend_on(monkeypatch):
    calls: list[str] = []
    monkeypatch.setattr(kernels, "BACKENDS", (*kernels.BACKENDS, fake(None, calls)))
    Unproject(GRID, backend="fake")(FEATURES, VIEWS)
    PlaneSweepProject(GRID, DEPTHS, (8, 9), backend="fake")(VOLUME, VIEWS)
    rays.ProjectReduce(4, 2, GRID, DEPTHS, (8, 9), backend="fake")(VOLUME, VIEWS)
    list(functional.unproject_slabs(FEATURES, VIEWS, GRID, 2, backend="fake"))
    assert calls == ["unproject", "plane_sweep_project", "project_reduce", "unproject", "unproject"]
    Unproject(GRID)(FEATURES, VIEWS)
    assert len(calls) == 5


class TestExplain:
    def test_the_reference(self, operator, capsys):
        source = SOURCES.get(operator, FEATURES).half()
        text = kernels.explain(operator, source)
        shape = tuple(source.shape)
        assert text == f"{operator} of {shape} float16 on cpu\n  reference: taken"
        assert capsys.readouterr().out == text + "\n"

    def test_reasons_in_the_order_of_preference(self, monkeypatch):
        backends = (fake("no compiler was found", [], "cpu"), *kernels.BACKENDS, fake(None, [], "spare"))
        monkeypatch.setattr(kernels, "BACKENDS", backends)
        assert kernels.explain("unproject", FEATURES, reduce="mean").splitlines()[1:] == [
            "  cpu: no compiler was found",
            "  reference: taken",
            "  spare: can run, not needed",
        ]

    def test_it_names_what_would_run(self, operator, monkeypatch):
        monkeypatch.setattr(kernels, "BACKENDS", (fake(None, []), *kernels.BACKENDS))
        assert "  fake: taken" in kernels.explain(operator, SOURCES.get(operator, FEATURES))
        assert kernels.select(operator, SOURCES.get(operator, FEATURES), OPTIONS).name == "fake"

    def test_options_reach_the_predicate(self, monkeypatch):
        seen: list[Options] = []

        def why_not(key, source, options):
            seen.append(options)
            return None

        monkeypatch.setattr(kernels, "BACKENDS", (Backend("curious", why_not, {}),))
        kernels.explain("unproject", FEATURES, mode="nearest", augment="depth", reduce=("max", "mean"), near=0.5)
        assert seen == [Options("nearest", "zeros", True, "", ("max", "mean"), 0.5)]

    def test_what_it_refuses(self):
        with pytest.raises(OptionError, match="explain: operator must be one of 'unproject'"):
            kernels.explain("project", FEATURES)
        with pytest.raises(OptionError, match="mode must be one of 'trilinear', 'nearest'; got str 'bilinear'"):
            kernels.explain("plane_sweep_project", VOLUME, mode="bilinear")
