"""What a model predicts beside what is true, as one picture for the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Sample
from lsmgeo.models.pictures import draw_depth, draw_voxels, tile

__all__ = ["Example", "draw_examples"]

SIZE = 96
THRESHOLD = 0.4
ELEVATION = 25.0

Picture = npt.NDArray[np.uint8]


class Example(NamedTuple):
    """A shape with what was predicted of it after each of its V views, on the CPU.

    Attributes:
        sample: the truth.
        predicted: occupancy (V, D, H, W) probabilities, or depth (V, V, H, W).
    """

    sample: Sample
    predicted: Tensor


def draw_examples(examples: Sequence[Example]) -> Picture:
    """Draw shapes below each other: above the views in their order, below what is predicted after each, and the truth.

    Of depth, what is predicted after all views stands below each view, and the truth below that, as maps (near is
    bright) and as surfaces seen from beside the camera.

    Args:
        examples: at least one, all of occupancy or all of depth.

    Returns:
        (h, w, 3) uint8.
    """
    rows: list[list[Picture | None]] = []
    for example in examples:
        rows += _voxel_rows(example) if example.sample.occupancy is not None else _depth_rows(example)
    return tile(rows)


def _voxel_rows(example: Example) -> list[list[Picture | None]]:
    sample = example.sample
    assert sample.occupancy is not None
    azimuth = _azimuth(sample.cameras)
    after = [draw_voxels(grid > THRESHOLD, azimuth, ELEVATION, SIZE) for grid in example.predicted]
    truth = draw_voxels(sample.occupancy, azimuth, ELEVATION, SIZE, colour=(0.72, 0.72, 0.70))
    return [[_enlarged(image) for image in sample.images], [*after, truth]]


def _depth_rows(example: Example) -> list[list[Picture | None]]:
    sample = example.sample
    assert sample.depth is not None
    known = sample.depth > 0
    predicted = torch.where(known, example.predicted[-1].float(), 0.0)
    low, high = (float(bound) for bound in sample.depth[known].aminmax()) if known.any() else (1.0, 2.0)
    rows: list[list[Picture | None]] = [[_enlarged(image) for image in sample.images]]
    for depth in (predicted, sample.depth):
        near = ((high - depth) / max(high - low, 1e-6)).clamp(0, 1)
        shown = torch.where(known, 0.15 + 0.85 * near, 1.0)
        rows.append([_enlarged(one.expand(3, *one.shape)) for one in shown])
    for depth in (predicted, sample.depth):
        rows.append([draw_depth(one, _camera(sample.cameras, view), size=SIZE) for view, one in enumerate(depth)])
    return rows


def _camera(cameras: CameraTensors, view: int) -> CameraTensors:
    return CameraTensors(*(torch.as_tensor(value)[view] for value in cameras))


def _azimuth(cameras: CameraTensors) -> float:
    """From which side the first camera looks at the origin, in degrees."""
    pose = cameras.cam_from_world[0].double().cpu()
    center = -pose[:3, :3].T.mv(pose[:3, 3])
    return float(torch.rad2deg(torch.atan2(center[2], center[0])))


def _enlarged(image: Tensor) -> Picture:
    """(3, H, W) in [0, 1] as a picture of the common size."""
    scaled = torch.nn.functional.interpolate(image[None].float().cpu(), (SIZE, SIZE), mode="nearest")[0]
    return np.asarray((scaled.clamp(0, 1) * 255).round().byte().permute(1, 2, 0))
