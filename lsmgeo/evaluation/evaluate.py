"""Reports by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from lsmgeo._checks import check_choice
from lsmgeo.errors import OptionError
from lsmgeo.evaluation.held_out_shapes import Shapes
from lsmgeo.evaluation.methods import Contender
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.report import Report
from lsmgeo.evaluation.report_backgrounds import report_backgrounds
from lsmgeo.evaluation.report_clouds import report_clouds
from lsmgeo.evaluation.report_depth import report_depth
from lsmgeo.evaluation.report_iou import report_iou
from lsmgeo.evaluation.report_order import report_order
from lsmgeo.evaluation.report_pose_noise import report_pose_noise
from lsmgeo.evaluation.report_sequences import report_sequences
from lsmgeo.evaluation.report_unseen import report_unseen

__all__ = ["FEW", "REPORTS", "evaluate"]

REPORTS: Mapping[str, tuple[Callable[[Sequence[Contender], Shapes, int, Options], Report], int]] = {
    "iou": (report_iou, 8),
    "backgrounds": (report_backgrounds, 4),
    "unseen": (report_unseen, 8),
    "pose-noise": (report_pose_noise, 4),
    "order": (report_order, 8),
    "sequences": (report_sequences, 4),
    "depth": (report_depth, 10),
    "clouds": (report_clouds, 20),
}
"""What makes each table or figure, and how many views the paper has there, at most."""

OF_DEPTH = ("depth", "clouds")

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
        OptionError: an unknown report, models that it is not about, or one view for a report of depth.

    Example:
        >>> from lsmgeo.models import create
        >>> from lsmgeo.evaluation import Contender, Options, evaluate, open_shapes
        >>> untrained = Contender("V-LSM", create("voxel-lsm", preset="tiny"))
        >>> report = evaluate([untrained], open_shapes(None, size=32, shapes=1), "iou", Options(views=1))
        >>> [row.name for row in report.tables[0].rows]
        ['V-LSM', 'visual hull', 'visual hull, strict', 'paper, V-LSM', 'paper, visual hull']
    """
    make, usual = REPORTS[check_choice("evaluate", "report", report, tuple(REPORTS))]
    options, is_depth = options or Options(), report in OF_DEPTH
    for contender in contenders:
        if contender.has_depth != is_depth:
            wanted, other = ("depth", "voxels") if is_depth else ("voxels", "depth")
            raise OptionError(f"evaluate: report {report!r} is about {wanted}; {contender.name} gives {other}")
    wanted_views = options.views or usual
    views = min(wanted_views, shapes.most_views)
    if is_depth and views < 2:
        raise OptionError(f"evaluate: report {report!r} needs two views at least, which plane sweep matches")
    made = make(contenders, shapes, views, options)
    models = [
        {
            "name": contender.name,
            "network": contender.kind,
            "path": contender.path,
            "trained on": contender.training.words or "all categories, white",
            "parameters": sum(parameter.numel() for parameter in contender.model.parameters()),
        }
        for contender in contenders
    ]
    facts = {"data": shapes.about, "models": models, "seed": options.seed, **made.facts}
    fewer = [f"the shapes have {views} views; {wanted_views} were wanted"] if views < wanted_views else []
    size = shapes.read(0, 1, resolution=None, depth=False, background="white").images.shape[-1]
    enlarged = [
        f"images of {size} pixels were enlarged to the {one.size} of {one.name}, which expects more detail"
        for one in contenders
        if one.size > size
    ]
    return replace(made, facts=facts, notes=[*fewer, *made.notes, *enlarged])
