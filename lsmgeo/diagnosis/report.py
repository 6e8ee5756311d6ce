"""Findings in words, for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lsmgeo.diagnosis.findings import Check, Findings

__all__ = ["counted", "report", "tell"]

VERDICTS = {
    "photographs": ("cameras and what they saw belong together", "cameras and what they saw do not belong together"),
    "calibration": ("lenses and pictures of the board agree", "lenses and pictures of the board do not agree"),
    "voxels": ("the mesh and its voxels agree", "the mesh and its voxels do not agree"),
}
BEYOND = 1e8


def report(findings: Findings) -> str:
    """Facts, a table of checks, remarks and the verdict, as lines.

    Example:
        >>> from lsmgeo.diagnosis.findings import Check, Findings
        >>> from lsmgeo.diagnosis.report import report
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
    value, limit = (f"{tell(number)} {unit}".rstrip() for number in (check.value, check.limit))
    state = "ok" if check.passed else "FAILED"
    return f"{check.name:<42}{value:>9}  {sign} {limit:>8}  {state:<7} {counted(check.measured, check.of)}".rstrip()


def counted(count: int, things: str) -> str:
    """A number of things, in the singular where there is one.

    Example:
        >>> from lsmgeo.diagnosis.report import counted
        >>> counted(2, "photographs"), counted(1, "photographs"), counted(1, "matches")
        ('2 photographs', '1 photograph', '1 match')
    """
    if count == 1:
        things = things.removesuffix("es" if things.endswith("ches") else "s")
    return f"{count} {things}"


def tell(value: float) -> str:
    """A measurement in three digits; what is beyond measure in words.

    Example:
        >>> from lsmgeo.diagnosis.report import tell
        >>> tell(0.16472), tell(99.96), tell(float("inf"))
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
