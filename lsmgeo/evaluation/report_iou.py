"""Tables 1, 3 and 4: voxel IoU by the number of views and by category, beside the visual hull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lsmgeo.data.shards.background_sources import Background
from lsmgeo.evaluation.baselines import HULL, STRICT_HULL, hull_iou
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.paper import IOU, IOU_OF_CATEGORIES, paper_categories, paper_row
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Cell, Report, Row, Scores, Table, iou_by_view, joined

__all__ = ["measure_iou", "report_iou", "table_of_views"]

HULL_FALLS = "The 0.75 hull drops from 4 to 5 views because it needs all of 4 silhouettes, but only 4 of 5."


def report_iou(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure IoU after 1, 2, ... views: the mean over categories, and every category.

    Options: threshold, batch.

    Returns:
        Table "views", a table of the categories per model, and a figure of the curves.
    """
    scores = measure_iou(methods, shapes, views, options, hulls=True)
    table = table_of_views("voxel IoU [%], views:", scores, views, _known(methods))
    categories = sorted(set(shapes.categories))
    classes = [_table_of_categories(one, scores[one.name], categories) for one in methods]
    places = range(1, views + 1)
    curves = [Curve(name, places, one.cells(100)) for name, one in scores.items()]
    curves += [
        Curve(name, places[: len(IOU[paper])], [Cell(number) for number in IOU[paper][:views]], True)
        for name, paper in _known(methods).items()
    ]
    figure = draw_curves(
        curves, title="Voxel IoU by number of views", data=shapes.about, across="views", up="mean IoU of categories [%]"
    )
    facts = {"views": views, "threshold": options.threshold}
    return Report("iou", [table, *classes], facts, joined(scores, "iou"), {"iou": figure})


def measure_iou(
    methods: Sequence[Method],
    shapes: Shapes,
    views: int,
    options: Options,
    *,
    hulls: bool,
    background: Background = "white",
) -> dict[str, Scores]:
    """IoU of every shape after every view, by method and, with ``hulls``, by visual hull."""
    rules = {HULL: "mean", STRICT_HULL: "all"} if hulls else {}
    scores = {name: Scores() for name in (*(method.name for method in methods), *rules)}
    resolution = shared(methods, "resolution")
    for batch in batches(
        shapes, views, options.batch, resolution=resolution, background=background, progress=options.progress
    ):
        assert batch.occupancy is not None
        assert batch.mask is not None
        for method in methods:
            found = iou_by_view(method.occupancies(batch.images, batch.cameras), batch.occupancy, options.threshold)
            scores[method.name].add(batch.name, batch.category, found)
        for name, rule in rules.items():
            found = hull_iou(batch.mask, batch.cameras, batch.occupancy, rule=rule)
            scores[name].add(batch.name, batch.category, found)
    return scores


def table_of_views(title: str, scores: Mapping[str, Scores], views: int, papers: Mapping[str, str]) -> Table:
    """A row for every method and, below, for its numbers in the paper; ``papers`` are the names of methods there."""
    rows = [Row(name, one.cells(100)) for name, one in scores.items()]
    rows += [paper_row(paper, IOU[paper], views) for paper in dict.fromkeys(papers.values())]
    hull = [cell.value for cell in scores[HULL].cells()] if HULL in scores else []
    footnote = HULL_FALLS if len(hull) > 4 and hull[4] < hull[3] else ""
    return Table("views", title, [str(view) for view in range(1, views + 1)], rows, footnote=footnote)


def _known(methods: Sequence[Method]) -> dict[str, str]:
    """The name in the paper of every method in its table 1."""
    titles = {method.name: method.title for method in methods}
    return {name: title for name, title in titles.items() if title in IOU} | {HULL: HULL}


def _table_of_categories(method: Method, scores: Scores, categories: Sequence[str]) -> Table:
    views = len(scores.values[0]) if scores.values else 0
    rows = [Row(f"views: {view}", scores.category_cells(view - 1, categories, 100)) for view in range(1, views + 1)]
    rows += [
        paper_categories(f"views: {view}", numbers, categories)
        for view, numbers in enumerate(IOU_OF_CATEGORIES.get(method.title, ())[:views], 1)
    ]
    name = method.name
    return Table(f"categories of {name}", f"{name}, voxel IoU [%]", [*categories, "mean"], rows)
