"""The Triton kernels equal the reference, and faults in them are noticed: in Triton's interpreter, on a CPU."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest
import torch

from lsmgeo.kernels import OPERATORS, Options, gpu
from tests.kernels.triton_cases import CASES
from tests.kernels.triton_faults import FAULTS
from tests.kernels.triton_runner import outcomes

needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
OPTIONS = Options("bilinear")
FEATURES = torch.zeros(1, 2, 3, 4, 5)


@pytest.fixture(scope="module")
def cases():
    return outcomes("cases")


@pytest.fixture(scope="module")
def faults():
    return outcomes("faults")


@needs_triton
@pytest.mark.parametrize("name", CASES)
def test_kernels_equal_the_reference(cases, name):
    assert not cases[name].wrong, cases[name].wrong


@needs_triton
@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_noticed(faults, name):
    assert not faults[name].wrong, faults[name].wrong


@pytest.mark.parametrize("operator", OPERATORS)
class TestReasons:
    @needs_triton
    def test_no_gpu(self, operator, monkeypatch):
        monkeypatch.delenv("TRITON_INTERPRET", raising=False)
        assert "CUDA tensors, these are on cpu" in gpu.why_not(operator, FEATURES, OPTIONS)

    @needs_triton
    def test_the_interpreter_runs_cpu_tensors(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        assert gpu.why_not(operator, FEATURES, OPTIONS) is None
        assert gpu.why_not(operator, FEATURES.half(), OPTIONS) is None
        assert "these are on meta" in gpu.why_not(operator, FEATURES.to("meta"), OPTIONS)

    def test_float64(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        assert gpu.why_not(operator, FEATURES.double(), OPTIONS) == "float64 stays on the reference path"

    def test_no_triton(self, operator, monkeypatch):
        monkeypatch.setenv("TRITON_INTERPRET", "1")
        monkeypatch.setitem(sys.modules, "triton", None)
        assert gpu.why_not(operator, FEATURES, OPTIONS) == "Triton is not installed"


def test_triton_is_imported_at_the_first_call():
    program = """
import sys, torch
from lsmgeo.kernels import Options, gpu
assert gpu.why_not("unproject", torch.zeros(1, 1, 1, 2, 2), Options("bilinear"))
assert "triton" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
