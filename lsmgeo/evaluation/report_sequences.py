"""The qualitative figure: views in order, the prediction after each of them, and the truth."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from lsmgeo.drawing import Pixels, as_pixels, draw_voxels
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.plots import sheet
from lsmgeo.evaluation.report import Report, Row, Scores, Table, iou_by_view, joined

__all__ = ["report_sequences"]

SIDE = 256
# The shapes after these are measured, but not drawn.
MOST_DRAWN = 26


def report_sequences(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Draw the predictions after each of a sequence of views (Kar et al. 2017, figure 3), and measure their IoU.

    The first 26 shapes are drawn. Options: threshold, batch.

    Returns:
        A figure per shape and a table of IoU per model.
    """
    scores = {method.name: Scores() for method in methods}
    figures: dict[str, bytes] = {}
    resolution = shared(methods, "resolution")
    for batch in batches(shapes, views, options.batch, resolution=resolution, progress=options.progress):
        assert batch.occupancy is not None
        found = {method.name: method.occupancies(batch.images, batch.cameras) for method in methods}
        for name, predicted in found.items():
            iou = iou_by_view(predicted, batch.occupancy, options.threshold)
            scores[name].add(batch.name, batch.category, iou)
        for place, shape in enumerate(batch.name):
            if len(figures) < MOST_DRAWN:
                occupied = {name: predicted[place] > options.threshold for name, predicted in found.items()}
                figures[f"sequences-{shape.replace('/', '_')}"] = _draw(
                    batch.images[place], occupied, batch.occupancy[place], shape
                )
    names = next(iter(scores.values())).names
    columns = [str(view) for view in range(1, views + 1)]
    tables = [
        Table(name, f"{name}, voxel IoU [%], views:", columns, [Row("mean of categories", one.cells(100))])
        for name, one in scores.items()
    ]
    notes = [f"{len(figures)} of {len(names)} shapes are drawn"] if len(names) > len(figures) else []
    facts = {"views": views, "threshold": options.threshold}
    return Report("sequences", tables, facts, joined(scores, "iou"), figures, notes=notes)


def _draw(images: Tensor, occupied: dict[str, Tensor], truth: Tensor, shape: str) -> bytes:
    views = len(images)
    true = draw_voxels(truth, size=SIDE)
    rows: list[list[Pixels | None]] = [[*(as_pixels(image, SIDE) for image in images), true]]
    rows += [[draw_voxels(voxels, size=SIDE) for voxels in by_view] + [None] for by_view in occupied.values()]
    columns = [f"view {view}" for view in range(1, views + 1)]
    return sheet(rows, ["views", *occupied], [*columns, "truth"], title=f"{shape}: after each view")
