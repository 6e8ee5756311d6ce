"""Every fault in the C++ kernels is noticed by a comparison with the reference; the kernels as they are pass all."""

from __future__ import annotations

import ctypes
import os

import pytest
import torch

from lsmgeo.kernels.native import loading as native
from tests.kernels.cases import CASES, HALF
from tests.kernels.native_faults import FAULTS, build, commit, compiler

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler"),
    pytest.mark.skipif(os.environ.get("LSMGEO_NATIVE") == "0", reason="the C++ kernels are turned off"),
]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    loaded = native.load(build(tmp_path_factory.mktemp("faults")))
    assert isinstance(loaded, ctypes.CDLL), loaded
    return loaded


def _noticed(monkeypatch, library, fault: str | None) -> list[str]:
    commit(library, fault)
    monkeypatch.setattr(native, "_library", lambda: library)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)  # so that channels are split in chunks
    found = []
    for name, case in {**CASES, **HALF}.items():
        try:
            case("cpu")
        except (AssertionError, RuntimeError):
            found.append(name)
            if fault is not None:
                break
    return found


def test_the_kernels_as_they_are(monkeypatch, library):
    assert _noticed(monkeypatch, library, None) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_noticed(monkeypatch, library, fault):
    assert _noticed(monkeypatch, library, fault), f"no comparison notices: {fault}"
