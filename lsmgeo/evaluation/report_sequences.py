"""The qualitative figure: views in order, what is predicted after each of them, and the truth."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from lsmgeo.drawing import Picture, as_pixels, draw_voxels
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Contender, shared
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.plots import sheet
from lsmgeo.evaluation.report import Report, Row, Table
from lsmgeo.evaluation.scores import Scores, iou_by_view, joined

__all__ = ["report_sequences"]

SIDE = 256
# More shapes than this are measured, not drawn.
MOST_DRAWN = 26


def report_sequences(contenders: Sequence[Contender], shapes: Shapes, views: int, options: Options) -> Report:
    """Draw what models predict after each of a sequence of views (Kar et al. 2017, figure 3), with the IoU of each.

    Args:
        contenders: voxel models of one resolution: in the paper V-LSM and 3D-R2N2 w/pose.
        shapes: of which the first 26 are drawn.
        views: 4 in the paper.
        options: threshold, batch.

    Returns:
        A picture a shape and a table of their IoU.

    Raises:
        OptionError: models of different resolutions.
    """
    scores = {contender.name: Scores() for contender in contenders}
    pictures: dict[str, bytes] = {}
    resolution = shared(contenders, "resolution")
    for batch in batches(shapes, views, options.batch, resolution=resolution, progress=options.progress):
        assert batch.occupancy is not None
        found = {contender.name: contender.occupancies(batch.images, batch.cameras) for contender in contenders}
        for name, predicted in found.items():
            iou = iou_by_view(predicted, batch.occupancy, options.threshold)
            scores[name].add(batch.name, batch.category, iou)
        for place, shape in enumerate(batch.name):
            if len(pictures) < MOST_DRAWN:
                solids = {name: predicted[place] > options.threshold for name, predicted in found.items()}
                pictures[f"sequences-{shape.replace('/', '_')}"] = _draw(
                    batch.images[place], solids, batch.occupancy[place], shape
                )
    names = next(iter(scores.values())).names
    columns = [str(view) for view in range(1, views + 1)]
    tables = [
        Table(name, f"{name}, voxel IoU [%], views:", columns, [Row("mean of categories", one.cells(100))])
        for name, one in scores.items()
    ]
    notes = [f"{len(pictures)} of {len(names)} shapes are drawn"] if len(names) > len(pictures) else []
    facts = {"views": views, "threshold": options.threshold}
    return Report("sequences", tables, facts, joined(scores, "iou"), pictures, notes=notes)


def _draw(images: Tensor, solids: dict[str, Tensor], truth: Tensor, shape: str) -> bytes:
    views = len(images)
    true = draw_voxels(truth, size=SIDE)
    rows: list[list[Picture | None]] = [[*(as_pixels(image, SIDE) for image in images), true]]
    rows += [[draw_voxels(solid, size=SIDE) for solid in by_view] + [None] for by_view in solids.values()]
    columns = [f"view {view}" for view in range(1, views + 1)]
    return sheet(rows, ["views", *solids], [*columns, "truth"], title=f"{shape}: after each view")
