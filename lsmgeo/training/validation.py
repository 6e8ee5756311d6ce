"""Evaluation during training: always on the same shapes, with the same views."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Batch, Sample
from lsmgeo.metrics import DepthError, VoxelIoU
from lsmgeo.models.blocks import evaluation_mode
from lsmgeo.models.losses import sum_loss
from lsmgeo.training.example_figures import Example
from lsmgeo.training.launch import StopRequest, any_true, gather

__all__ = ["Evaluation", "evaluate_model"]


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        measure: "iou" (at 0.4, of voxels) or "depth_error" (median, world units).
        by_view: the mean of the categories after 1 to V views.
        categories: of each category, after V views.
        loss: as in training, after every view.
        examples: the first shapes with their predictions.
    """

    measure: str
    by_view: dict[int, float]
    categories: dict[str, float]
    loss: float
    examples: list[Example]

    @property
    def value(self) -> float:
        """The measure after the last view."""
        return self.by_view[max(self.by_view)]

    @property
    def title(self) -> str:
        """The name of the measure, for people."""
        return "IoU" if self.measure == "iou" else self.measure.replace("_", " ")

    @property
    def words(self) -> str:
        """The measure by the number of views, for people."""
        values = self.by_view.values()
        shown = [f"{100 * value:.1f}" if self.measure == "iou" else f"{value:.4f}" for value in values]
        unit = " %" if self.measure == "iou" else ""
        return f"{', '.join(shown)}{unit} after 1 to {len(shown)} views"

    def is_better_than(self, value: float | None) -> bool:
        """Whether the measure is better than a value; every measure is better than None or NaN."""
        if value is None or math.isnan(value):
            return True
        return self.value > value if self.measure == "iou" else self.value < value

    def fields(self) -> dict[str, Any]:
        """Its fields in the log."""
        return {self.measure: self.by_view, "per_category": self.categories, "loss": self.loss}


def evaluate_model(
    model: nn.Module, batches: Iterator[Batch], stop: StopRequest, *, region: str, loss: str, images: int
) -> Evaluation | None:
    """Measure a model on batches, which together with those of the other processes are the whole set.

    Args:
        model: its mode is restored afterwards.
        batches: every shape with V views.
        stop: where any process has one, nothing is measured.
        region: of the loss of depth.
        loss: of voxels.
        images: number of shapes kept with their predictions.

    Returns:
        The same in all processes except for the examples; None where a stop was requested.
    """
    measures: dict[int, Any] = {}
    total = count = 0.0
    examples: list[Example] = []
    with evaluation_mode(model):
        for batch in batches:
            if stop:
                break
            output = model(batch.images, batch.cameras, batch.view_mask)
            terms, number = sum_loss(output, batch, region=region, loss=loss)
            total, count = total + float(terms), count + float(number)
            names = [name or "all" for name in batch.category]
            has_depth = hasattr(output, "depth")
            predicted = output.depth.float() if has_depth else output.logits.float().sigmoid()
            for view, of_view in enumerate(predicted.unbind(1), 1):
                if has_depth:
                    measures.setdefault(view, DepthError()).update(of_view, batch.depth, names, batch.mask)
                else:
                    measures.setdefault(view, VoxelIoU()).update(of_view, batch.occupancy, names)
            for index in range(min(images - len(examples), len(predicted))):
                examples.append(Example(_sample(batch, index), predicted[index].cpu()))
    if any_true(bool(stop)):
        return None
    parts = gather((measures, total, count))
    together, *others = [part[0] for part in parts if part[0]]  # a process may have no shape
    for other in others:
        for view, measure in other.items():
            together[view].merge(measure)
    means = {view: measure.compute() for view, measure in sorted(together.items())}
    return Evaluation(
        measure="depth_error" if isinstance(together[1], DepthError) else "iou",
        by_view={view: found.mean for view, found in means.items()},
        categories=means[max(means)].categories,
        loss=sum(part[1] for part in parts) / max(1.0, sum(part[2] for part in parts)),
        examples=examples,
    )


def _sample(batch: Batch, index: int) -> Sample:
    """One shape of a batch, on the CPU."""

    def pick(field: Any) -> Any:
        if isinstance(field, CameraTensors):
            return field.at(index).to("cpu")
        return field[index].cpu() if isinstance(field, Tensor) else field and field[index]

    return Sample(*map(pick, batch[:-1]))
