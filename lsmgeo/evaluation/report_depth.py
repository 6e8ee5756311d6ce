"""Table 5: depth maps of D-LSM and of plane-sweep stereo, by the paper's median error."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo.cameras import select
from lsmgeo.data import Batch
from lsmgeo.drawing import Picture, as_pixels, draw_depth
from lsmgeo.evaluation.baselines import SURE, SWEEP, Swept, sweep_views
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Contender, shared
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.paper import DEPTH, paper_categories
from lsmgeo.evaluation.plots import sheet
from lsmgeo.evaluation.report import Report, Row, Table
from lsmgeo.evaluation.scores import Scores, joined
from lsmgeo.metrics import depth_errors, median_depth_error

__all__ = ["report_depth"]

# Of a picture: side in pixels, and the shapes that are drawn.
SIDE, MOST_DRAWN = 160, 13
MEASURES = ("median", "mean", "median, sure", "median, all", "mean, all", "has depth [%]", "is sure [%]")


def report_depth(contenders: Sequence[Contender], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure depth maps of 10 views, as the paper does (section 4, "Comparision to Plane Sweeping").

    Plane sweep takes the same pictures: 300 planes over 2 -+ sqrt(3) / 2, 5 x 5 ZNCC, every view with all others. A
    pixel counts where the object is, its true depth is in that range, and plane sweep has a depth. The median absolute
    error of each depth map is averaged over the views of a shape, the shapes of a category, and the categories.

    Args:
        contenders: depth models of one size of images.
        shapes: what is evaluated on, with depth.
        views: 10 in the paper.
        options: planes, window, batch.

    Returns:
        Table "categories" in world units; "measures" with mean errors besides, the median over the pixels where plane
        sweep is sure (a confidence of 0.05 and more, with which it would be used), and errors over all of the object's
        pixels.

    Raises:
        OptionError: models of different sizes.
    """
    size = shared(contenders, "size")
    scores = {name: Scores() for name in (SWEEP, *(contender.name for contender in contenders))}
    rows_drawn: dict[str, list[Picture | None]] = {}
    for batch in batches(shapes.at(size), views, options.batch, resolution=None, depth=True, progress=options.progress):
        assert batch.depth is not None
        assert batch.mask is not None
        sweeps = [
            sweep_views(images, select(batch.cameras, 0, place), planes=options.planes, window=options.window)
            for place, images in enumerate(batch.images)
        ]
        swept = Swept(*(torch.stack(maps) for maps in zip(*sweeps, strict=True)))
        found = {SWEEP: swept.depth} | {one.name: one.depths(batch.images, batch.cameras) for one in contenders}
        for name, depth in found.items():
            scores[name].add(batch.name, batch.category, _errors(depth, batch.depth, batch.mask, swept))
        for place, shape in enumerate(batch.name[: MOST_DRAWN - len(rows_drawn)]):
            rows_drawn[shape] = _draw(batch, place, list(found.values()))
    categories = sorted(set(shapes.categories))
    rows = [Row(name, one.category_cells(0, categories)) for name, one in scores.items()]
    known = [name for name in DEPTH if name == SWEEP or name in {one.title for one in contenders}]
    rows += [paper_categories(name, DEPTH[name], categories) for name in known]
    measures = [Row(name, [*one.cells()[:5], *one.cells(100)[5:]]) for name, one in scores.items()]
    return Report(
        "depth",
        [
            Table("categories", "median depth error", [*categories, "mean"], rows, 3),
            Table("measures", "depth errors [world units]", MEASURES, measures, 4),
        ],
        {"views": views, "planes": options.planes, "window": options.window, "size": size},
        joined(scores, ", ".join(MEASURES).replace(" [%]", "")),
        {
            "depth": sheet(
                list(rows_drawn.values()),
                list(rows_drawn),
                ["first view", "truth", *scores],
                title=f"depth of the first view, seen from the side; {shapes.about}",
            )
        },
    )


def _errors(predicted: Tensor, depth: Tensor, mask: Tensor, swept: Swept) -> Tensor:
    """The measures (B, 7) of depth maps (B, V, H, W): means over the views that have a pixel that counts."""
    on = mask & (depth > 0)
    has_sweep, sure = on & (swept.depth > 0), on & (swept.confidence >= SURE)
    pixels = on.sum((-2, -1))
    columns = [
        median_depth_error(predicted, depth, has_sweep).error,
        depth_errors(predicted, depth, has_sweep).l1,
        median_depth_error(predicted, depth, sure).error,
        median_depth_error(predicted, depth, on).error,
        depth_errors(predicted, depth, on).l1,
        depth_errors(predicted, depth, on).density,
        sure.sum((-2, -1)) / pixels,
    ]
    return torch.stack([column.double().nanmean(1) for column in columns], 1)


def _draw(batch: Batch, place: int, depths: Sequence[Tensor]) -> list[Picture | None]:
    """The first view of a shape, its true depth, and what methods (B, V, H, W) say, as shaded surfaces."""
    assert batch.depth is not None
    assert batch.mask is not None
    camera, on = select(select(batch.cameras, 0, place), 0, 0), batch.mask[place, 0]
    surfaces = [torch.where(on, depth[place, 0].float(), 0.0) for depth in (batch.depth, *depths)]
    return [as_pixels(batch.images[place, 0], SIDE), *(draw_depth(one, camera, size=SIDE) for one in surfaces)]
