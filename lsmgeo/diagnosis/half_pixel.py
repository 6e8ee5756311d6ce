"""A common shift of the principal points by half a pixel: too small to fail a check, large enough to spoil depth."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.evidence import Features, Points, Silhouettes
from lsmgeo.diagnosis.residuals import reprojections, residuals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.diagnosis.evidence import Evidence
    from lsmgeo.diagnosis.two_view_geometry import Geometry

__all__ = ["Shift", "find_shifts", "is_certain", "is_half_a_pixel", "is_large", "nearer_half"]

STEP = 0.25  # px, for derivatives
ITERATIONS = 20
# Error of real calibrations, px, besides chance; and by how much half a pixel must be likelier than no shift.
SYSTEMATIC, LEAST_GAIN = 0.12, 9.0
# A shift that differs more than this from half a pixel is another one, however large it is.
MOST_LEFT = 16.0
# Largest standard error, px, at which half a pixel can be detected.
LARGEST_ERROR = 0.35
LARGE = 1.0  # px
# Fewer views are too few for the jackknife, which separates errors of single views from a common one.
LEAST_VIEWS = 4
LARGEST_SLOPE = 10.0  # larger near an epipole
LEAST_OBSERVED, LEAST_RESIDUALS = 10, 30
DIAGONAL = np.linspace(-1.0, 1.0, 9)
FARTHEST_TANGENT = 1.0  # px


class Shift(NamedTuple):
    """By how much all principal points are too large, px."""

    source: str  # the evidence it is inferred from
    x: float
    y: float
    error_x: float  # standard error of x
    error_y: float


def find_shifts(evidence: Sequence[Evidence], cameras: Geometry) -> list[Shift]:
    """The common shift of the principal points, inferred from each kind of evidence."""
    found = []
    for item in evidence:
        if isinstance(item, Points):
            found.append(_shift_of_points(item, cameras))
        elif isinstance(item, Features):
            steps = np.stack([residuals(item.matches, cameras.shifted(*step)) for step in _STEPS])
            views = np.stack([item.matches.first, item.matches.second], 1)
            pair = np.repeat(item.matches.pair, 2)
            found.append(_robust_shift("matched features", steps.reshape(len(steps), -1), pair, views))
        elif isinstance(item, Silhouettes):
            found.append(_shift_of_silhouettes(item, cameras))
    return [shift for shift in found if shift is not None]


def is_half_a_pixel(shift: Shift) -> bool:
    """Whether a shift is half a pixel along both axes, with the same sign, and not zero.

    Example:
        >>> from lsmgeo.diagnosis.half_pixel import Shift, is_half_a_pixel
        >>> is_half_a_pixel(Shift("matched features", 0.55, 0.48, 0.05, 0.05))
        True
        >>> is_half_a_pixel(Shift("matched features", 0.2, 0.1, 0.05, 0.05))
        False
        >>> is_half_a_pixel(Shift("matched features", 0.1, 5.9, 0.05, 0.05))
        False
    """
    left = min(_distance(shift, 0.5), _distance(shift, -0.5))
    return _distance(shift, 0.0) - left >= LEAST_GAIN and left <= MOST_LEFT and is_certain(shift)


def nearer_half(shift: Shift) -> float:
    """Which of 0.5 and -0.5 along both axes a shift is closer to, relative to its errors.

    Example:
        >>> from lsmgeo.diagnosis.half_pixel import Shift, nearer_half
        >>> nearer_half(Shift("matched features", -0.1, 0.5, 0.3, 0.05))
        0.5
    """
    return 0.5 if _distance(shift, 0.5) <= _distance(shift, -0.5) else -0.5


def _distance(shift: Shift, expected: float) -> float:
    found, errors = np.array([shift.x, shift.y]), np.array([shift.error_x, shift.error_y])
    return float(((found - expected) ** 2 / (errors**2 + SYSTEMATIC**2)).sum())


def is_large(shift: Shift) -> bool:
    """Whether principal points are off by significantly more than a pixel."""
    found, errors = np.abs([shift.x, shift.y]), np.array([shift.error_x, shift.error_y])
    return is_certain(shift) and bool((found - 3 * errors > LARGE).any())


def is_certain(shift: Shift) -> bool:
    """Whether a shift of half a pixel would have been detected."""
    return max(shift.error_x, shift.error_y) <= LARGEST_ERROR


_STEPS = ((0.0, 0.0), (STEP, 0.0), (-STEP, 0.0), (0.0, STEP), (0.0, -STEP))


def _shift_of_points(points: Points, cameras: Geometry) -> Shift | None:
    """Mean over views of the median reprojection residual."""
    medians = []
    for view, observed in enumerate(points.points.observations):
        if len(observed.points) >= LEAST_OBSERVED:
            medians.append(np.median(reprojections(points.points, cameras, view, view)[0], axis=0))
    if len(medians) < LEAST_VIEWS:
        return None
    mean = np.mean(medians, axis=0)
    errors = np.std(medians, axis=0, ddof=1) / np.sqrt(len(medians)) + 1e-6
    return Shift("sparse points", *(float(value) for value in (*mean, *errors)))


def _shift_of_silhouettes(silhouettes: Silhouettes, cameras: Geometry) -> Shift | None:
    """The shift along the diagonal with the least squared tangent distances, which have no sign to follow."""
    views = np.array(silhouettes.pairs)
    if len(silhouettes.contours) < LEAST_VIEWS:
        return None
    costs = []
    for shift in DIAGONAL:
        distances = silhouettes.distances(cameras.shifted(-shift, -shift), silhouettes.pairs)
        costs.append(np.nansum(np.minimum(distances, FARTHEST_TANGENT) ** 2, axis=1))
    table = np.array(costs)  # (S, P)

    def lowest(chosen: np.ndarray) -> float:
        sums = table[:, chosen].sum(1)
        middle = int(np.clip(sums.argmin(), 1, len(sums) - 2))
        before, here, after = sums[middle - 1 : middle + 2]
        curvature = before - 2 * here + after
        offset = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
        return float(DIAGONAL[middle] + np.clip(offset, -1, 1) * (DIAGONAL[1] - DIAGONAL[0]))

    best = lowest(np.ones(len(views), bool))
    without = np.array([lowest((views != view).all(1)) for view in sorted(silhouettes.contours)])
    error = _jackknife_errors(without[:, None])[0]
    return Shift("silhouettes", best, best, float(error), float(error))


def _jackknife_errors(without: np.ndarray) -> np.ndarray:
    """Jackknife standard errors of estimates (V, K), each without one view: pairs of one view share its errors."""
    spread = without - without.mean(0)
    return np.asarray(np.sqrt((len(without) - 1) / len(without) * (spread**2).sum(0)) + 1e-6)


def _robust_shift(source: str, found: np.ndarray, pair: np.ndarray, views: np.ndarray) -> Shift | None:
    """The shift that minimises signed residuals, with robust weights, and its jackknife errors.

    Args:
        source: the evidence of the residuals.
        found: (5, M) residuals at no shift and at the steps along +x, -x, +y, -y.
        pair: (M,) the pair of views of each one.
        views: (P, 2) the views of each pair.
    """
    slopes = np.stack([found[1] - found[2], found[3] - found[4]], 1) / (2 * STEP)
    largest = np.abs(slopes).max(1)
    sensible = (largest < LARGEST_SLOPE) & (largest > 1e-9)
    r, J, pair = found[0][sensible], slopes[sensible], pair[sensible]
    if len(r) < LEAST_RESIDUALS or len(np.unique(views[np.unique(pair)])) < LEAST_VIEWS:
        return None
    shift = np.zeros(2)
    for _ in range(ITERATIONS):
        left = r + J @ shift
        scale = 1.4826 * np.median(np.abs(left)) + 1e-12
        weight = np.clip(1 - (left / (4.7 * scale)) ** 2, 0, None) ** 2  # Tukey's
        normal = np.einsum("m,mi,mj->mij", weight, J, J)
        right = -(weight * r)[:, None] * J
        if np.linalg.cond(normal.sum(0)) > 1e8:
            return None
        shift = np.linalg.solve(normal.sum(0), right.sum(0))
    count = len(views)
    normals = np.stack([np.bincount(pair, normal[:, i, j], count) for i in (0, 1) for j in (0, 1)], 1).reshape(-1, 2, 2)
    rights = np.stack([np.bincount(pair, right[:, i], count) for i in (0, 1)], 1)
    without = []
    for view in np.unique(views[np.unique(pair)]):
        kept = (views != view).all(1)
        if np.linalg.cond(normals[kept].sum(0)) > 1e8:
            return None
        without.append(np.linalg.solve(normals[kept].sum(0), rights[kept].sum(0)))
    errors = _jackknife_errors(np.array(without))
    # Residuals vanish at cameras shifted by ``shift``: the stated ones are too large by its negative.
    return Shift(source, *(float(value) for value in (*-shift, *errors)))
