"""The figure of generalisation: by how much IoU drops on categories that were not trained on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from lsmgeo.errors import OptionError
from lsmgeo.evaluation.held_out_shapes import Shapes
from lsmgeo.evaluation.methods import Contender
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Report, Row, Table
from lsmgeo.evaluation.report_iou import measure_iou
from lsmgeo.evaluation.scores import Scores, joined

__all__ = ["report_unseen"]


def report_unseen(contenders: Sequence[Contender], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure the drop of IoU on unseen categories by the number of views.

    Equation: for a category C that a model has not been trained on, the IoU of the same network trained on all
    categories less that model's, on the same shapes and views; the mean over all such categories (Kar et al. 2017,
    section 4, "Generalization"). How a model was trained is read from its file.

    Args:
        contenders: of every network one model trained on all categories and one at least trained on some: the paper
            has V-LSM and 3D-R2N2 w/pose, each trained on all, on the first and on the second part of the categories.
        shapes: what is evaluated on, of all categories.
        views: 8 in the paper.
        options: threshold, batch.

    Returns:
        Tables "drop" and "categories" (with all views), a picture of the curves.

    Raises:
        OptionError: a model has no counterpart, or models of different resolutions.
    """
    pairs = _pairs(contenders, set(shapes.categories))
    scores = measure_iou(contenders, shapes, views, options, hulls=False)
    drops = {title: _drop(scores, some, seen_by) for title, (seen_by, some) in pairs.items()}
    columns = [str(view) for view in range(1, views + 1)]
    rows = [Row(title, one.cells(100)) for title, one in drops.items()]
    parts = [
        Row(some.name, _drop(scores, [some], seen_by).cells(100))
        for seen_by, restricted in pairs.values()
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


def _pairs(contenders: Sequence[Contender], categories: set[str]) -> dict[str, tuple[Contender, list[Contender]]]:
    """Of every network the model that has seen all categories, and those that have not."""
    found = {}
    for title in dict.fromkeys(contender.title for contender in contenders):
        same = [contender for contender in contenders if contender.title == title]
        complete = [one for one in same if one.training.seen is None or one.training.seen >= categories]
        partial = [one for one in same if one not in complete]
        if len(complete) != 1 or not partial:
            told = ", ".join(f"{one.name} ({one.training.words or 'on all'})" for one in same)
            raise OptionError(
                f"evaluate: report 'unseen' needs of every network one model trained on all categories and others "
                f"trained on some (data.categories = 'first', 'second'); of {title} there are: {told}"
            )
        found[title] = (complete[0], partial)
    return found


def _drop(scores: Mapping[str, Scores], partial: Sequence[Contender], complete: Contender) -> Scores:
    """What models lose on every shape of a category that they have not seen; NaN where all have."""
    reference, lost = scores[complete.name], Scores()
    lost.names, lost.categories = list(reference.names), list(reference.categories)
    for place, category in enumerate(reference.categories):
        blind = [scores[one.name].values[place] for one in partial if category not in (one.training.seen or ())]
        lost.values.append(
            [
                full - math.fsum(values) / len(values) if (values := [numbers[step] for numbers in blind]) else math.nan
                for step, full in enumerate(reference.values[place])
            ]
        )
    return lost
