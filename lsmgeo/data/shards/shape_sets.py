"""The sets of shapes that training and evaluation read: shards, or synthetic-13, rendered when read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from lsmgeo import scenes
from lsmgeo._checks import check_choice
from lsmgeo.cameras import CameraTensors, to
from lsmgeo.data.sample import Batch, Sample, collate, pad_with_first, pad_with_zeros
from lsmgeo.data.shards.background_sources import Background, make_background
from lsmgeo.data.shards.read_shards import ShardSet
from lsmgeo.errors import OptionError
from lsmgeo.scenes import Lights, synthetic13

__all__ = [
    "ShapeSet",
    "ShapeSpec",
    "SyntheticSet",
    "describe_shape",
    "render_batch",
    "render_shapes",
    "synthetic_numbers",
]

# Sets of at most so many shapes are read many times, so their shapes are kept.
MOST_KEPT = 1000


class ShapeSpec(NamedTuple):
    """A synthetic shape and its views, before rendering."""

    shape: synthetic13.SyntheticShape
    cameras: CameraTensors  # (V,) float64
    model_cameras: CameraTensors  # the input of the model, possibly with pose noise
    backgrounds: Tensor  # (V, 3, H, W) or (V, 3, 1, 1)
    occupancy: Tensor | None


def render_shapes(
    specs: Sequence[ShapeSpec], *, depth: bool, device: torch.device | None = None, shadows: bool = False
) -> list[Sample]:
    """Render shapes in one call; the samples have the cameras of the model.

    Args:
        specs: at least one; images of one size.
        depth: whether depth is kept.
        device: of the rendering; by default the CPU.
        shadows: whether shapes cast shadows on themselves.
    """
    device = torch.device("cpu") if device is None else device
    cameras = zip(*(spec.cameras for spec in specs), strict=True)
    lights = [spec.shape.lights for spec in specs]
    rendering = scenes.render(
        [spec.shape.scene for spec in specs],
        CameraTensors(*(pad_with_first([*map(torch.as_tensor, values)]).to(device) for values in cameras)),
        Lights(  # padded with black lights
            pad_with_first([light.directions for light in lights]),
            pad_with_zeros([light.colours for light in lights]),
            torch.stack([light.ambient for light in lights]),
        ),
        background=pad_with_first([spec.backgrounds for spec in specs]).to(device),
        shadows=shadows,
    )
    return [
        Sample(
            images[: len(spec.backgrounds)],
            to(spec.model_cameras, device),
            depths[: len(spec.backgrounds)] if depth else None,
            mask[: len(spec.backgrounds)],
            None if spec.occupancy is None else spec.occupancy.to(device),
            None,
            spec.shape.category,
            spec.shape.name,
        )
        for spec, images, depths, mask in zip(specs, rendering.images, rendering.depth, rendering.mask, strict=True)
    ]


def render_batch(specs: Sequence[ShapeSpec], *, depth: bool, device: torch.device, at_once: bool) -> Batch:
    """Render shapes as a batch.

    Args:
        specs: the shapes.
        depth: whether depth is kept.
        device: of the rendering.
        at_once: whether all shapes are rendered in one call, which suits a GPU; one by one, no padding is rendered.
    """
    groups = [specs] if at_once else [[spec] for spec in specs]
    return collate([_single(sample) for some in groups for sample in render_shapes(some, depth=depth, device=device)])


def _single(sample: Sample) -> Sample:
    return sample._replace(cameras=to(sample.cameras, dtype=torch.float32))


@dataclass(eq=False)
class SyntheticSet:
    """Shapes of synthetic-13 with the interface of `ShardSet`, rendered when read.

    Attributes:
        numbers: of the shapes in the set, see `synthetic_numbers`.
        size: height and width of the images in pixels.
        seed: of the set.
        pool: the number of views of a shape, by default that of `lsmgeo render`.
        is_rendered: whether a shape is read as a `Sample`; else as a `ShapeSpec`, for `render_batch`.
    """

    numbers: Sequence[int]
    size: int
    seed: int = 0
    pool: int = 20
    is_rendered: bool = True
    folder: Path = Path("synthetic-13")  # in errors
    _kept: dict[tuple[int, int | None], ShapeSpec] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.categories = [_category_of(number) for number in self.numbers]
        self.names = [f"{name}-{number:08d}" for name, number in zip(self.categories, self.numbers, strict=True)]
        self.splits = [synthetic13.split(self.seed, number) for number in self.numbers]
        self.view_counts = np.full(len(self.numbers), self.pool)

    def __len__(self) -> int:
        return len(self.numbers)

    def path(self, index: int) -> Path:
        """The set's name, since there is no file."""
        return self.folder

    def read(
        self,
        index: int,
        *,
        views: Sequence[int] | None = None,
        depth: bool = True,
        occupancy: int | None = 32,
        background: Background = "white",
        generator: np.random.Generator | None = None,
    ) -> Any:
        """A shape, or some views of it; see `ShardSet.read`."""
        key = index, occupancy
        spec = self._kept.get(key)
        if spec is None:
            spec = describe_shape(self.seed, self.numbers[index], self.pool, self.size)
            if occupancy is not None:
                spec = spec._replace(occupancy=scenes.voxels([spec.shape.scene], occupancy)[0])
            if len(self) <= MOST_KEPT:
                self._kept[key] = spec
        chosen = list(range(self.pool) if views is None else views)
        draw = make_background(background)
        behind = [draw(generator, self.size, self.size) for _ in chosen]
        cameras = spec.cameras.at(chosen)
        spec = spec._replace(cameras=cameras, model_cameras=cameras, backgrounds=torch.from_numpy(np.stack(behind)))
        return _single(render_shapes([spec], depth=depth)[0]) if self.is_rendered else spec


ShapeSet: TypeAlias = ShardSet | SyntheticSet


def describe_shape(seed: int, number: int, views: int, size: int) -> ShapeSpec:
    """A shape of synthetic-13, by the set's seed and its number, with all its views, on white and without voxels."""
    cameras = synthetic13.views(seed, number, views, size)
    return ShapeSpec(synthetic13.shape(seed, number), cameras, cameras, torch.ones(views, 3, 1, 1), None)


def _category_of(number: int) -> str:
    return tuple(synthetic13.CATEGORIES)[number % len(synthetic13.CATEGORIES)]


def synthetic_numbers(split: str, categories: Sequence[str] | None = None, seed: int = 0) -> Iterator[int]:
    """The numbers of the shapes of a split and of some categories (None for all) of synthetic-13, ascending, endless.

    Raises:
        OptionError: an unknown split or category.
    """
    check_choice("synthetic-13", "split", split, ("train", "val", "test"))
    names = tuple(synthetic13.CATEGORIES)
    if categories is not None and (not categories or not set(categories) <= set(names)):
        raise OptionError(f"synthetic-13: categories must be of {', '.join(names)}; got {categories}")
    return (
        number
        for number in itertools.count()
        if (categories is None or _category_of(number) in categories) and synthetic13.split(seed, number) == split
    )
