"""The Triton kernels equal the reference, and faults in them are noticed: in Triton's interpreter, on a CPU."""

from __future__ import annotations

import importlib.util
import sys

import pytest
import torch

from lsmgeo.kernels import OPERATORS, Options
from lsmgeo.kernels.triton import operators
from tests.kernels.triton_cases import CASES
from tests.kernels.triton_faults import FAULTS
from tests.kernels.triton_runner import outcomes

needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
OPTIONS = Options("bilinear")
FEATURES = torch.zeros(1, 2, 3, 4, 5)


# Each group is run in a process of its own. The faults of the short form are every other one.
GROUPS = {
    "images": [name for name in CASES if name.startswith("images")],
    "shared": [name for name in CASES if name.startswith("shared")][::2],
    "others shared": [name for name in CASES if name.startswith("shared")][1::2],
    "others": [name for name in CASES if not name.startswith(("images", "shared"))],
}
SOUND, *BROKEN = FAULTS


def assert_right(table, names):
    found = outcomes(table, *names)
    assert list(found) == list(names)
    wrong = {name: outcome.wrong for name, outcome in found.items() if outcome.wrong}
    assert not wrong, "\n".join(f"{name}\n{text}" for name, text in wrong.items())


@needs_triton
@pytest.mark.parametrize(
    "group", [pytest.param(name, marks=pytest.mark.long if name == "others shared" else ()) for name in GROUPS]
)
def test_kernels_equal_the_reference(group):
    assert_right("cases", GROUPS[group])


@needs_triton
@pytest.mark.parametrize("first", [0, pytest.param(1, marks=pytest.mark.long)])
def test_faults_are_noticed(first):
    assert_right("faults", [SOUND, *BROKEN[first::2]])


def test_there_are_enough_faults():
    assert len(BROKEN) >= 20


@pytest.mark.parametrize("operator", OPERATORS)
class TestReasons:
    @needs_triton
    def test_no_gpu(self, operator, monkeypatch):
        monkeypatch.delenv("TRITON_INTERPRET", raising=False)
        assert "CUDA tensors, these are on cpu" in operators.why_not(operator, FEATURES, OPTIONS)

    @needs_triton
    def test_the_interpreter_runs_cpu_tensors(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        assert operators.why_not(operator, FEATURES, OPTIONS) is None
        assert operators.why_not(operator, FEATURES.half(), OPTIONS) is None
        assert "these are on meta" in operators.why_not(operator, FEATURES.to("meta"), OPTIONS)

    def test_float64(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        assert operators.why_not(operator, FEATURES.double(), OPTIONS) == "float64 stays on the reference path"

    def test_no_triton(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        monkeypatch.setitem(sys.modules, "triton", None)
        assert operators.why_not(operator, FEATURES, OPTIONS) == "Triton is not installed"
