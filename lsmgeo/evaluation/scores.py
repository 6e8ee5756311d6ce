"""Measures of every shape and condition, and what they are on the average, with standard errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from lsmgeo.evaluation.report import Cell
from lsmgeo.metrics import CategoryMeans, category_means, voxel_iou

__all__ = ["Scores", "iou_by_view", "means_of", "standard_error"]


@dataclass(eq=False)
class Scores:
    """A measure of N shapes under K conditions, such as numbers of views, which come batch by batch.

    Attributes:
        names: of the shapes.
        categories: of the shapes.
        values: K numbers of each.
    """

    names: list[str] = field(default_factory=list)
    categories: list[str] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)

    def add(self, names: Iterable[str], categories: Iterable[str | None], values: Tensor) -> None:
        """Take more shapes.

        Args:
            names: B names.
            categories: B names, or Nones.
            values: (B, K).
        """
        self.names += names
        self.categories += [category or "all" for category in categories]
        self.values += values.double().tolist()

    def column(self, place: int) -> list[float]:
        """One condition's numbers."""
        return [numbers[place] for numbers in self.values]

    def means(self, place: int) -> CategoryMeans:
        """One condition's means, of the categories and of all."""
        return category_means(self.column(place), self.categories)

    def cells(self, factor: float = 1.0) -> list[Cell]:
        """The mean of the categories with its standard error, under every condition."""
        conditions = range(len(self.values[0]) if self.values else 0)
        return [means_of(self.column(place), self.categories, factor) for place in conditions]

    def category_cells(self, place: int, categories: Sequence[str], factor: float = 1.0) -> list[Cell]:
        """One condition's means of some categories and, last, of all."""
        means = self.means(place)
        cells = [Cell(factor * means.categories.get(name, math.nan)) for name in categories]
        return [*cells, means_of(self.column(place), self.categories, factor)]

    def by_shape(self, key: str) -> list[dict[str, Any]]:
        """For JSON: name, category and numbers of every shape."""
        return [
            {"name": name, "category": category, key: values}
            for name, category, values in zip(self.names, self.categories, self.values, strict=True)
        ]


def means_of(values: Sequence[float], categories: Sequence[str], factor: float = 1.0) -> Cell:
    """The mean of the categories' means and its standard error, times a factor."""
    mean = category_means(values, categories).mean
    return Cell(factor * mean, abs(factor) * standard_error(values, categories))


def standard_error(values: Sequence[float], categories: Sequence[str]) -> float:
    """The standard error of the mean of categories' means, of shapes drawn anew within the categories.

    Equation: ``sqrt(sum_c s_c^2 / n_c) / C`` with s_c^2 the unbiased variance within category c of n_c shapes; a
    category with one shape takes the variance that the others have together.

    Args:
        values: one number a shape; NaN counts nowhere.
        categories: of each.

    Returns:
        NaN where no category has two shapes.

    Example:
        >>> round(standard_error([0.5, 0.7, 0.2, 0.4], ["car", "car", "lamp", "lamp"]), 4)
        0.0707
    """
    groups: dict[str, list[float]] = {}
    for value, category in zip(values, categories, strict=True):
        if not math.isnan(value):
            groups.setdefault(category, []).append(value)
    squares = [float(np.var(group)) * len(group) for group in groups.values()]
    freedom = sum(len(group) - 1 for group in groups.values())
    if freedom == 0:
        return math.nan
    pooled = sum(squares) / freedom
    variances = [
        square / (len(group) - 1) if len(group) > 1 else pooled
        for square, group in zip(squares, groups.values(), strict=True)
    ]
    total = sum(variance / len(group) for variance, group in zip(variances, groups.values(), strict=True))
    return math.sqrt(total) / len(groups)


def iou_by_view(predicted: Tensor, occupancy: Tensor, threshold: float = 0.4) -> Tensor:
    """IoU (B, V) of what is predicted after every view (B, V, D, H, W) with the truth (B, D, H, W), NaN if empty."""
    return voxel_iou(predicted, occupancy[:, None].expand(predicted.shape), threshold=threshold, skip_empty=True)


def joined(scores: Mapping[str, Scores], key: str) -> list[dict[str, Any]]:
    """For JSON: what was measured of every shape, by who was measured."""
    first = next(iter(scores.values()))
    return [
        {
            "name": name,
            "category": category,
            key: {who: one.values[place] for who, one in scores.items()},
        }
        for place, (name, category) in enumerate(zip(first.names, first.categories, strict=True))
    ]
