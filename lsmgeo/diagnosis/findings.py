"""Results of an examination: facts, checks with their limits, the likely cause; and the report as text."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

__all__ = [
    "CENTRED", "LIMITS", "SIDES", "Cause", "Check", "Findings", "Gap", "badness", "counted", "format_value",
    "pixel_limit", "report", "share",
]  # fmt: skip

# Good data stay below a quarter of these; common errors exceed them tenfold and more.
LIMITS = {
    "pixels": 0.001,  # of the image diagonal: 1 px where that is 1000 px; never below the next
    "fewest pixels": 0.75,  # features and silhouettes are located no better in small images
    "views": 100.0,  # % of the images that agree with the others
    "pairs": 90.0,  # % of the pairs of images within three times the limit of pixels
    "in front": 90.0,  # % of the matched features with enough parallax
    "depth": 2.0,  # %, median relative difference of depth
    "warp": 0.5,  # of the difference in grey levels without a warp
    "inside": 97.0,  # % of the cells that overlap the silhouettes
    "overlap": 60.0,  # %, intersection over union of voxels and silhouette
    "near a cell": 95.0,  # % of depth points at most one cell away from an occupied one
    "centred": 20.0,  # % of the width or height between principal point and image centre, of a rectified pair
    "view": 3.0,  # multiple of the pixel limit at which a single view is an outlier
}

LEAST_BADNESS, MOST_BADNESS = 0.02, 1e6
# A principal point within its limit is as good as one at the image centre.
CENTRED = "principal point off the image centre"
SIDES = "matched features in front of both cameras"
VERDICTS = {
    "images": ("the cameras fit the data", "the cameras do not fit the data"),
    "calibration": ("the lenses fit the images of the board", "the lenses do not fit the images of the board"),
    "voxels": ("the mesh and its voxels agree", "the mesh and its voxels do not agree"),
}
LARGEST = 1e8  # printed as infinite


class Check(NamedTuple):
    """One measurement and its limit.

    Attributes:
        name: what was measured, such as "epipolar error of matched features".
        value: the median, or the fraction.
        unit: "px", "%", "grey levels" or "".
        limit: the largest value that passes, or with ``at_least`` the smallest.
        measured: the number of single measurements.
        of: their name, such as "matches".
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
        """Whether the value is within its limit; NaN is not."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def share(name: str, fraction: float | np.floating, limit: str, measured: int, of: str) -> Check:
    """The check that a fraction, in %, is at least one of the `LIMITS`."""
    return Check(name, 100 * float(fraction), "%", LIMITS[limit], measured, of, at_least=True)


class Cause(NamedTuple):
    """The error that explains the measurements.

    Attributes:
        name: its short name, such as "poses inverted".
        evidence: the effect of the correction, such as "inverted, epipolar error: 0.16 instead of 34 px".
        remedy: what to do, one sentence.
    """

    name: str
    evidence: str
    remedy: str


class Gap(NamedTuple):
    """Why nothing could be measured.

    Attributes:
        reason: what is missing, such as "there is no mesh beside the voxels".
        remedy: what to do for a verdict, one sentence.
    """

    reason: str
    remedy: str


class Findings(NamedTuple):
    """The result of an examination.

    Attributes:
        facts: (name, text) lines: counts, sizes, focal lengths, baselines, depth ranges.
        checks: what was measured; empty if nothing can be.
        cause: the likely cause, if one is found; it may be found although all checks pass.
        remarks: further hints, such as errors that these checks cannot detect.
        kind: what was examined.
        gap: why nothing could be measured, if so.
    """

    facts: tuple[tuple[str, str], ...]
    checks: tuple[Check, ...]
    cause: Cause | None
    remarks: tuple[str, ...] = ()
    kind: Literal["images", "calibration", "voxels"] = "images"
    gap: Gap | None = None

    @property
    def verdict(self) -> Literal["good", "bad", "unknown"]:
        """Whether the geometry is right; "unknown" if nothing could be measured."""
        if self.cause is not None or not all(check.passed for check in self.checks):
            return "bad"
        return "good" if self.checks else "unknown"


def pixel_limit(sizes: np.ndarray) -> float:
    """The limit of distances in images of sizes (V, 2), px."""
    diagonal = float(np.median(np.hypot(*np.asarray(sizes, float).T)))
    return max(LIMITS["pixels"] * diagonal, LIMITS["fewest pixels"])


def badness(check: Check) -> float:
    """A measurement as a multiple of its limit: 1 is the limit."""
    part = (100 - check.value) / (100 - check.limit) if check.at_least else check.value / check.limit
    least = 1.0 if check.name == CENTRED else LEAST_BADNESS
    return float(np.clip(part, least, MOST_BADNESS)) if np.isfinite(part) else MOST_BADNESS


def report(findings: Findings) -> str:
    """Facts, a table of checks, remarks and the verdict, as lines.

    Example:
        >>> from lsmgeo.diagnosis.findings import Check, Findings, report
        >>> check = Check("reprojection error of sparse points", 0.25, "px", 1.2, 5931, "observations")
        >>> print(report(Findings((("images", "23, 1000 x 658"),), (check,), None)))
        images:           23, 1000 x 658
        <BLANKLINE>
        check                                      measured         limit
        reprojection error of sparse points         0.25 px  <=   1.2 px  ok      5931 observations
        <BLANKLINE>
        verdict:          good: the cameras fit the data
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
            ("verdict", f"BAD, the likely cause: {cause.name}"),
            ("because", cause.evidence),
            ("remedy", cause.remedy),
        ]
    if findings.verdict != "unknown":
        return [("verdict", f"good: {good}" if findings.verdict == "good" else f"BAD: {bad}")]
    verdict = ("verdict", "unknown: nothing could be measured")
    return [verdict] if gap is None else [verdict, ("because", gap.reason), ("what to do", gap.remedy)]


def _line(check: Check) -> str:
    sign = ">=" if check.at_least else "<="
    unit = {"grey levels": "grey"}.get(check.unit, check.unit)
    value, limit = (f"{format_value(number)} {unit}".rstrip() for number in (check.value, check.limit))
    state = "ok" if check.passed else "FAILED"
    return f"{check.name:<42}{value:>9}  {sign} {limit:>8}  {state:<7} {counted(check.measured, check.of)}".rstrip()


def counted(count: int, things: str) -> str:
    """A number of things, in the singular for one.

    Example:
        >>> from lsmgeo.diagnosis.findings import counted
        >>> counted(2, "images"), counted(1, "images"), counted(1, "matches")
        ('2 images', '1 image', '1 match')
    """
    if count == 1:
        things = things.removesuffix("es" if things.endswith("ches") else "s")
    return f"{count} {things}"


def format_value(value: float) -> str:
    """A measurement in three digits, or "infinite" or "unknown".

    Example:
        >>> from lsmgeo.diagnosis.findings import format_value
        >>> format_value(0.16472), format_value(99.96), format_value(float("inf"))
        ('0.165', '99.96', 'infinite')
    """
    if np.isnan(value):
        return "unknown"
    if abs(value) >= LARGEST:
        return "infinite"
    # Nearly 100 % is never rounded to 100 %.
    if 99 < value < 100:
        return f"{np.floor(value * 100) / 100:.4g}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
