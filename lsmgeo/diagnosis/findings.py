"""What an examination finds: facts, measurements, how far each may go, the likely mistake; and all that in words."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

__all__ = [
    "CENTRED", "LIMITS", "SIDES", "Cause", "Check", "Findings", "Gap", "badness", "counted", "format_value",
    "pixel_limit", "report", "share",
]  # fmt: skip

# Good sets stay at a quarter of these or below; the mistakes that people make go beyond by ten times and more.
LIMITS = {
    "pixels": 0.001,  # of the picture's diagonal: 1 px where that is 1000 px; never below the next
    "fewest pixels": 0.75,  # features and outlines are not located better in small pictures
    "views": 100.0,  # % of the photographs that agree with the others
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
VERDICTS = {
    "photographs": ("cameras and what they saw belong together", "cameras and what they saw do not belong together"),
    "calibration": ("lenses and pictures of the board agree", "lenses and pictures of the board do not agree"),
    "voxels": ("the mesh and its voxels agree", "the mesh and its voxels do not agree"),
}
BEYOND = 1e8


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


def share(name: str, fraction: float | np.floating, limit: str, measured: int, of: str) -> Check:
    """The check that a fraction, told in %, does not fall below one of the `LIMITS`."""
    return Check(name, 100 * float(fraction), "%", LIMITS[limit], measured, of, at_least=True)


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


def report(findings: Findings) -> str:
    """Facts, a table of checks, remarks and the verdict, as lines.

    Example:
        >>> from lsmgeo.diagnosis.findings import Check, Findings, report
        >>> check = Check("reprojection error of sparse points", 0.25, "px", 1.2, 5931, "observations")
        >>> print(report(Findings((("photographs", "23, 1000 x 658"),), (check,), None)))
        photographs:      23, 1000 x 658
        <BLANKLINE>
        check                                      measured         limit
        reprojection error of sparse points         0.25 px  <=   1.2 px  ok      5931 observations
        <BLANKLINE>
        verdict:          good: cameras and what they saw belong together
    """
    lines = [f"{name + ':':<17} {text}" for name, text in findings.facts]
    if findings.checks:
        lines += ["", f"{'check':<42}{'measured':>9}{'limit':>14}", *(_line(check) for check in findings.checks)]
    lines += ["", *(f"{'remark:':<18}{remark}" for remark in findings.remarks)]
    return "\n".join([*lines, *(f"{name + ':':<18}{text}" for name, text in _concluded(findings))])


def _concluded(findings: Findings) -> list[tuple[str, str]]:
    cause, gap = findings.cause, findings.gap
    good, bad = VERDICTS[findings.kind]
    if cause is not None:
        return [
            ("verdict", f"BAD, the likely mistake: {cause.name}"),
            ("because", cause.evidence),
            ("remedy", cause.remedy),
        ]
    if findings.verdict != "unknown":
        return [("verdict", f"good: {good}" if findings.verdict == "good" else f"BAD: {bad}")]
    verdict = ("verdict", "unknown: nothing here could be measured")
    return [verdict] if gap is None else [verdict, ("because", gap.reason), ("what to do", gap.remedy)]


def _line(check: Check) -> str:
    sign = ">=" if check.at_least else "<="
    unit = {"grey levels": "grey"}.get(check.unit, check.unit)
    value, limit = (f"{format_value(number)} {unit}".rstrip() for number in (check.value, check.limit))
    state = "ok" if check.passed else "FAILED"
    return f"{check.name:<42}{value:>9}  {sign} {limit:>8}  {state:<7} {counted(check.measured, check.of)}".rstrip()


def counted(count: int, things: str) -> str:
    """A number of things, in the singular where there is one.

    Example:
        >>> from lsmgeo.diagnosis.findings import counted
        >>> counted(2, "photographs"), counted(1, "photographs"), counted(1, "matches")
        ('2 photographs', '1 photograph', '1 match')
    """
    if count == 1:
        things = things.removesuffix("es" if things.endswith("ches") else "s")
    return f"{count} {things}"


def format_value(value: float) -> str:
    """A measurement in three digits; what is beyond measure in words.

    Example:
        >>> from lsmgeo.diagnosis.findings import format_value
        >>> format_value(0.16472), format_value(99.96), format_value(float("inf"))
        ('0.165', '99.96', 'infinite')
    """
    if np.isnan(value):
        return "unknown"
    if abs(value) >= BEYOND:
        return "infinite"
    # Close to all and all are not the same.
    if 99 < value < 100:
        return f"{np.floor(value * 100) / 100:.4g}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
