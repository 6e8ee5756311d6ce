"""Junk in every argument: an error of ours that names it, or an answer; never anything else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo import metrics
from lsmgeo.errors import LsmGeoError
from tests.fuzz.junk import JUNK, NEVER

MAP, GRID = torch.rand(2, 3, 4), torch.rand(2, 3, 4, 5)
POINTS = np.arange(15.0).reshape(5, 3)
CALLS = {
    "voxel_iou": (metrics.voxel_iou, {"predicted": GRID, "occupancy": GRID > 0.5, "threshold": 0.4}),
    "depth_errors": (metrics.depth_errors, {"predicted": MAP, "depth": MAP, "mask": MAP > 0.5}),
    "bad_pixel_rate": (
        metrics.bad_pixel_rate,
        {"predicted": MAP, "true": MAP, "threshold": 1.0, "mask": MAP > 0.5, "missing": "skip"},
    ),
    "median_depth_error": (
        metrics.median_depth_error,
        {"predicted": MAP, "depth": MAP, "mask": MAP > 0.5, "center": 2.0, "radius": 1.0, "rule": "paper"},
    ),
    "density_curve": (
        metrics.density_curve,
        {"errors": MAP, "confidence": MAP, "densities": (0.5,), "mask": MAP > 0.5, "statistic": "bad", "threshold": 1},
    ),
    "point_cloud_scores": (
        metrics.point_cloud_scores,
        {"predicted": POINTS, "true": POINTS, "threshold": 1.0, "cell": 0.5},
    ),
    "category_means": (metrics.category_means, {"values": torch.rand(2), "categories": ["a", "b"]}),
    "VoxelIoU": (metrics.VoxelIoU, {"threshold": 0.4}),
    "VoxelIoU.update": (
        metrics.VoxelIoU().update,
        {"predicted": GRID, "occupancy": GRID > 0.5, "categories": ["a", "b"]},
    ),
    "DepthError": (metrics.DepthError, {"center": 2.0, "radius": 1.0, "rule": "paper"}),
    "DepthError.update": (
        metrics.DepthError().update,
        {"predicted": GRID, "depth": GRID, "categories": ["a", "b"], "mask": GRID > 0.5},
    ),
    "RunningDensityCurve": (metrics.RunningDensityCurve, {"densities": (0.5,), "statistic": "bad", "threshold": 1.0}),
    "RunningDensityCurve.update": (
        metrics.RunningDensityCurve((0.5,)).update,
        {"errors": MAP, "confidence": MAP, "mask": MAP > 0.5},
    ),
}
# As large as the memory of a computer, though it takes none: nothing refuses that.
KINDS = [kind for kind in JUNK if kind != "huge expanded"]


def complaint(function, arguments, argument) -> list[tuple[str, str]]:
    """The kinds of junk of which an error does not name the argument, or that are taken and are never right."""
    found = []
    for kind in KINDS:
        try:
            function(**{**arguments, argument: JUNK[kind](arguments[argument])})
        except LsmGeoError as error:
            if argument not in str(error):
                found.append((kind, str(error)))
        else:
            # One word may name the category of all models.
            if kind in NEVER and (kind, argument) != ("word", "categories"):
                found.append((kind, "taken"))
    return found


@pytest.mark.parametrize(
    ("call", "argument"), [(call, argument) for call, (_, arguments) in CALLS.items() for argument in arguments]
)
def test_junk_is_named_or_measured(call, argument):
    function, arguments = CALLS[call]
    function(**arguments)
    assert complaint(function, arguments, argument) == []
