"""All reports by name, and the function that makes one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from lsmgeo._checks import check_choice
from lsmgeo.errors import OptionError
from lsmgeo.evaluation.held_out_shapes import Shapes
from lsmgeo.evaluation.methods import Method, Options
from lsmgeo.evaluation.report import Report
from lsmgeo.evaluation.report_backgrounds import report_backgrounds
from lsmgeo.evaluation.report_clouds import report_clouds
from lsmgeo.evaluation.report_depth import report_depth
from lsmgeo.evaluation.report_iou import report_iou
from lsmgeo.evaluation.report_order import report_order
from lsmgeo.evaluation.report_pose_noise import report_pose_noise
from lsmgeo.evaluation.report_sequences import report_sequences
from lsmgeo.evaluation.report_unseen import report_unseen

__all__ = ["REPORTS", "ReportEntry", "evaluate"]


class ReportEntry(NamedTuple):
    """A report, and its defaults.

    ``make`` takes the models under test, of one resolution of voxels or one size of images; the shapes to test on, with
    depth for depth models; the largest number of views; and the options. It raises `OptionError` if the models do not
    fit together.
    """

    make: Callable[[Sequence[Method], Shapes, int, Options], Report]
    views: int  # the largest number, as in the paper
    shapes: int | None = None  # fewer than all where each is drawn, or where measuring takes long
    output: str = "voxels"  # of the networks that it measures: "voxels" or "depth"


REPORTS: Mapping[str, ReportEntry] = {
    "iou": ReportEntry(report_iou, 8),
    "backgrounds": ReportEntry(report_backgrounds, 4),
    "unseen": ReportEntry(report_unseen, 8),
    "pose-noise": ReportEntry(report_pose_noise, 4),
    "order": ReportEntry(report_order, 8),
    "sequences": ReportEntry(report_sequences, 4, shapes=13),
    "depth": ReportEntry(report_depth, 10, shapes=26, output="depth"),
    "clouds": ReportEntry(report_clouds, 20, shapes=3, output="depth"),
}
"""All tables and figures by name. A new report is a file ``report_*.py`` and a line here."""


def evaluate(methods: Sequence[Method], shapes: Shapes, report: str = "iou", options: Options | None = None) -> Report:
    """Make one of the paper's tables or figures.

    Args:
        methods: the models under test, see `open_methods`.
        shapes: the shapes that they are tested on, see `open_shapes`.
        report: a name of `REPORTS`.
        options: how it is measured.

    Returns:
        Tables and images, see `write_report`.

    Raises:
        OptionError: an unknown report, models that it does not measure, or one view for a report of depth.

    Example:
        >>> from lsmgeo.models import create
        >>> from lsmgeo.evaluation import Method, Options, evaluate, open_shapes
        >>> untrained = Method("V-LSM", create("voxel-lsm", preset="tiny"))
        >>> report = evaluate([untrained], open_shapes(None, size=32, shapes=1), "iou", Options(views=1))
        >>> [row.name for row in report.tables[0].rows]
        ['V-LSM', 'visual hull', 'visual hull, strict', 'paper, V-LSM', 'paper, visual hull']
    """
    entry = REPORTS[check_choice("evaluate", "report", report, tuple(REPORTS))]
    options, is_depth = options or Options(), entry.output == "depth"
    for method in methods:
        if method.has_depth != is_depth:
            other = "depth" if method.has_depth else "voxels"
            raise OptionError(f"evaluate: report {report!r} measures {entry.output}; {method.name} predicts {other}")
    wanted_views = options.views or entry.views
    views = min(wanted_views, shapes.most_views)
    if is_depth and views < 2:
        raise OptionError(f"evaluate: report {report!r} needs at least two views for the plane sweep; got {views}")
    made = entry.make(methods, shapes, views, options)
    models = [
        {
            "name": method.name,
            "network": method.kind,
            "path": method.path,
            "trained on": method.training.words or "all categories, white",
            "parameters": sum(parameter.numel() for parameter in method.model.parameters()),
        }
        for method in methods
    ]
    facts = {"data": shapes.about, "models": models, "seed": options.seed, **made.facts}
    fewer = [f"the shapes have {views} views; {wanted_views} were wanted"] if views < wanted_views else []
    size = shapes.read(0, 1, resolution=None, depth=False, background="white").images.shape[-1]
    enlarged = [
        f"images of {size} pixels were enlarged to the {one.size} of {one.name}, which expects more detail"
        for one in methods
        if one.size > size
    ]
    return replace(made, facts=facts, notes=[*fewer, *made.notes, *enlarged])
