"""Transforms of shapes before a model gets them: resized images, pose noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lsmgeo import cameras as camera_tools
from lsmgeo.cameras import CameraTensors
from lsmgeo.data.sample import Sample
from lsmgeo.data.shards.shape_sets import ShapeSpec

__all__ = ["TransformedShapes", "perturb_cameras", "resize_sample", "resize_views"]

# The last number of the seed of pose noise, different from all others.
NOISE = 0x706F7365


class TransformedShapes(Dataset[Sample | ShapeSpec]):
    """The first shapes of a data set, at the size of the model's images and with pose noise in its cameras."""

    def __init__(self, dataset: Dataset[Any], size: int, noise: float, seed: int, length: int) -> None:
        self.dataset, self.size, self.noise, self.seed, self.length = dataset, size, noise, seed, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, item: tuple[int, int]) -> Sample | ShapeSpec:
        shape = self.dataset[item]
        if isinstance(shape, ShapeSpec):
            return shape._replace(model_cameras=perturb_cameras(shape.cameras, self.noise, self.seed, *item))
        shape = resize_sample(shape, self.size)
        return shape._replace(cameras=perturb_cameras(shape.cameras, self.noise, self.seed, *item))


def perturb_cameras(cameras: CameraTensors, degrees: float, seed: int, epoch: int, index: int) -> CameraTensors:
    """Cameras rotated about the object by at most so many degrees; a function of seed, epoch and index."""
    if degrees == 0:
        return cameras
    state = np.random.SeedSequence([seed, epoch, index, NOISE]).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
    return camera_tools.perturb(cameras, degrees, generator=generator)


def resize_sample(sample: Sample, size: int) -> Sample:
    """A sample with square images of ``size`` pixels: means over areas if smaller, else bilinearly interpolated.

    Depth is the mean over the object's part of an area; the mask is where the object covers at least half of it.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.zeros(1), 10.0, 2.0, focal_length=90.0, height=4, width=4)
        >>> depth = torch.tensor([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 4.0]]).repeat(2, 1)[None]
        >>> sample = Sample(torch.rand(1, 3, 4, 4), cameras, depth, depth > 0, None, None, None, "step")
        >>> resize_sample(sample, 2).depth
        tensor([[[0.0000, 2.5000],
                 [0.0000, 2.5000]]])
    """
    if tuple(sample.images.shape[2:]) == (size, size):
        return sample
    mask, depth, share = sample.mask, sample.depth, None
    if mask is None and depth is not None:
        mask = depth > 0
    if mask is not None:
        share = _averaged(mask.float(), size)
        if depth is not None:
            depth = torch.where(share >= 0.5, _averaged(depth * mask, size) / share.clamp_min(1e-6), 0.0)
    images, cameras = resize_views(sample.images, sample.cameras, size)
    return sample._replace(
        images=images,
        cameras=cameras,
        depth=depth,
        mask=None if sample.mask is None or share is None else share >= 0.5,
    )


def resize_views(images: Tensor, cameras: CameraTensors, size: int) -> tuple[Tensor, CameraTensors]:
    """Images (..., 3, H, W) resized to squares of ``size`` pixels, see `resize_sample`, and their cameras."""
    if tuple(images.shape[-2:]) == (size, size):
        return images, cameras
    mode = "area" if size < images.shape[-1] else "bilinear"
    resized = torch.nn.functional.interpolate(images.flatten(0, -4), (size, size), mode=mode)
    return resized.unflatten(0, images.shape[:-3]), camera_tools.resize(cameras, size, size)


def _averaged(maps: Tensor, size: int) -> Tensor:
    return torch.nn.functional.interpolate(maps[:, None], (size, size), mode="area")[:, 0]
