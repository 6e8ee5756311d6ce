"""How much the order of the views matters: the same views in several orders."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.evaluation.held_out_shapes import ORDER, Shapes, batches, generator_of
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Cell, Report, Row, Scores, Table, iou_by_view

__all__ = ["report_order"]

COUNTS = (2, 4, 8, 12, 16, 20)
# Of the IoU of a shape over the orders: mean, standard deviation, range. Of its voxels: deviation of probabilities, and
# of those that are occupied in some order the share that is empty in another.
MEASURES = (
    "mean IoU [%]", "deviation [points]", "range [points]", "deviation of voxels [%]", "voxels that change [%]"
)  # fmt: skip
# The difference of the mean IoU of the whole set between the best and the worst order.
OF_THE_SET = "range of the set [points]"


def report_order(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure how results vary with the order of the views ("very little variance", Kar et al. 2017, section 3).

    The first 2, 4 and 8 views of every shape are used in several random orders. The measures per shape are the standard
    deviation and the range of IoU over the orders; the deviation of each voxel's probability, averaged over the voxels
    that are occupied in any order; the share of these that are empty in another; and the range of the whole set's IoU.

    Options: orders, seed, threshold, batch.

    Returns:
        A table per model, of means over categories; a figure of IoU with the deviation as error bars.
    """
    counts = [count for count in COUNTS if count < views] + ([views] if views > 1 else [])
    scores = {(method.name, count): Scores() for method in methods for count in counts}
    every_order = {key: Scores() for key in scores}
    resolution = shared(methods, "resolution")
    for batch in batches(shapes, views, options.batch, resolution=resolution, progress=options.progress):
        assert batch.occupancy is not None
        for count in counts:
            orders = torch.stack([_orders(options.seed, name, count, options.orders) for name in batch.name])
            for method in methods:
                found = [
                    method.occupancies(*_reordered(batch.images, batch.cameras, orders[:, number]), every=False)
                    for number in range(options.orders)
                ]
                together = torch.stack(found, 1)
                iou = iou_by_view(together, batch.occupancy, options.threshold)
                key = (method.name, count)
                every_order[key].add(batch.name, batch.category, iou)
                scores[key].add(batch.name, batch.category, _spread(together, iou, options.threshold))
    tables, curves = [], []
    for method in methods:
        cells = {count: scores[method.name, count].cells(100) for count in counts}
        means = {count: [cell.value for cell in every_order[method.name, count].cells(100)] for count in counts}
        rows = [Row(f"{count} views", [*cells[count], Cell(max(means[count]) - min(means[count]))]) for count in counts]
        title = f"{method.name}, {options.orders} orders"
        tables.append(Table(f"order of {method.name}", title, (*MEASURES, OF_THE_SET), rows, 2))
        bars = [Cell(cells[count][0].value, cells[count][1].value / 2) for count in counts]  # drawn twice as long
        curves.append(Curve(method.name, counts, bars))
    return Report(
        "order",
        tables,
        {"views": counts, "orders": options.orders, "threshold": options.threshold},
        [
            {"model": name, "views": count, **shape}
            for (name, count), one in scores.items()
            for shape in one.by_shape("mean, deviation, range, deviation of voxels, voxels that change")
        ],
        {
            "order": draw_curves(
                curves,
                title=f"{options.orders} orders of the views",
                data=shapes.about,
                across="views",
                up="voxel IoU [%]",
                bars="deviation over the orders",
            )
        },
    )


def _orders(seed: int, name: str, views: int, orders: int) -> Tensor:
    """Random orders (orders, views) of the first views of a shape; the first is 0, 1, 2, ..."""
    drawn = generator_of(seed, f"{name}, {views} views", ORDER).random((orders, views)).argsort(1, kind="stable")
    found = torch.from_numpy(drawn)
    found[0] = torch.arange(views)
    return found


def _reordered(images: Tensor, cameras: CameraTensors, order: Tensor) -> tuple[Tensor, CameraTensors]:
    """Views (B, K) out of (B, V)."""
    rows = torch.arange(len(order))[:, None]
    return images[rows, order], cameras.at((rows, order))


def _spread(predicted: Tensor, iou: Tensor, threshold: float) -> Tensor:
    """The measures (B, 5) of predictions (B, orders, D, H, W) with their IoU (B, orders)."""
    solid = predicted > threshold
    ever, always = solid.any(1).flatten(1), solid.all(1).flatten(1)
    number = ever.sum(1).clamp_min(1)
    deviation = torch.where(ever, predicted.double().std(1).flatten(1), 0.0).sum(1) / number
    changing = (ever & ~always).sum(1) / number
    return torch.stack((iou.mean(1), iou.std(1), iou.amax(1) - iou.amin(1), deviation, changing), 1)
