"""The most likely cause of large errors: each candidate correction is applied and everything is measured again."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.camera_errors import (
    SCALES,
    Candidate,
    camera_candidates,
    depth_candidates,
    depth_scaled,
    focal_scaled,
    resolution_candidates,
    scaled,
)
from lsmgeo.diagnosis.findings import CENTRED, SIDES, Check, badness
from lsmgeo.diagnosis.permutations import permutation_candidates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from lsmgeo.diagnosis.evidence import Evidence
    from lsmgeo.diagnosis.two_view_geometry import Hypothesis

__all__ = ["Explanation", "explain", "invisible_errors", "is_decisive", "is_suspicious", "score"]

# Factor by which an error that stays above its limit must fall; score differences that count as equal.
DECISIVE, TIE, RIVAL = 4.0, 0.05, 0.35
# Multiples of the limit: a check passes up to the first, and is examined further from the second.
PASSED = 1.0
SUSPICIOUS = 0.5
FINALISTS = 16
# Of errors that explain the measurements equally well, the more common one is reported.
COMMON = (
    "poses inverted",
    "OpenGL axes",
    "y flipped",
    "K of another resolution",
    "left and right exchanged",
    "frames shuffled",
    "depth in other units",
    "depth along the ray",
    "poses inverted and OpenGL axes",
)
DEPTH_SCALES = np.geomspace(1e-3, 1e3, 41)
NEAR = 0.02
NICE = (0.001, 0.01, 0.1, 0.125, 0.2, 0.25, 1 / 3, 0.5, 2 / 3, 0.75, 1.5, 2.0, 3.0, 4.0, 5.0, 8.0, 10.0, 100.0, 1000.0)


class Explanation(NamedTuple):
    """An error whose correction makes the checks pass."""

    candidate: Candidate  # the error and the corrected geometry
    before: tuple[Check, ...]  # the checks for the stated cameras
    after: tuple[Check, ...]  # the same checks for the corrected cameras
    rivals: tuple[str, ...]  # names of other errors that explain the measurements as well


def score(checks: Sequence[Check]) -> float:
    """How bad checks are together: the mean logarithm of their multiples of the limit."""
    return float(np.mean(np.log([badness(check) for check in checks])))


def is_suspicious(checks: Sequence[Check]) -> bool:
    """Whether a check failed or is close to its limit."""
    return any(badness(check) > _suspicious_from(check) for check in checks)


def _suspicious_from(check: Check) -> float:
    # A single bad pair is no sign of an error in all cameras, which would put more matches behind them.
    at_most_one = check.at_least and (100 - check.value) * check.measured <= 100 * (1 + 1e-9)
    return PASSED if check.name in (CENTRED, SIDES) or at_most_one else SUSPICIOUS


def is_decisive(before: Sequence[Check], after: Sequence[Check]) -> bool:
    """Whether a correction fixes what failed, or else reduces an error by far, and makes nothing worse."""
    rows = [(badness(old), badness(new), _suspicious_from(old)) for old, new in zip(before, after, strict=True)]
    fixed = all(new <= PASSED or (old > PASSED and new <= old / DECISIVE) for old, new, _ in rows)
    better = any(new <= max(old, PASSED) / DECISIVE or (old > PASSED >= new) for old, new, least in rows if old > least)
    return fixed and better


def explain(
    stated: Hypothesis, evidence: Sequence[Evidence], names: Sequence[str], sizes: np.ndarray, views: np.ndarray
) -> tuple[Explanation | None, tuple[str, ...]]:
    """Find the error whose correction makes the measured errors decisively smaller.

    Args:
        stated: the cameras that the scene states.
        evidence: what can be measured again.
        names: those of the images.
        sizes: (V, 2) their height and width.
        views: the views that are measured.

    Returns:
        The explanation, None without one; and the names of all errors that were tried.
    """
    quick = [item for item in evidence if not item.slow] or list(evidence)
    before = _measured(evidence, stated)
    with_depth = [item for item in evidence if getattr(item, "surfaces", None) is not None]
    others = [item for item in evidence if item not in with_depth]
    # Wrong depth does not explain failures of the rest.
    if not all(check.passed for check in _measured(others, stated)):
        with_depth = []
    candidates = [*camera_candidates(stated, sizes), *resolution_candidates(stated, sizes)]
    candidates += permutation_candidates(stated, names, evidence, views)
    candidates += depth_candidates(stated) if with_depth else []
    candidates += _scales(stated, quick, with_depth)
    tried = tuple(dict.fromkeys(candidate.name for candidate in candidates))

    candidates.sort(key=lambda candidate: COMMON.index(candidate.name) if candidate.name in COMMON else len(COMMON))
    scores = [score(_measured(quick, candidate.hypothesis)) for candidate in candidates]
    finalists = np.argsort(scores, kind="stable")[:FINALISTS].tolist()
    # Quick evidence cannot distinguish errors of the depth.
    finalists += [rank for rank, candidate in enumerate(candidates) if candidate.name.startswith("depth")]
    decisive = []
    for rank in dict.fromkeys(finalists):
        after = _measured(evidence, candidates[rank].hypothesis)
        if is_decisive(before, after):
            decisive.append((score(after), rank, candidates[rank]))
    if not decisive:
        return None, tried
    lowest = min(value for value, _, _ in decisive)
    name = min((row for row in decisive if row[0] <= lowest + TIE), key=lambda row: row[1])[2].name
    # Among corrections of one kind, the simplest of nearly equal ones: 2, rather than 1.998.
    same = [row for row in decisive if row[2].name == name]
    value, _, best = min((row for row in same if row[0] <= lowest + RIVAL), key=lambda row: row[1])
    close = dict.fromkeys(row[2].name for row in decisive if row[0] <= value + RIVAL)
    # The same error combined with another one is no rival.
    rivals = [name for name in close if not name.startswith(best.name)]
    checks = [
        tuple(check for item in evidence for check in item.measure_all(hypothesis))
        for hypothesis in (stated, best.hypothesis)
    ]
    return Explanation(best, checks[0], checks[1], tuple(rivals)), tried


def invisible_errors(stated: Hypothesis, evidence: Sequence[Evidence], sizes: np.ndarray) -> tuple[str, ...]:
    """Names of common errors that would pass all checks of this scene, whose stated cameras pass."""
    candidates = [*camera_candidates(stated, sizes), scaled(stated, np.full(2, 0.5))]
    usual = {candidate.name: candidate.hypothesis for candidate in reversed(candidates) if candidate.name in COMMON[:4]}
    return tuple(name for name in COMMON[:4] if not is_suspicious(_measured(evidence, usual[name])))


def _measured(evidence: Sequence[Evidence], hypothesis: Hypothesis) -> list[Check]:
    return [check for item in evidence for check in item.measure(hypothesis)]


def _scales(stated: Hypothesis, quick: Sequence[Evidence], with_depth: Sequence[Evidence]) -> list[Candidate]:
    """The best scales of K, of focal lengths and of depth."""
    found = _refined(SCALES, quick, lambda scale: scaled(stated, np.full(2, scale)))
    found += _refined(SCALES, quick, partial(focal_scaled, stated))
    if with_depth:
        found += _refined(DEPTH_SCALES, with_depth, partial(depth_scaled, stated))
    return found


def _refined(scales: np.ndarray, evidence: Sequence[Evidence], make: Callable[[float], Candidate]) -> list[Candidate]:
    """The best scale, searched on a grid and refined; a round number near it comes first."""
    from scipy.optimize import minimize_scalar

    def cost(logarithm: float) -> float:
        return score(_measured(evidence, make(float(np.exp(logarithm))).hypothesis))

    logarithms = np.log(scales)
    step = logarithms[1] - logarithms[0]
    middle = logarithms[int(np.argmin([cost(value) for value in logarithms]))]
    found = minimize_scalar(
        cost, bounds=(middle - step, middle + step), method="bounded", options={"maxiter": 15, "xatol": 1e-3}
    )
    scale = float(np.exp(found.x))
    near = [nice for nice in NICE if abs(np.log(scale / nice)) < NEAR]
    return [make(value) for value in (*near, scale) if abs(np.log(value)) > NEAR]
