"""The figure of generalisation: the drop of IoU on categories that were not trained on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from lsmgeo.errors import OptionError
from lsmgeo.evaluation.held_out_shapes import Shapes
from lsmgeo.evaluation.methods import Method, Options
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Report, Row, Scores, Table, joined
from lsmgeo.evaluation.report_iou import measure_iou

__all__ = ["report_unseen"]


def report_unseen(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure the drop of IoU on unseen categories by the number of views.

    Equation: for a category C that a model has not been trained on, the IoU of the same network trained on all
    categories minus that of the model, on the same shapes and views; the mean over all such categories (Kar et al.
    2017, section 4, "Generalization"). How a model was trained is read from its file.

    Of every network it needs one model trained on all categories and at least one trained on some: in the paper V-LSM
    and 3D-R2N2 w/pose, each trained on all, on the first and on the second part of the categories. Options: threshold,
    batch.

    Returns:
        Tables "drop" and "categories" (with all views), and a figure of the curves.

    Raises:
        OptionError: a model has no counterpart.
    """
    pairs = _pairs(methods, set(shapes.categories))
    scores = measure_iou(methods, shapes, views, options, hulls=False)
    drops = {title: _drop(scores, some, complete) for title, (complete, some) in pairs.items()}
    columns = [str(view) for view in range(1, views + 1)]
    rows = [Row(title, one.cells(100)) for title, one in drops.items()]
    parts = [
        Row(some.name, _drop(scores, [some], complete).cells(100))
        for complete, restricted in pairs.values()
        for some in restricted
    ]
    categories = sorted(set(shapes.categories))
    of_categories = [Row(title, one.category_cells(views - 1, categories, 100)) for title, one in drops.items()]
    curves = [Curve(title, range(1, views + 1), one.cells(100)) for title, one in drops.items()]
    return Report(
        "unseen",
        [
            Table("drop", "drop of IoU [points], views:", columns, [*rows, *parts]),
            Table("categories", f"drop with {views} views [points]", [*categories, "mean"], of_categories),
            Table(
                "views",
                "voxel IoU of all categories [%], views:",
                columns,
                [Row(name, one.cells(100)) for name, one in scores.items()],
            ),
        ],
        {"views": views, "threshold": options.threshold},
        joined(scores, "iou"),
        {
            "unseen": draw_curves(
                curves,
                title="IoU lost on unseen categories",
                data=shapes.about,
                across="views",
                up="drop of IoU [points]",
            )
        },
    )


def _pairs(methods: Sequence[Method], categories: set[str]) -> dict[str, tuple[Method, list[Method]]]:
    """For every network, the model trained on all categories, and the others."""
    found = {}
    for title in dict.fromkeys(method.title for method in methods):
        same = [method for method in methods if method.title == title]
        complete = [one for one in same if one.training.seen is None or one.training.seen >= categories]
        partial = [one for one in same if one not in complete]
        if len(complete) != 1 or not partial:
            found_ones = ", ".join(f"{one.name} ({one.training.words or 'on all'})" for one in same)
            raise OptionError(
                f"evaluate: report 'unseen' needs, for every network, one model trained on all categories and others "
                f"trained on some (data.categories = 'first', 'second'); of {title} there are: {found_ones}"
            )
        found[title] = (complete[0], partial)
    return found


def _drop(scores: Mapping[str, Scores], partial: Sequence[Method], complete: Method) -> Scores:
    """The drop of IoU on every shape of a category that models were not trained on; NaN if all were."""
    reference, lost = scores[complete.name], Scores()
    lost.names, lost.categories = list(reference.names), list(reference.categories)
    for place, category in enumerate(reference.categories):
        untrained = [scores[one.name].values[place] for one in partial if category not in (one.training.seen or ())]
        pairs = [(full, [numbers[view] for numbers in untrained]) for view, full in enumerate(reference.values[place])]
        lost.values.append([full - math.fsum(some) / len(some) if some else math.nan for full, some in pairs])
    return lost
