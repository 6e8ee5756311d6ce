"""Reports by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from lsmgeo._checks import check_choice
from lsmgeo.models.evaluation.backgrounds import report_backgrounds
from lsmgeo.models.evaluation.clouds import report_clouds
from lsmgeo.models.evaluation.contenders import Contender
from lsmgeo.models.evaluation.depth import report_depth
from lsmgeo.models.evaluation.iou import report_iou
from lsmgeo.models.evaluation.options import Options
from lsmgeo.models.evaluation.order import report_order
from lsmgeo.models.evaluation.pose_noise import report_pose_noise
from lsmgeo.models.evaluation.report import Report
from lsmgeo.models.evaluation.sequences import report_sequences
from lsmgeo.models.evaluation.shapes import Shapes
from lsmgeo.models.evaluation.unseen import report_unseen

__all__ = ["FEW", "REPORTS", "evaluate"]

REPORTS: Mapping[str, Callable[[Sequence[Contender], Shapes, Options], Report]] = {
    "iou": report_iou,
    "backgrounds": report_backgrounds,
    "unseen": report_unseen,
    "pose-noise": report_pose_noise,
    "order": report_order,
    "sequences": report_sequences,
    "depth": report_depth,
    "clouds": report_clouds,
}
"""What makes each table or figure."""

FEW = {"sequences": 13, "clouds": 3, "depth": 26}
"""Reports that draw every shape, or take long, and how many shapes they take unless told."""


def evaluate(
    contenders: Sequence[Contender], shapes: Shapes, report: str = "iou", options: Options | None = None
) -> Report:
    """Make one of the paper's tables or figures.

    Args:
        contenders: the models, see `open_contenders`.
        shapes: what is evaluated on, see `open_shapes`.
        report: a name of `REPORTS`.
        options: how it is measured.

    Returns:
        Tables and pictures, see `write_report`.

    Raises:
        OptionError: an unknown report, or models that it is not about.

    Example:
        >>> from lsmgeo.models import create
        >>> from lsmgeo.models.evaluation import Contender, Options, evaluate, open_shapes
        >>> untrained = Contender("V-LSM", create("voxel-lsm", preset="tiny"))
        >>> report = evaluate([untrained], open_shapes(None, size=32, shapes=1), "iou", Options(views=1))
        >>> [row.name for row in report.tables[0].rows]
        ['V-LSM', 'visual hull', 'visual hull, strict', 'paper, V-LSM', 'paper, visual hull']
    """
    make = REPORTS[check_choice("evaluate", "report", report, tuple(REPORTS))]
    made = make(contenders, shapes, options or Options())
    size = shapes.read(0, 1, resolution=None, depth=False, background="white").images.shape[-1]
    enlarged = [
        f"images of {size} pixels were enlarged to the {one.size} of {one.name}, which expects more detail"
        for one in contenders
        if one.size > size
    ]
    return replace(made, notes=[*made.notes, *enlarged])
