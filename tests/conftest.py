"""Hypothesis profiles, chosen by ``HYPOTHESIS_PROFILE``: ci (default), dev, long. One thread, so that runs repeat.

``LSMGEO_TEST_WITHOUT_TRITON=1`` makes Triton impossible to import, as where it is not installed.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

_COMMON = {"deadline": None, "print_blob": True, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("ci", max_examples=200, derandomize=True, database=None, **_COMMON)
settings.register_profile("dev", max_examples=20, **_COMMON)
settings.register_profile("long", max_examples=5000, **_COMMON)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

torch.set_num_threads(1)

if os.environ.get("LSMGEO_TEST_WITHOUT_TRITON") == "1":
    sys.modules["triton"] = None  # type: ignore[assignment]

# What the core's lines are counted in: the operators' own tests. Counting doubles the time of all that is Python.
COUNTED = ("lsmgeo", "tests/kernels", "tests/property", "tests/structure")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    counted = [config.rootpath / folder for folder in COUNTED]
    for item in items:
        if not any(Path(item.path).is_relative_to(folder) for folder in counted):
            item.add_marker("no_cover")
