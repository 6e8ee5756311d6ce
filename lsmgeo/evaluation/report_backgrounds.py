"""The last line of table 1: voxel IoU on white and on random backgrounds."""

from __future__ import annotations

from collections.abc import Sequence

from lsmgeo.evaluation.held_out_shapes import Shapes
from lsmgeo.evaluation.methods import Method, Options
from lsmgeo.evaluation.paper import IOU, paper_row
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Report, Row, Scores, Table, joined
from lsmgeo.evaluation.report_iou import measure_iou

__all__ = ["report_backgrounds"]

PAPER = ("V-LSM", "V-LSM w/bg")


def report_backgrounds(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure IoU of every model on a white background and on `options.background`.

    The paper trains and tests "V-LSM w/bg" on random images as backgrounds; a model that was trained on white only
    shows the gain.

    Options: background, threshold, batch.

    Returns:
        Table "views" with two rows per model.
    """
    backgrounds = {"white": "white", "random": options.background}
    measured = {
        words: measure_iou(methods, shapes, views, options, hulls=False, background=background)
        for words, background in backgrounds.items()
    }
    scores: dict[str, Scores] = {
        f"{method.name}, {words} behind": measured[words][method.name] for method in methods for words in backgrounds
    }
    rows = [Row(name, one.cells(100)) for name, one in scores.items()]
    rows += [paper_row(name, IOU[name], views) for name in PAPER]
    places = range(1, views + 1)
    curves = [Curve(name, places, one.cells(100)) for name, one in scores.items()]
    return Report(
        "backgrounds",
        [Table("views", "voxel IoU [%], views:", [str(place) for place in places], rows)],
        {"views": views, "background": str(options.background)},
        joined(scores, "iou"),
        {
            "backgrounds": draw_curves(
                curves, title="White and other backgrounds", data=shapes.about, across="views", up="voxel IoU [%]"
            )
        },
    )
