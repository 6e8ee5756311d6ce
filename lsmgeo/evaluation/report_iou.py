"""Tables 1, 3 and 4: voxel IoU by the number of views and by category, beside the visual hull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lsmgeo.data.shards.background_sources import Background
from lsmgeo.evaluation.baselines import HULL, STRICT_HULL, hull_iou
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Contender, shared
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.paper import IOU, IOU_OF_CATEGORIES, paper_categories, paper_row
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Cell, Report, Row, Table
from lsmgeo.evaluation.scores import Scores, iou_by_view, joined

__all__ = ["measure_iou", "report_iou", "table_of_views"]

HULL_FALLS = "The 0.75 hull drops from 4 to 5 views because it needs all of 4 silhouettes, but only 4 of 5."


def report_iou(contenders: Sequence[Contender], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure IoU after 1, 2, ... views: the mean of the categories, and every category.

    Args:
        contenders: voxel models of one resolution.
        shapes: what is evaluated on.
        views: 8 in the paper.
        options: threshold, batch.

    Returns:
        Table "views", and one a model of the categories; a picture of the curves.

    Raises:
        OptionError: models of different resolutions.
    """
    scores = measure_iou(contenders, shapes, views, options, hulls=True)
    table = table_of_views("voxel IoU [%], views:", scores, views, _known(contenders))
    categories = sorted(set(shapes.categories))
    classes = [_table_of_categories(one, scores[one.name], categories) for one in contenders]
    places = range(1, views + 1)
    curves = [Curve(name, places, one.cells(100)) for name, one in scores.items()]
    curves += [
        Curve(name, places[: len(IOU[paper])], [Cell(number) for number in IOU[paper][:views]], True)
        for name, paper in _known(contenders).items()
    ]
    picture = draw_curves(
        curves, title="Voxel IoU by number of views", data=shapes.about, across="views", up="mean IoU of categories [%]"
    )
    return Report(
        "iou",
        [table, *classes],
        {"views": views, "threshold": options.threshold},
        joined(scores, "iou"),
        {"iou": picture},
    )


def measure_iou(
    contenders: Sequence[Contender],
    shapes: Shapes,
    views: int,
    options: Options,
    *,
    hulls: bool,
    background: Background = "white",
) -> dict[str, Scores]:
    """IoU of every shape after every view, by method.

    Args:
        contenders: voxel models of one resolution.
        shapes: what is evaluated on.
        views: how many.
        options: threshold, batch.
        hulls: whether visual hulls are measured too.
        background: what stands behind the objects.
    """
    rules = {HULL: "mean", STRICT_HULL: "all"} if hulls else {}
    scores = {name: Scores() for name in (*(contender.name for contender in contenders), *rules)}
    resolution = shared(contenders, "resolution")
    for batch in batches(
        shapes, views, options.batch, resolution=resolution, background=background, progress=options.progress
    ):
        assert batch.occupancy is not None
        assert batch.mask is not None
        for contender in contenders:
            found = iou_by_view(contender.occupancies(batch.images, batch.cameras), batch.occupancy, options.threshold)
            scores[contender.name].add(batch.name, batch.category, found)
        for name, rule in rules.items():
            found = hull_iou(batch.mask, batch.cameras, batch.occupancy, rule=rule)
            scores[name].add(batch.name, batch.category, found)
    return scores


def table_of_views(title: str, scores: Mapping[str, Scores], views: int, papers: Mapping[str, str]) -> Table:
    """A line for every method and, below, for what the paper says of it.

    Args:
        title: what it shows.
        scores: of every method after 1, 2, ... views.
        views: the columns.
        papers: the paper's name of some methods.
    """
    rows = [Row(name, one.cells(100)) for name, one in scores.items()]
    rows += [paper_row(paper, IOU[paper], views) for paper in dict.fromkeys(papers.values())]
    hull = [cell.value for cell in scores[HULL].cells()] if HULL in scores else []
    footnote = HULL_FALLS if len(hull) > 4 and hull[4] < hull[3] else ""
    return Table("views", title, [str(view) for view in range(1, views + 1)], rows, footnote=footnote)


def _known(contenders: Sequence[Contender]) -> dict[str, str]:
    """The paper's name of every method that its table 1 has."""
    titles = {contender.name: contender.title for contender in contenders}
    return {name: title for name, title in titles.items() if title in IOU} | {HULL: HULL}


def _table_of_categories(contender: Contender, scores: Scores, categories: Sequence[str]) -> Table:
    views = len(scores.values[0]) if scores.values else 0
    rows = [Row(f"views: {view}", scores.category_cells(view - 1, categories, 100)) for view in range(1, views + 1)]
    rows += [
        paper_categories(f"views: {view}", numbers, categories)
        for view, numbers in enumerate(IOU_OF_CATEGORIES.get(contender.title, ())[:views], 1)
    ]
    name = contender.name
    return Table(f"categories of {name}", f"{name}, voxel IoU [%]", [*categories, "mean"], rows)
