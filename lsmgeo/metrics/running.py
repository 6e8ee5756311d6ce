"""Measures of whole sets, accumulated over batches and processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from lsmgeo._checks import check_float, check_number, describe, moved
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.metrics.depth import RADIUS, median_depth_error
from lsmgeo.metrics.voxels import voxel_iou

__all__ = ["CategoryMeans", "DepthError", "Running", "VoxelIoU", "category_means"]


class CategoryMeans(NamedTuple):
    """A measure of a set of models: the mean of each category, and the mean of the categories."""

    mean: float  # over the categories that have one; NaN where none has
    categories: dict[str, float]  # in alphabetical order; NaN where no model counts
    counts: dict[str, int]  # of models that count


def category_means(values: Tensor | Sequence[float], categories: Sequence[str]) -> CategoryMeans:
    """Average a measure within each category, then over the categories.

    Every category weighs the same, however many models it has (Kar et al. 2017, section 4: "we compute a per class
    average and take the mean"). NaN, the value of a model without any pixel that counts, is left out. Sums are rounded
    once (`math.fsum`), so that the order of the models does not matter.

    Args:
        values: (B,), one number per model.
        categories: B names.

    Returns:
        `CategoryMeans`.

    Raises:
        ShapeError: numbers of values and names differ.
        DTypeError: a category that is not text.

    Example:
        >>> from lsmgeo.metrics import category_means
        >>> found = category_means([0.5, 0.7, 0.2], ["car", "car", "lamp"])
        >>> found.mean, found.categories, found.counts
        (0.4, {'car': 0.6, 'lamp': 0.2}, {'car': 2, 'lamp': 1})
    """
    collected: dict[str, list[float]] = {}
    _collect("category_means", collected, values, categories)
    return _means(collected)


class Running:
    """Any measure of single models, averaged over a set in parts.

    One number per model and field is kept, so that `compute` equals, to the last digit, `category_means` of one call on
    everything, for any parts in any order. `merge` joins the results of several processes: objects of this class are
    small and can be pickled (``torch.distributed.all_gather_object``).

    Args:
        measure: a function of this package that returns (B,) tensors or numbers, or named tuples of them.
        options: keyword arguments of every call.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import Running, depth_errors
        >>> errors = Running(depth_errors)
        >>> errors.update(torch.full((2, 3, 4), 2.5), torch.full((2, 3, 4), 2.0), categories=["car", "lamp"])
        >>> errors.compute()["abs_rel"].categories
        {'car': 0.25, 'lamp': 0.25}
    """

    def __init__(self, measure: Callable[..., Any], **options: Any):
        self.measure, self.options = measure, options
        self._fields: dict[str, dict[str, list[float]]] = {}

    def update(self, *arguments: Any, categories: Sequence[str] | str = "all") -> None:
        """Add more models.

        Args:
            arguments: those of the measure.
            categories: the name of each model's category, or one name for all.
        """
        found = self.measure(*arguments, **self.options)
        fields = found._asdict() if hasattr(found, "_asdict") else {self.measure.__name__: found}
        for name, values in fields.items():
            numbers = torch.as_tensor(values, dtype=torch.float64).reshape(-1)
            names = [categories] * len(numbers) if isinstance(categories, str) else categories
            _collect(f"{self.measure.__name__}, Running.update", self._fields.setdefault(name, {}), numbers, names)

    def merge(self, other: Running) -> None:
        """Add the models of another one.

        Raises:
            OptionError: it measures something else.
        """
        if (self.measure, self.options) != (other.measure, other.options):
            mine, theirs = ((r.measure.__name__, r.options) for r in (self, other))
            raise OptionError(f"Running.merge: other must measure {mine}; got {theirs}")
        for field, collected in other._fields.items():
            _extend(self._fields.setdefault(field, {}), collected)

    def compute(self) -> dict[str, CategoryMeans]:
        """Means of every field of the measure, over all models so far."""
        return {name: _means(collected) for name, collected in self._fields.items()}


class _OneMeasure:
    """One number per model, averaged over a set in parts."""

    def __init__(self, **options: Any):
        self.options = options
        self._collected: dict[str, list[float]] = {}

    def merge(self, other: Self) -> None:
        """Add the models of another one.

        Raises:
            OptionError: its options differ.
        """
        if self.options != other.options:
            who = type(self).__name__
            raise OptionError(f"{who}.merge: other must have the options {self.options}; got {other.options}")
        _extend(self._collected, other._collected)

    def compute(self) -> CategoryMeans:
        """The means over all models so far; NaN where there is none."""
        return _means(self._collected)


class VoxelIoU(_OneMeasure):
    """Voxel IoU of a set: per category, and the mean of the categories. See `voxel_iou`, `category_means`, `Running`.

    Models whose true occupancy is empty are left out.

    Args:
        threshold: of the probabilities.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import VoxelIoU
        >>> iou, truth = VoxelIoU(), torch.ones(2, 4, 4, 4, dtype=torch.bool)
        >>> predicted = torch.ones(2, 4, 4, 4)
        >>> predicted[1, :, :, 1:] = 0
        >>> iou.update(predicted, truth, ["car", "lamp"])
        >>> iou.compute()
        CategoryMeans(mean=0.625, categories={'car': 1.0, 'lamp': 0.25}, counts={'car': 1, 'lamp': 1})
    """

    def __init__(self, *, threshold: float = 0.4):
        super().__init__(threshold=check_number("VoxelIoU", "threshold", threshold, "a number"))

    def update(self, predicted: Tensor, occupancy: Tensor, categories: Sequence[str] | str = "all") -> None:
        """Add more models.

        Args:
            predicted: (B, D, H, W), see `voxel_iou`.
            occupancy: (B, D, H, W) bool.
            categories: B names, or one for all.
        """
        _check_rank("VoxelIoU.update", "predicted", predicted, 4, "(B, D, H, W)")
        values = voxel_iou(predicted, occupancy, **self.options, skip_empty=True)
        _collect("VoxelIoU.update", self._collected, values, categories)


class DepthError(_OneMeasure):
    """The paper's depth error of a set: median per map, mean over maps, models and categories.

    Views without any pixel that counts are left out of a model's mean, and models that have only such views out of
    their category's. See `median_depth_error`, `category_means`, `Running`.

    Args:
        center: see `median_depth_error`.
        radius: see there.
        rule: "paper" or "release", see there.

    Example:
        >>> import torch
        >>> from lsmgeo.metrics import DepthError
        >>> error, depth = DepthError(), torch.full((1, 3, 4, 5), 2.0)
        >>> error.update(depth + torch.tensor([0.1, 0.2, 0.6]).reshape(1, 3, 1, 1), depth, ["car"])
        >>> error.compute()
        CategoryMeans(mean=0.3, categories={'car': 0.3}, counts={'car': 1})
    """

    def __init__(self, *, center: float = 2.0, radius: float = RADIUS, rule: str = "paper"):
        super().__init__(center=center, radius=radius, rule=rule)
        median_depth_error(torch.zeros(0, 0), torch.zeros(0, 0), **self.options)  # checks the options

    def update(
        self, predicted: Tensor, depth: Tensor, categories: Sequence[str] | str = "all", mask: Tensor | None = None
    ) -> None:
        """Add more models.

        Args:
            predicted: (B, V, h, w).
            depth: (B, V, h, w), the truth; 0 on the background.
            categories: B names, or one for all.
            mask: (B, V, h, w) bool, pixels that may count.
        """
        _check_rank("DepthError.update", "predicted", predicted, 4, "(B, V, h, w)")
        views = median_depth_error(predicted, depth, mask, **self.options).error
        _collect("DepthError.update", self._collected, views.nanmean(1), categories)


def _check_rank(who: str, name: str, value: Any, rank: int, expected: str) -> None:
    if isinstance(value, Tensor) and value.dim() != rank:
        raise ShapeError(f"{who}: {name} must be {expected}; got {tuple(value.shape)}")


def _collect(
    who: str, collected: dict[str, list[float]], values: Tensor | Sequence[float], categories: Sequence[str] | str
) -> None:
    if isinstance(categories, Tensor) or not isinstance(categories, Iterable):
        raise DTypeError(f"{who}: categories must be names; got {describe(categories)}")
    if not isinstance(values, Tensor):
        try:
            values = torch.tensor(values, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise DTypeError(f"{who}: values must be numbers, one a model; got {describe(values)}") from None
    elif not values.is_complex() and values.layout == torch.strided:
        values = values.double()  # counts of pixels are integers
    check_float(who, "values", values, "(B,), one a model", rank=1)
    numbers = moved(who, "values", values, torch.device("cpu")).tolist()
    names = [categories] * len(numbers) if isinstance(categories, str) else list(categories)
    if len(names) != len(numbers):
        raise ShapeError(f"{who}: categories must be as many names as values, {len(numbers)}; got {len(names)}")
    if strange := [name for name in names if not isinstance(name, str)]:
        raise DTypeError(f"{who}: categories must be names; got {describe(strange[0])}")
    for name, number in zip(names, numbers, strict=True):
        collected.setdefault(name, []).append(number)


def _extend(collected: dict[str, list[float]], others: Mapping[str, Iterable[float]]) -> None:
    for name, numbers in others.items():
        collected.setdefault(name, []).extend(numbers)


def _means(collected: Mapping[str, Sequence[float]]) -> CategoryMeans:
    counted = {name: [x for x in collected[name] if not math.isnan(x)] for name in sorted(collected)}
    means = {name: _mean(numbers) for name, numbers in counted.items()}
    overall = _mean([mean for mean in means.values() if not math.isnan(mean)])
    return CategoryMeans(overall, means, {name: len(numbers) for name, numbers in counted.items()})


def _mean(numbers: Sequence[float]) -> float:
    return math.fsum(numbers) / len(numbers) if numbers else math.nan
