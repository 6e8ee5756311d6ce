"""Table 5: depth maps of D-LSM and of plane-sweep stereo, by the paper's median error."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo.cameras import select
from lsmgeo.errors import OptionError
from lsmgeo.metrics import depth_errors, median_depth_error
from lsmgeo.models.evaluation.contenders import Contender, pick
from lsmgeo.models.evaluation.facts import facts_of
from lsmgeo.models.evaluation.options import Options
from lsmgeo.models.evaluation.paper import DEPTH, paper_categories
from lsmgeo.models.evaluation.plane_sweeps import SWEEP, sweep_views
from lsmgeo.models.evaluation.report import Report, Row, Table
from lsmgeo.models.evaluation.scores import Scores, joined
from lsmgeo.models.evaluation.shapes import Shapes, SizedShapes, batches

__all__ = ["report_depth"]

VIEWS = 10
MEASURES = (
    "median error", "mean error", "median error, all pixels", "mean error, all pixels", "share of pixels with depth"
)  # fmt: skip


def report_depth(contenders: Sequence[Contender], shapes: Shapes, options: Options) -> Report:
    """Measure depth maps of 10 views, as the paper does (section 4, "Comparision to Plane Sweeping").

    Plane sweep takes the same pictures: 300 planes over 2 -+ sqrt(3) / 2, 5 x 5 ZNCC, every view with all others. A
    pixel counts where the object is, its true depth is in that range, and plane sweep has a depth. The median absolute
    error of each depth map is averaged over the views of a shape, the shapes of a category, and the categories.

    Args:
        contenders: depth models of one size of images.
        shapes: what is evaluated on, with depth.
        options: views (10), planes, window, batch.

    Returns:
        Table "categories" in world units; "measures" with mean errors besides, and errors over all of the object's
        pixels, which plane sweep leaves out.

    Raises:
        OptionError: a model that gives no depth, models of different sizes, or one view alone.
    """
    notes: list[str] = []
    contenders = pick(contenders, "depth", depth=True)
    size = one_size(contenders)
    views = options.views_of(VIEWS, shapes.most_views, notes)
    if views < 2:
        raise OptionError("evaluate: report 'depth' needs two views at least, which plane sweep matches")
    scores = {name: Scores() for name in (SWEEP, *(contender.name for contender in contenders))}
    sized = SizedShapes(shapes, size)
    for batch in batches(sized, views, options.batch, resolution=None, depth=True, progress=options.progress):
        assert batch.depth is not None
        assert batch.mask is not None
        swept = torch.stack(
            [
                sweep_views(images, select(batch.cameras, 0, place), planes=options.planes, window=options.window)
                for place, images in enumerate(batch.images)
            ]
        )
        found = {SWEEP: swept} | {one.name: one.depths(batch.images, batch.cameras) for one in contenders}
        for name, depth in found.items():
            scores[name].add(batch.name, batch.category, _errors(depth, batch.depth, batch.mask, swept > 0))
    categories = sorted(set(shapes.categories))
    rows = [Row(name, one.category_cells(0, categories)) for name, one in scores.items()]
    known = [name for name in DEPTH if name == SWEEP or name in {one.title for one in contenders}]
    rows += [paper_categories(name, DEPTH[name], categories) for name in known]
    measures = [Row(name, one.cells()) for name, one in scores.items()]
    return Report(
        "depth",
        [
            Table("categories", "median depth error", [*categories, "mean"], rows, 3),
            Table("measures", "errors [world units]", MEASURES, measures, 4),
        ],
        facts_of(contenders, shapes, options, views=views, planes=options.planes, window=options.window, size=size),
        joined(scores, "median error, mean error, both of all pixels, share with depth"),
        notes=notes,
    )


def one_size(contenders: Sequence[Contender]) -> int:
    """Height and width of the pictures that all take.

    Raises:
        OptionError: they differ.
    """
    found = {contender.name: contender.size for contender in contenders}
    if len(set(found.values())) != 1:
        raise OptionError(f"evaluate: depth models must take pictures of one size; got {found}")
    return next(iter(found.values()))


def _errors(predicted: Tensor, depth: Tensor, mask: Tensor, has_sweep: Tensor) -> Tensor:
    """The measures (B, 5) of depth maps (B, V, H, W): means over the views that have a pixel that counts."""
    on = mask & (depth > 0)
    columns = [
        median_depth_error(predicted, depth, on & has_sweep).error,
        depth_errors(predicted, depth, on & has_sweep).l1,
        median_depth_error(predicted, depth, on).error,
        depth_errors(predicted, depth, on).l1,
        depth_errors(predicted, depth, on).density,
    ]
    return torch.stack([column.nanmean(1) for column in columns], 1)
