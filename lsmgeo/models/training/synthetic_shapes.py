"""Shapes of synthetic-13, rendered when they are needed: on the CPU in the workers, on a GPU a batch at once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lsmgeo import cameras as camera_tools
from lsmgeo import scenes
from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Batch, Sample, collate
from lsmgeo.data.backgrounds import make_background
from lsmgeo.errors import OptionError
from lsmgeo.models.training.adapting import turn_cameras
from lsmgeo.models.training.config import DataConfig
from lsmgeo.scenes import Lights, Scene, synthetic13

__all__ = ["Described", "Renderer", "SyntheticShapes"]


MOST_KEPT = 1000


class Described(NamedTuple):
    """A synthetic shape with the views of it that are wanted, before anything of it is rendered."""

    scene: Scene
    lights: Lights
    cameras: CameraTensors  # (V,) float64
    noisy: CameraTensors  # what the model is told
    backgrounds: Tensor  # (V, 3, H, W) or (V, 3, 1, 1)
    occupancy: Tensor | None
    category: str
    name: str


class SyntheticShapes(Dataset[Described]):
    """Some shapes of synthetic-13, each item with views drawn as `ShapeDataset` draws them.

    Args:
        config: which set.
        size: height and width of the images in pixels.
        voxels: a side of the occupancy, or None.
        seed: what views, backgrounds and noise are drawn from.
        views: the least and the largest number of views.
        split: the part of the set.
        categories: names, or None for all.
        noise: degrees by which cameras are turned.

    Raises:
        OptionError: there is no such shape.
    """

    def __init__(
        self,
        config: DataConfig,
        *,
        size: int,
        voxels: int | None,
        seed: int,
        views: tuple[int, int],
        split: str,
        categories: Sequence[str] | None,
        noise: float,
    ) -> None:
        self.config, self.size, self.voxels, self.seed = config, size, voxels, seed
        self.views, self.noise = views, noise
        self._kept: dict[int, tuple[synthetic13.SyntheticShape, Tensor | None]] = {}
        self.background = make_background(config.background)
        names = tuple(synthetic13.CATEGORIES)
        if strange := sorted(set(categories or ()) - set(names)):
            raise OptionError(f"data: categories must be of {', '.join(names)}; got {strange}")
        wanted = (
            index
            for index in range(config.shapes)
            if (categories is None or names[index % len(names)] in categories)
            and synthetic13.split(config.set_seed, index) == split
        )
        self.indices = list(itertools.islice(wanted, config.limit))
        if not self.indices:
            raise OptionError(
                f"data: of {config.shapes} shapes of synthetic-13 none is of split {split!r}, categories {categories}"
            )

    @property
    def names(self) -> list[str]:
        """What tells the shapes and their views from those of another set."""
        return [f"{self.config.set_seed}/{self.config.pool}/{number}" for number in self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def _made(self, number: int) -> tuple[synthetic13.SyntheticShape, Tensor | None]:
        """A shape and its voxels. A small set is gone through again and again: it is kept."""
        if number in self._kept:
            return self._kept[number]
        shape = synthetic13.shape(self.config.set_seed, number)
        made = shape, None if self.voxels is None else scenes.voxels([shape.scene], self.voxels)[0]
        if len(self) <= MOST_KEPT:
            self._kept[number] = made
        return made

    def __getitem__(self, item: tuple[int, int]) -> Described:
        epoch, index = item
        number, (low, high) = self.indices[index], self.views
        generator = np.random.default_rng(np.random.SeedSequence([self.seed, epoch, index, 0]))
        count = low + int(generator.random() * (high - low + 1))
        chosen = np.argsort(generator.random(self.config.pool), kind="stable")[:count].tolist()
        shape, occupancy = self._made(number)
        cameras = synthetic13.views(self.config.set_seed, number, self.config.pool, self.size)
        cameras = CameraTensors(*(torch.as_tensor(value)[chosen] for value in camera_tools.as_tensors(cameras)))
        behind = [self.background(generator, self.size, self.size) for _ in chosen]
        return Described(
            shape.scene,
            shape.lights,
            cameras,
            turn_cameras(cameras, self.noise, self.seed, epoch, index),
            torch.from_numpy(np.stack(behind)),
            occupancy,
            shape.category,
            shape.name,
        )


@dataclass(frozen=True)
class Renderer:
    """Makes a batch of described shapes.

    Attributes:
        depth: whether depth is kept.
        device: what renders.
        at_once: whether all views are rendered in one call, as suits a GPU; a CPU renders them one by one in any case.
    """

    depth: bool
    device: torch.device
    at_once: bool

    def __call__(self, shapes: Sequence[Described]) -> Batch:
        """Render."""
        if not self.at_once:  # no view is rendered to be thrown away
            return collate([self._sample(shape) for shape in shapes])
        most = max(len(shape.backgrounds) for shape in shapes)
        counts = torch.tensor([len(shape.backgrounds) for shape in shapes])
        seen = _padded_cameras([shape.cameras for shape in shapes], most, self.device)
        told = _padded_cameras([shape.noisy for shape in shapes], most, self.device)
        behind = torch.stack([_longer(shape.backgrounds, most) for shape in shapes]).to(self.device)
        picture = scenes.render([shape.scene for shape in shapes], seen, self._lights(shapes), background=behind)
        view_mask = (torch.arange(most) < counts[:, None]).to(self.device)
        there = view_mask[..., None, None]
        grids = [shape.occupancy for shape in shapes if shape.occupancy is not None]
        return Batch(
            picture.images * there[..., None],
            camera_tools.to(told, dtype=torch.float32),
            picture.depth * there if self.depth else None,
            picture.mask & there,
            torch.stack(grids).to(self.device) if grids else None,
            (None,) * len(shapes),
            tuple(shape.category for shape in shapes),
            tuple(shape.name for shape in shapes),
            view_mask,
        )

    def _sample(self, shape: Described) -> Sample:
        one = CameraTensors(*(torch.as_tensor(value)[None] for value in shape.cameras))
        picture = scenes.render([shape.scene], one, shape.lights, background=shape.backgrounds[None])
        return Sample(
            picture.images[0],
            camera_tools.to(shape.noisy, dtype=torch.float32),
            picture.depth[0] if self.depth else None,
            picture.mask[0],
            shape.occupancy,
            None,
            shape.category,
            shape.name,
        )

    def _lights(self, shapes: Sequence[Described]) -> Lights:
        """The lights of all shapes, dark ones where a shape has fewer."""
        most = max(len(shape.lights.directions) for shape in shapes)
        return Lights(
            torch.stack([_longer(shape.lights.directions, most) for shape in shapes]),
            torch.stack([_filled(shape.lights.colours, most) for shape in shapes]),
            torch.stack([shape.lights.ambient for shape in shapes]),
        )


def _longer(values: Tensor, most: int) -> Tensor:
    """The first axis filled up with copies of the first."""
    return torch.cat((values, values[:1].expand(most - len(values), *values.shape[1:])))


def _filled(values: Tensor, most: int) -> Tensor:
    return torch.cat((values, values.new_zeros(most - len(values), *values.shape[1:])))


def _padded_cameras(cameras: Sequence[CameraTensors], most: int, device: torch.device) -> CameraTensors:
    fields = zip(*(camera_tools.as_tensors(camera) for camera in cameras), strict=True)
    return CameraTensors(*(torch.stack([_longer(value, most) for value in field]).to(device) for field in fields))
