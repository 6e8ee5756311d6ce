"""Whatever a path holds, examined."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lsmgeo.data import PosedImages
from lsmgeo.data.posed import Voxels
from lsmgeo.diagnosis.photographs import examine_photographs

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from lsmgeo.diagnosis.findings import Findings

__all__ = ["examine"]


def examine(content: Any, path: Path) -> Findings:
    """Say whether cameras, photographs, depth and voxels belong together, and name the likely mistake where not.

    Args:
        content: what a reader gave: posed photographs, voxels alone, or a calibration.
        path: where it was read from, for messages.

    Returns:
        The findings.

    Raises:
        DataError: a file that is needed is missing or damaged.
    """
    if isinstance(content, PosedImages):
        return examine_photographs(content).findings
    if isinstance(content, Voxels):
        from lsmgeo.diagnosis.solids import examine_voxels

        return examine_voxels(content, path)
    from lsmgeo.diagnosis.boards import examine_calibration

    return examine_calibration(content, path)
