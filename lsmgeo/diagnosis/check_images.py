"""Examine what a path holds: posed images are measured with their own cameras, then with common errors corrected."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.data import PosedImages
from lsmgeo.data.posed_images import Voxels
from lsmgeo.diagnosis.evidence import Evidence, Features, Points, gather_evidence, pair_medians
from lsmgeo.diagnosis.feature_matching import choose_views
from lsmgeo.diagnosis.find_cause import explain, invisible_errors, is_suspicious
from lsmgeo.diagnosis.findings import LIMITS, Cause, Check, Findings, badness, format_value, share
from lsmgeo.diagnosis.half_pixel import Shift, find_shifts, is_certain, is_half_a_pixel, is_large, nearer_half
from lsmgeo.diagnosis.residuals import reprojection_errors, sampson_distances
from lsmgeo.diagnosis.scene_summary import describe_scene, find_gap, implausibilities
from lsmgeo.diagnosis.two_view_geometry import Hypothesis, stated_hypothesis

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from typing import Any

    from lsmgeo.diagnosis.find_cause import Explanation

__all__ = ["Examination", "examine", "examine_images"]

# With more outliers than this fraction of the views, the others are not trusted.
MOST_OUTLIERS = 1 / 3
LISTED = 5
SHUFFLED = "frames shuffled"
# Measurements of correct cameras stay below this multiple of their limit.
WELL = 0.5
LEAST_PAIRS, LEAST_OBSERVED = 2, 10


class Examination(NamedTuple):
    """The findings, and the data to draw them."""

    findings: Findings
    evidence: tuple[Evidence, ...]
    hypothesis: Hypothesis


def examine(content: Any, path: Path) -> Findings:
    """Check whether cameras, images, depth and voxels are consistent, and name the likely cause if they are not.

    Args:
        content: what a reader returned: posed images, only voxels, or a calibration.
        path: its file or folder, for messages.

    Returns:
        The findings.

    Raises:
        DataError: a file that is needed is missing or damaged.
    """
    if isinstance(content, PosedImages):
        return examine_images(content).findings
    if isinstance(content, Voxels):
        from lsmgeo.diagnosis.check_voxels import examine_voxels

        return examine_voxels(content, path)
    from lsmgeo.diagnosis.check_calibration import examine_calibration

    return examine_calibration(content, path)


def examine_images(scene: PosedImages) -> Examination:
    """Measure whether cameras, images and their depth, points and voxels are consistent, and find the cause if not.

    Of more than 40 images, the same runs of successive ones are measured every time.

    Args:
        scene: the images; they are read one at a time.

    Returns:
        The findings, and the evidence for figures.

    Raises:
        DataError: an image, mask or depth map is missing or damaged.
    """
    sizes = np.array([scene.size(view) for view in range(len(scene))])
    views = choose_views(len(scene))
    stated = stated_hypothesis(scene)
    evidence = gather_evidence(scene, views, sizes, stated)
    checks = [check for item in evidence for check in item.measure_all(stated)]
    tried: tuple[str, ...] = ()
    cause, remarks = None, implausibilities(stated.cameras, sizes)
    passed = all(check.passed for check in checks)
    with_views, outliers = _check_single_views(scene, checks, evidence, stated)
    if is_suspicious(checks):
        explanation, tried = explain(stated, evidence, scene.names, sizes, views)
        if explanation is not None and (outliers is None or _beats_single_views(explanation, passed=passed)):
            cause = _explained_cause(explanation)
    if cause is None:
        shifts = find_shifts(evidence, stated.cameras)
        half, corrected = _half_a_pixel(shifts, stated)
        # Half a pixel may make one view an outlier; with the correction it is not.
        if outliers is None or half is None:
            checks, cause = with_views, half or outliers
        elif _check_single_views(scene, checks, evidence, corrected)[1] is None:
            cause = half
        else:
            checks, cause = with_views, outliers
        if cause is None and not passed:
            remarks.append(f"no single error explains this; tried: {', '.join(tried)}, half a pixel")
        elif cause is None and checks and not any(is_certain(shift) for shift in shifts):
            remarks.append("a shift of half a pixel cannot be detected in this data")
        if cause is None and passed:
            remarks += [
                f"the {shift.source} fit best with principal points moved by {-shift.x:+.1f}, {-shift.y:+.1f} px"
                for shift in shifts
                if is_large(shift)
            ]
    if cause is None and passed and checks and (hidden := invisible_errors(stated, evidence, sizes)):
        remarks.append(f"these errors cannot be detected in this data: {', '.join(hidden)}")
    facts = describe_scene(scene, views, evidence, stated, sizes)
    gap = None if checks or cause is not None else find_gap(scene)
    findings = Findings(tuple(facts), tuple(checks), cause, tuple(remarks), gap=gap)
    return Examination(findings, tuple(evidence), stated)


def _beats_single_views(explanation: Explanation, *, passed: bool) -> bool:
    """Whether an error of all cameras is likelier than single wrong views, although most images agree."""
    if explanation.candidate.name == SHUFFLED:
        # The correct order fixes everything; another camera for a wrong view changes little.
        return all(badness(check) <= WELL for check in explanation.after)
    # Where most images agree, there is no error in all cameras.
    return not passed


def _explained_cause(explanation: Explanation) -> Cause:
    """The cause, with the two checks that the correction improves most."""
    candidate, before, after, rivals = explanation
    gains = [badness(old) / badness(new) for old, new in zip(before, after, strict=True)]
    parts = []
    for index in np.argsort(gains)[::-1][:2].tolist():
        if gains[index] > 1.5:
            old, new = before[index], after[index]
            parts.append(
                f"{old.name}: {format_value(new.value)} instead of {format_value(old.value)} {old.unit}".rstrip()
            )
    evidence = f"{candidate.correction}, {'; '.join(parts)}"
    if rivals:
        evidence += f" (this data cannot distinguish it from: {', '.join(rivals)})"
    return Cause(candidate.name, evidence, candidate.remedy)


def _half_a_pixel(shifts: Sequence[Shift], stated: Hypothesis) -> tuple[Cause | None, Hypothesis]:
    """Half a pixel, if most of the certain shifts are half a pixel; and the corrected cameras."""
    halves = [shift for shift in shifts if is_half_a_pixel(shift)]
    # Other shifts that are as certain count against it.
    against = [shift for shift in shifts if is_certain(shift) and not is_half_a_pixel(shift)]
    if len(halves) <= len(against):
        return None, stated
    best = min(halves, key=lambda shift: max(shift.error_x, shift.error_y))
    step = nearer_half(best)
    large, sign = step > 0, np.sign(step)
    corrected = Hypothesis(stated.cameras.shifted(-step, -step), stated.depth_cameras.shifted(-step, -step))
    evidence = (
        f"the {best.source} put the principal points {best.x * sign:.2f} +- {best.error_x:.2f} px (x) and "
        f"{best.y * sign:.2f} +- {best.error_y:.2f} px (y) too {'far' if large else 'near'}"
    )
    remedy = (
        "cx and cy are measured from the corner of the first pixel instead of its centre: subtract 0.5."
        if large
        else "0.5 was subtracted from cx and cy once too often: add 0.5."
    )
    return Cause("half a pixel", evidence, remedy), corrected


def _check_single_views(
    scene: PosedImages, checks: list[Check], evidence: Sequence[Evidence], stated: Hypothesis
) -> tuple[list[Check], Cause | None]:
    """Add a check of single views if most agree; outliers are a cause of their own."""
    found = [_outliers_by_features(item, stated) for item in evidence if isinstance(item, Features)]
    found += [_outliers_by_points(item, stated) for item in evidence if isinstance(item, Points)]
    outliers, judged = (set().union(*views) for views in zip((set(), set()), *found, strict=True))
    if not judged or len(outliers) > MOST_OUTLIERS * len(judged):
        return checks, None
    agree = 1 - len(outliers) / len(judged)
    checks = [*checks, share("images that agree with the others", agree, "views", len(judged), "images")]
    if not outliers:
        return checks, None
    names = ", ".join(scene.names[view] for view in sorted(outliers)[:LISTED])
    more = f" and {len(outliers) - LISTED} more" if len(outliers) > LISTED else ""
    evidence_text = f"{names}{more} disagree with all others, which agree with each other"
    return checks, Cause("some views are off", evidence_text, "Leave these images out, or estimate their poses again.")


def _outliers_by_features(features: Features, stated: Hypothesis) -> tuple[set[int], set[int]]:
    """Views whose pairs are all bad, removed one by one; and all views that have enough pairs to judge."""
    first, second = features.matches.first, features.matches.second
    medians = pair_medians(np.abs(sampson_distances(features.matches, stated.cameras)), features.matches)
    # If most pairs are bad, no single view is an outlier.
    if not np.median(medians) <= features.limit:
        return set(), set()
    bad = medians > _outlier_limit(medians, features.limit)
    left = np.ones(len(first), bool)
    outliers: set[int] = set()
    while (bad & left).any():
        views = np.union1d(first[left], second[left]).tolist()
        pairs = {view: left & ((first == view) | (second == view)) for view in views}
        enough = {view: of for view, of in pairs.items() if of.sum() >= LEAST_PAIRS}
        shares = {view: (float(bad[of].mean()), int(bad[of].sum())) for view, of in enough.items()}
        if not shares:
            break
        view = max(shares, key=lambda view: shares[view])
        if shares[view][0] < 1:
            break
        outliers.add(view)
        left &= ~pairs[view]
    counts = np.bincount(np.concatenate([first, second]))
    return outliers, set(np.flatnonzero(counts >= LEAST_PAIRS).tolist())


def _outlier_limit(medians: np.ndarray, limit: float) -> float:
    """The error from which a view or a pair is an outlier: an error that all share is none."""
    return float(np.clip(LIMITS["view"] * np.median(medians), limit, LIMITS["view"] * limit))


def _outliers_by_points(points: Points, stated: Hypothesis) -> tuple[set[int], set[int]]:
    errors, _, views = reprojection_errors(points.points, stated.depth_cameras)
    known = np.flatnonzero(np.bincount(views) >= LEAST_OBSERVED)
    medians = np.array([np.median(errors[views == view]) for view in known])
    if not len(known) or not np.median(medians) <= points.limit:
        return set(), set()
    return set(known[medians > _outlier_limit(medians, points.limit)].tolist()), set(known.tolist())
