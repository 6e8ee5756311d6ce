"""Whatever a path holds, examined."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lsmgeo.data import PosedImages
from lsmgeo.data.posed import Voxels
from lsmgeo.diagnosis.facts import find_gap
from lsmgeo.diagnosis.photographs import examine_photographs

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from lsmgeo.diagnosis.findings import Findings

__all__ = ["examine", "with_gap"]


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
        return with_gap(examine_photographs(content).findings, content)
    if isinstance(content, Voxels):
        from lsmgeo.diagnosis.solids import examine_voxels

        return examine_voxels(content, path)
    from lsmgeo.diagnosis.boards import examine_calibration

    return examine_calibration(content, path)


def with_gap(findings: Findings, scene: PosedImages) -> Findings:
    """The findings about photographs, with the reason where nothing could be measured."""
    return findings._replace(gap=find_gap(scene)) if findings.verdict == "unknown" else findings
