"""Predictions beside the ground truth, as one image for the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors, centers
from lsmgeo.data import Sample
from lsmgeo.drawing import Pixels, as_pixels, draw_depth, draw_voxels, tile

__all__ = ["Example", "draw_examples"]

SIZE = 96
THRESHOLD = 0.4
ELEVATION = 25.0


class Example(NamedTuple):
    """A shape and its predictions after each of its V views, on the CPU.

    Attributes:
        sample: the truth.
        predicted: occupancy (V, D, H, W) probabilities, or depth (V, V, H, W).
    """

    sample: Sample
    predicted: Tensor


def draw_examples(examples: Sequence[Example]) -> Pixels:
    """Draw shapes, each as a row of its views above a row of the prediction after each view, and the truth.

    Of depth, the prediction after all views is below each view, and the truth below that, as maps (near is bright) and
    as surfaces seen from beside the camera.

    Args:
        examples: at least one, all of occupancy or all of depth.
    """
    rows: list[list[Pixels | None]] = []
    for example in examples:
        rows += _voxel_rows(example) if example.sample.occupancy is not None else _depth_rows(example)
    return tile(rows)


def _voxel_rows(example: Example) -> list[list[Pixels | None]]:
    sample = example.sample
    assert sample.occupancy is not None
    azimuth = _azimuth(sample.cameras)
    after = [draw_voxels(grid > THRESHOLD, azimuth, ELEVATION, SIZE) for grid in example.predicted]
    truth = draw_voxels(sample.occupancy, azimuth, ELEVATION, SIZE, colour=(0.72, 0.72, 0.70))
    return [[as_pixels(image, SIZE) for image in sample.images], [*after, truth]]


def _depth_rows(example: Example) -> list[list[Pixels | None]]:
    sample = example.sample
    assert sample.depth is not None
    known = sample.depth > 0
    predicted = torch.where(known, example.predicted[-1].float(), 0.0)
    low, high = (float(bound) for bound in sample.depth[known].aminmax()) if known.any() else (1.0, 2.0)
    rows: list[list[Pixels | None]] = [[as_pixels(image, SIZE) for image in sample.images]]
    for depth in (predicted, sample.depth):
        near = ((high - depth) / max(high - low, 1e-6)).clamp(0, 1)
        shown = torch.where(known, 0.15 + 0.85 * near, 1.0)
        rows.append([as_pixels(one.expand(3, *one.shape), SIZE) for one in shown])
    for depth in (predicted, sample.depth):
        rows.append([draw_depth(one, sample.cameras.at(view), size=SIZE) for view, one in enumerate(depth)])
    return rows


def _azimuth(cameras: CameraTensors) -> float:
    """The azimuth of the first camera, in degrees."""
    x, _, z = centers(cameras.at(0)).double().cpu()
    return float(torch.rad2deg(torch.atan2(z, x)))
