"""What an examination finds: facts, measurements, how far each may go, and the likely mistake."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

__all__ = ["CENTRED", "LIMITS", "SIDES", "Cause", "Check", "Findings", "Gap", "badness", "pixel_limit"]

# Good sets stay at a quarter of these or below; the mistakes that people make go beyond by ten times and more.
LIMITS = {
    "pixels": 0.001,  # of the picture's diagonal: 1 px where that is 1000 px; never below the next
    "fewest pixels": 0.75,  # features and outlines are not located better in small pictures
    "pairs": 90.0,  # % of the pairs of photographs within three times the limit of pixels
    "in front": 90.0,  # % of the matched features with enough parallax
    "depth": 2.0,  # %, median relative difference of depth
    "warp": 0.5,  # of the difference in grey levels with no warp
    "inside": 97.0,  # % of the cells that reach into the outlines
    "overlap": 60.0,  # %, intersection over union of solid and outline
    "near a cell": 95.0,  # % of depth points at most one cell away from an occupied one
    "centred": 20.0,  # % of the width or height between principal point and middle, where nothing else tells of K
    "view": 3.0,  # times the limit of pixels, by which one view stands out
}

LEAST_BADNESS, MOST_BADNESS = 0.02, 1e6
# A principal point in the very middle is no better than one that lies well.
CENTRED = "principal point off the middle"
SIDES = "matched features in front of both cameras"


class Check(NamedTuple):
    """One measurement, and how far it may go.

    Attributes:
        name: what was measured, such as "epipolar error of matched features".
        value: the median, or the fraction.
        unit: "px", "%", "grey levels" or "".
        limit: what the value must not exceed, or with ``at_least`` not fall below.
        measured: number of single measurements behind the value.
        of: what these are, such as "matches".
        at_least: whether large values are good.
    """

    name: str
    value: float
    unit: str
    limit: float
    measured: int
    of: str
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """Whether the value keeps its limit; NaN does not."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


class Cause(NamedTuple):
    """The mistake that explains what was measured.

    Attributes:
        name: its short name, such as "poses inverted".
        evidence: how well it explains, such as "inverted, the epipolar error falls from 34 px to 0.16 px".
        remedy: what to do, one sentence.
    """

    name: str
    evidence: str
    remedy: str


class Gap(NamedTuple):
    """Why nothing could be measured.

    Attributes:
        reason: what is missing, such as "no mesh lies beside the voxels".
        remedy: what to do for a verdict, one sentence.
    """

    reason: str
    remedy: str


class Findings(NamedTuple):
    """What an examination found.

    Attributes:
        facts: what is there, as (name, text) lines: counts, sizes, focal lengths, baselines, depth ranges.
        checks: what was measured; empty where nothing can be.
        cause: the likely mistake, where one is found; a mistake may be found though all checks pass.
        remarks: what else a reader should know, such as views that disagree with the others.
        kind: what was examined.
        gap: why nothing could be measured, where nothing could.
    """

    facts: tuple[tuple[str, str], ...]
    checks: tuple[Check, ...]
    cause: Cause | None
    remarks: tuple[str, ...] = ()
    kind: Literal["photographs", "calibration", "voxels"] = "photographs"
    gap: Gap | None = None

    @property
    def verdict(self) -> Literal["good", "bad", "unknown"]:
        """Whether the geometry holds; "unknown" where nothing could be measured."""
        if self.cause is not None or not all(check.passed for check in self.checks):
            return "bad"
        return "good" if self.checks else "unknown"


def pixel_limit(sizes: np.ndarray) -> float:
    """The limit of distances in photographs of sizes (V, 2), px."""
    diagonal = float(np.median(np.hypot(*np.asarray(sizes, float).T)))
    return max(LIMITS["pixels"] * diagonal, LIMITS["fewest pixels"])


def badness(check: Check) -> float:
    """How far a measurement goes, as a multiple of what it may: 1 is the limit."""
    part = (100 - check.value) / (100 - check.limit) if check.at_least else check.value / check.limit
    least = 1.0 if check.name == CENTRED else LEAST_BADNESS
    return float(np.clip(part, least, MOST_BADNESS)) if np.isfinite(part) else MOST_BADNESS
