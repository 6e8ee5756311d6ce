"""Accuracy and completeness of point clouds."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_float, check_positive, describe, moved
from lsmgeo.errors import DTypeError, OptionError, ShapeError

__all__ = ["CloudScores", "point_cloud_scores"]


class CloudScores(NamedTuple):
    """Distances between two point clouds."""

    accuracy: float  # mean distance of a predicted point to the nearest true one, world units
    completeness: float  # mean distance of a true point to the nearest predicted one, world units
    precision: float  # share of the predicted points nearer than the threshold to a true one
    recall: float  # share of the true points nearer than the threshold to a predicted one
    f_score: float  # harmonic mean of precision and recall


def point_cloud_scores(
    predicted: Tensor | np.ndarray, true: Tensor | np.ndarray, threshold: float, *, cell: float | None = None
) -> CloudScores:
    """Compare two point clouds by the distances of their points to the nearest point of the other.

    Equation: precision ``P = |{p : min_t |p - t| < threshold}| / |predicted|``, recall R the same with the clouds
    exchanged, F-score ``2 P R / (P + R)`` (Knapitsch et al. 2017, section 4); accuracy and completeness are the mean
    distances in the two directions. Distances to an empty cloud are infinite, and measures over its points are NaN. The
    F-score is 0 where one cloud is empty, and NaN where both are.

    Args:
        predicted: (N, 3), a tensor or an array.
        true: (M, 3).
        threshold: world units, above 0.
        cell: if given, the points of either cloud within a cube of this side are first replaced by their mean, so that
            dense regions count no more than others (Knapitsch et al.: half the threshold).

    Returns:
        `CloudScores`. Nothing is differentiable.

    Raises:
        ShapeError: a cloud is not (N, 3).
        DTypeError: a cloud is not an array of numbers.
        OptionError: a coordinate is not finite, ``threshold`` or ``cell`` is not above 0.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import point_cloud_scores
        >>> true = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
        >>> scores = point_cloud_scores(true[:2] + torch.tensor([0, 0.1, 0]), true, 0.2)
        >>> scores.accuracy, scores.precision, scores.recall, scores.f_score
        (0.1, 1.0, 0.5, 0.6667)
    """
    from scipy.spatial import cKDTree

    who = "point_cloud_scores"
    limit = check_positive(who, "threshold", threshold)
    side = None if cell is None else check_positive(who, "cell", cell)
    clouds = [_as_points(who, name, value) for name, value in (("predicted", predicted), ("true", true))]
    p, t = clouds if side is None else [_averaged(points, side) for points in clouds]
    to_true = cKDTree(t).query(p)[0] if len(t) and len(p) else np.full(len(p), np.inf)
    to_predicted = cKDTree(p).query(t)[0] if len(t) and len(p) else np.full(len(t), np.inf)
    precision, recall = (_mean(distances < limit) for distances in (to_true, to_predicted))
    return CloudScores(_mean(to_true), _mean(to_predicted), precision, recall, _harmonic_mean(precision, recall))


def _as_points(who: str, name: str, value: Tensor | np.ndarray) -> np.ndarray:
    if isinstance(value, Tensor):
        check_float(who, name, value, "(N, 3)", rank=2)
        value = moved(who, name, value.detach(), torch.device("cpu")).double().numpy()
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DTypeError(f"{who}: {name} must be a tensor or an array of numbers (N, 3); got {describe(value)}")
    if value.ndim != 2 or value.shape[1] != 3:
        raise ShapeError(f"{who}: {name} must be (N, 3); got {value.shape}")
    points = value.astype(np.float64)
    if not np.isfinite(points).all():
        raise OptionError(f"{who}: {name} must be finite; {int((~np.isfinite(points)).any(1).sum())} points are not")
    return points


def _averaged(points: np.ndarray, cell: float) -> np.ndarray:
    """The means of the points in each cube of a lattice through the origin."""
    _, places, counts = np.unique(np.floor(points / cell), axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(places.ravel(), weights=axis, minlength=len(counts)) for axis in points.T]
    return np.asarray(np.stack(sums, -1) / counts[:, None])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _harmonic_mean(precision: float, recall: float) -> float:
    if math.isnan(precision) and math.isnan(recall):
        return math.nan
    return 2 * precision * recall / (precision + recall) if precision > 0 and recall > 0 else 0.0
