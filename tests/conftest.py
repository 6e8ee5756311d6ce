"""Hypothesis profiles, chosen by ``HYPOTHESIS_PROFILE``. One thread, so that runs repeat.

"ci" (the default) draws 60 examples a property, the same ones always, "long" 200 at random, "dev" 20 at random.

``LSMGEO_TEST_WITHOUT_TRITON=1`` makes Triton impossible to import, as where it is not installed.
"""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

_COMMON = {"deadline": None, "print_blob": True, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("ci", max_examples=60, derandomize=True, database=None, **_COMMON)
settings.register_profile("dev", max_examples=20, **_COMMON)
settings.register_profile("long", max_examples=200, **_COMMON)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

torch.set_num_threads(1)

if os.environ.get("LSMGEO_TEST_WITHOUT_TRITON") == "1":
    sys.modules["triton"] = None  # type: ignore[assignment]

# What the core's lines are counted in: its own tests. Counting doubles the time of all that is Python.
COUNTED = ("lsmgeo", "tests/fuzz", "tests/interop", "tests/kernels", "tests/models/test_fusion_recurrent.py",
           "tests/property", "tests/structure")  # fmt: skip
# Compilers and children that are killed: slow to count, and they count nothing.
NOT_COUNTED = ("tests/fuzz/test_junk.py", "tests/interop/test_compile.py")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    counted, not_counted = ([config.rootpath / name for name in names] for names in (COUNTED, NOT_COUNTED))
    without_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(without_gpu)
        path = Path(item.path)
        if path in not_counted or not any(path.is_relative_to(folder) for folder in counted):
            item.add_marker("no_cover")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Fail where a test file cannot import what is ours: the doctest plugin would skip it, unnoticed."""
    report = yield
    if report.skipped and "unable to import module" in str(report.longrepr) and collector.path.name.startswith("test_"):
        try:
            runpy.run_path(str(collector.path))
        except ImportError as error:
            if (error.name or "").split(".")[0] in ("", "lsmgeo", "tests"):
                report.outcome, report.longrepr = "failed", f"{collector.path}: {error!r}"
    return report
