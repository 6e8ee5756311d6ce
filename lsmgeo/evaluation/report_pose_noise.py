"""The figure of noisy poses: voxel IoU against the largest angle of the noise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors, perturb, stack
from lsmgeo.data import Batch
from lsmgeo.evaluation.baselines import HULL, hull_iou
from lsmgeo.evaluation.held_out_shapes import Shapes, batches, noise_of
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.plots import Curve, draw_curves
from lsmgeo.evaluation.report import Report, Row, Scores, Table, iou_by_view, joined

__all__ = ["report_pose_noise", "with_noise"]


def report_pose_noise(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Measure IoU with cameras rotated about the object by random angles up to 0, 5, ... degrees.

    Every camera keeps looking at the object (`lsmgeo.cameras.perturb`). Its axis, and its angle as a share of the
    largest, are the same for all largest angles: a curve is of one draw (Kar et al. 2017, appendix A.1).

    Options: degrees, seed, threshold, batch.

    Returns:
        Table "degrees" with the IoU after all views, and a figure of the curves.
    """
    angles = tuple(sorted(set(options.degrees)))
    resolution = shared(methods, "resolution")
    scores = {name: Scores() for name in (*(method.name for method in methods), HULL)}
    for batch in batches(shapes, views, options.batch, resolution=resolution, progress=options.progress):
        assert batch.occupancy is not None
        assert batch.mask is not None
        found: dict[str, list[Tensor]] = {name: [] for name in scores}
        for angle in angles:
            cameras = with_noise(batch, angle, options.seed)
            for method in methods:
                last = method.occupancies(batch.images, cameras, every=False)[:, None]
                found[method.name].append(iou_by_view(last, batch.occupancy, options.threshold))
            found[HULL].append(hull_iou(batch.mask, cameras, batch.occupancy)[:, -1:])
        for name, parts in found.items():
            scores[name].add(batch.name, batch.category, torch.cat(parts, 1))
    columns = [f"{angle:g}°" for angle in angles]
    rows = [Row(name, one.cells(100)) for name, one in scores.items()]
    curves = [Curve(name, angles, one.cells(100)) for name, one in scores.items()]
    return Report(
        "pose-noise",
        [Table("degrees", f"voxel IoU [%], {views} views, noise up to:", columns, rows)],
        {"views": views, "degrees": list(angles), "threshold": options.threshold},
        joined(scores, "iou"),
        {
            "pose-noise": draw_curves(
                curves,
                title=f"Noisy poses, {views} views",
                data=shapes.about,
                across="largest angle [degrees]",
                up="voxel IoU [%]",
            )
        },
    )


def with_noise(batch: Batch, degrees: float, seed: int) -> CameraTensors:
    """The cameras of a batch, rotated by up to ``degrees`` by noise that is different for each shape."""
    generators = [noise_of(seed, name) for name in batch.name]
    return stack([perturb(batch.cameras.at(k), degrees, generator=each) for k, each in enumerate(generators)])
