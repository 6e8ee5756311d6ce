"""Real data in the folder that ``LSMGEO_TEST_DATA`` names; a test of what is not there is skipped."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def real_sets(pattern: str) -> list[Path]:
    """The folders or files of a pattern, in order."""
    root = os.environ.get("LSMGEO_TEST_DATA")
    if not root:
        pytest.skip("LSMGEO_TEST_DATA names no folder of real data")
    found = sorted(Path(root).glob(pattern))
    if not found:
        pytest.skip(f"LSMGEO_TEST_DATA holds no {pattern}")
    return found


def real_set(name: str) -> Path:
    return real_sets(name)[0]


def folder_of_meshes() -> Path:
    """The folder with all 154 CC0 meshes."""
    folder = real_set("meshes_cc0")
    assert len(list(folder.glob("*.ply"))) == 154
    return folder
