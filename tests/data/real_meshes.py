"""The CC0 meshes of the folder that ``LSMGEO_TEST_DATA`` names."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = os.environ.get("LSMGEO_TEST_DATA")
needs_meshes = pytest.mark.skipif(not ROOT, reason="LSMGEO_TEST_DATA names no folder of meshes")


def folder_of_meshes() -> Path:
    """The folder with all 154 of them; the test is skipped where the data folder lacks it."""
    folder = Path(ROOT or "") / "meshes_cc0"
    if not folder.is_dir():
        pytest.skip("LSMGEO_TEST_DATA holds no meshes_cc0")
    assert len(list(folder.glob("*.ply"))) == 154
    return folder
