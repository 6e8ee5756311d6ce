"""The figures of depth: D-LSM and plane sweep with 5, 10 and 20 views, as shaded depth and as joint point clouds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors, unproject_depth
from lsmgeo.data import Batch
from lsmgeo.data.sample import first_views
from lsmgeo.drawing import Pixels, as_pixels, draw_depth, draw_points
from lsmgeo.evaluation.baselines import SWEEP, sweep_views
from lsmgeo.evaluation.held_out_shapes import Shapes, batches
from lsmgeo.evaluation.methods import Method, Options, shared
from lsmgeo.evaluation.plots import sheet
from lsmgeo.evaluation.report import Cell, Report, Row, Table, means_of
from lsmgeo.metrics import depth_errors, point_cloud_scores

__all__ = ["joint_cloud", "report_clouds"]

COUNTS = (5, 10, 20)
SIDE = 160
TRUTH = "truth"
# The distance threshold of the F-score, world units: about half a voxel of a grid of 32.
NEAR = 0.015


def report_clouds(methods: Sequence[Method], shapes: Shapes, views: int, options: Options) -> Report:
    """Draw shaded depth maps from a shifted viewpoint, and the points of all views together.

    Depth maps of all methods are cut by the silhouettes (plane sweep has no depth at some pixels of the object).
    Kar et al. 2017, figures 4 and 5.

    All shapes are drawn. Options: planes, window.

    Returns:
        A figure per shape and a PLY file per cloud; tables of the mean depth error and of the F-score of the cloud
        against that of the true depth.
    """
    size = shared(methods, "size")
    counts = [count for count in COUNTS if count < views] + [views]
    figures, clouds, measured = {}, {}, []
    names = (SWEEP, *(method.name for method in methods))
    for batch in batches(shapes.at(size), views, 1, resolution=None, depth=True, progress=options.progress):
        shape = batch.name[0]
        found = {
            (name, count): depth for count in counts for name, depth in _depths(methods, batch, count, options).items()
        }
        assert batch.depth is not None
        assert batch.mask is not None
        found |= {(TRUTH, count): batch.depth[0, :count] for count in counts}
        found = {key: torch.where(batch.mask[0, : key[1]], depth, 0.0) for key, depth in found.items()}
        joint = {key: joint_cloud(depth, batch.images[0], batch.cameras.at(0)) for key, depth in found.items()}
        figures[f"clouds-{_file(shape)}"] = _draw(shape, batch, counts, (TRUTH, *names), found, joint)
        for (name, count), cloud in joint.items():
            clouds[f"clouds-{_file(shape)}-{_file(name)}-{count}"] = cloud
        for name in names:
            for count in counts:
                error = depth_errors(found[name, count], batch.depth[0, :count]).l1.nanmean()
                scores = point_cloud_scores(joint[name, count][0], joint[TRUTH, count][0], NEAR, cell=NEAR / 2)
                measured.append((shape, name, count, float(error), scores.f_score))
    columns = [str(count) for count in counts]
    tables = [
        Table(key, title, columns, [Row(name, _means(measured, name, counts, place)) for name in names], digits)
        for key, title, place, digits in (
            ("error", "mean depth error [world units], views:", 3, 4),
            ("f-score", f"F-score of the cloud at {NEAR}, views:", 4, 3),
        )
    ]
    facts = {"views": counts, "planes": options.planes, "window": options.window, "size": size}
    keys = ("name", "method", "views", "mean depth error", "f_score")
    by_shape = [dict(zip(keys, numbers, strict=True)) for numbers in measured]
    return Report("clouds", tables, facts, by_shape, figures, clouds)


def _depths(methods: Sequence[Method], batch: Batch, count: int, options: Options) -> dict[str, Tensor]:
    """Depth (count, H, W) of every method from the first views of one shape."""
    images, cameras = batch.images[:, :count], first_views(batch.cameras, count)
    swept = sweep_views(images[0], cameras.at(0), planes=options.planes, window=options.window).depth
    return {SWEEP: swept} | {one.name: one.depths(images, cameras)[0] for one in methods}


def joint_cloud(depth: Tensor, images: Tensor, cameras: CameraTensors) -> tuple[np.ndarray, np.ndarray]:
    """The points (N, 3) of all pixels with a positive, finite depth (V, H, W), and their colours (N, 3) uint8."""
    has_depth = (depth > 0) & depth.isfinite()
    filled = torch.where(has_depth, depth, 0.0).double()
    points = unproject_depth(cameras.at(slice(len(depth))), filled[None])[0]
    return points[has_depth].numpy(), np.stack([as_pixels(image) for image in images[: len(depth)]])[has_depth]


def _draw(
    shape: str,
    batch: Batch,
    counts: Sequence[int],
    methods: Sequence[str],
    depths: dict[tuple[str, int], Tensor],
    clouds: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]],
) -> bytes:
    camera = batch.cameras.at((0, 0))
    rows: list[list[Pixels | None]] = []
    for name in methods:
        shaded: list[Pixels | None] = [draw_depth(depths[name, count][0], camera, size=SIDE) for count in counts]
        if name == TRUTH:
            shaded[1:] = [None] * len(shaded[1:])  # it does not depend on the number of views
        drawn = [draw_points(*clouds[name, count], size=SIDE) for count in counts]
        rows.append([as_pixels(batch.images[0, 0], SIDE) if name == TRUTH else None, *shaded, *drawn])
    columns = ["first view"]
    columns += [f"depth, {count} views" for count in counts] + [f"points, {count} views" for count in counts]
    return sheet(rows, methods, columns, title=f"{shape}: depth of the first view from the side; all points together")


def _means(
    measured: Sequence[tuple[str, str, int, float, float]], name: str, counts: Sequence[int], place: int
) -> list[Cell]:
    found = [[float(line[place]) for line in measured if line[1:3] == (name, count)] for count in counts]
    return [means_of(values, ["all"] * len(values)) for values in found]


def _file(name: str) -> str:
    """A name in characters that are valid in names of files."""
    return "".join(letter if letter.isalnum() or letter in "-." else "_" for letter in name)
