"""What an examination finds: facts, measurements against their limits, and the likely mistake."""

from __future__ import annotations

from typing import Literal, NamedTuple

__all__ = ["Cause", "Check", "Findings", "Gap"]


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
