"""Table 5: the median error of depth maps of D-LSM and of plane-sweep stereo."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo.data import Batch
from lsmgeo.drawing import Pixels, as_pixels, draw_depth
from lsmgeo.evaluation.baselines import SURE, SWEEP, DepthMaps, sweep_views
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.paper import DEPTH, paper_categories
from lsmgeo.evaluation.plots import sheet
from lsmgeo.evaluation.report import Report, Row, Scores, Table, joined
from lsmgeo.metrics import depth_errors, median_depth_error

__all__ = ["report_depth"]

# Side of an image in pixels, and the largest number of shapes that are drawn.
SIDE, MOST_DRAWN = 160, 13


def report_depth(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure depth maps of 10 views, as the paper does (section 4, "Comparision to Plane Sweeping").

    Plane sweep uses the same images: 300 planes over 2 -+ sqrt(3) / 2, 5 x 5 ZNCC, every view with all others. A pixel
    counts if it is on the object, its true depth is in that range, and plane sweep has a depth. The median absolute
    error of each depth map is averaged over the views of a shape, the shapes of a category, and the categories.

    Options: planes, window, batch.

    Returns:
        Table "categories" in world units. Table "measures": also mean errors, the median over the pixels where plane
        sweep is sure (a confidence of at least 0.05), and errors over all pixels of the object.
    """
    size = shared(methods, "size")
    scores = {name: Scores() for name in (SWEEP, *(method.name for method in methods))}
    rows_drawn: dict[str, list[Pixels | None]] = {}
    for batch in batches(shapes.at(size), views, options.batch, resolution=None, depth=True, progress=options.progress):
        assert batch.depth is not None
        assert batch.mask is not None
        sweeps = [
            sweep_views(images, batch.cameras.at(place), planes=options.planes, window=options.window)
            for place, images in enumerate(batch.images)
        ]
        swept = DepthMaps(*(torch.stack(maps) for maps in zip(*sweeps, strict=True)))
        found = {SWEEP: swept.depth} | {one.name: one.depths(batch.images, batch.cameras) for one in methods}
        for name, depth in found.items():
            measures = _measures(depth, batch.depth, batch.mask, swept)
            # Means over the views that have a pixel to measure.
            means = torch.stack([measure.double().nanmean(1) for measure in measures.values()], 1)
            scores[name].add(batch.name, batch.category, means)
        for place, shape in enumerate(batch.name[: MOST_DRAWN - len(rows_drawn)]):
            rows_drawn[shape] = _draw(batch, place, list(found.values()))
    categories = sorted(set(shapes.categories))
    rows = [Row(name, one.category_cells(0, categories)) for name, one in scores.items()]
    known = [name for name in DEPTH if name == SWEEP or name in {one.title for one in methods}]
    rows += [paper_categories(name, DEPTH[name], categories) for name in known]
    columns = list(measures)
    factors = [100 if column.endswith("[%]") else 1 for column in columns]
    all_rows = [
        Row(name, [one.cells(factor)[place] for place, factor in enumerate(factors)]) for name, one in scores.items()
    ]
    return Report(
        "depth",
        [
            Table("categories", "median depth error", [*categories, "mean"], rows, 3),
            Table("measures", "depth errors [world units]", columns, all_rows, 4),
        ],
        {"views": views, "planes": options.planes, "window": options.window, "size": size},
        joined(scores, ", ".join(columns).replace(" [%]", "")),
        {
            "depth": sheet(
                list(rows_drawn.values()),
                list(rows_drawn),
                ["first view", "truth", *scores],
                title=f"depth of the first view, seen from the side; {shapes.about}",
            )
        },
    )


def _measures(predicted: Tensor, depth: Tensor, mask: Tensor, swept: DepthMaps) -> dict[str, Tensor]:
    """The measures of depth maps (B, V, H, W), each (B, V), by the names of their columns: add a measure here."""
    on_object = mask & (depth > 0)
    has_sweep, sure = on_object & (swept.depth > 0), on_object & (swept.confidence >= SURE)
    errors = depth_errors(predicted, depth, on_object)
    return {
        "median": median_depth_error(predicted, depth, has_sweep).error,
        "mean": depth_errors(predicted, depth, has_sweep).l1,
        "median, sure": median_depth_error(predicted, depth, sure).error,
        "median, all": median_depth_error(predicted, depth, on_object).error,
        "mean, all": errors.l1,
        "has depth [%]": errors.density,
        "is sure [%]": sure.sum((-2, -1)) / on_object.sum((-2, -1)),
    }


def _draw(batch: Batch, place: int, depths: Sequence[Tensor]) -> list[Pixels | None]:
    """The first view of a shape, its true depth and the depths (B, V, H, W) of methods, as shaded surfaces."""
    assert batch.depth is not None
    assert batch.mask is not None
    camera, on_object = batch.cameras.at((place, 0)), batch.mask[place, 0]
    surfaces = [torch.where(on_object, depth[place, 0].float(), 0.0) for depth in (batch.depth, *depths)]
    return [as_pixels(batch.images[place, 0], SIDE), *(draw_depth(one, camera, size=SIDE) for one in surfaces)]
