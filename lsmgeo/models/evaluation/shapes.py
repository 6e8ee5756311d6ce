"""What is evaluated on: the test shapes of shards, or of synthetic-13, rendered when they are asked for."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_whole
from lsmgeo.cameras import CameraTensors, resize, select, stack, to
from lsmgeo.data import Batch, Sample, ShardSet, collate
from lsmgeo.data.backgrounds import Background, make_background
from lsmgeo.errors import OptionError
from lsmgeo.models.training.adapting import resize_images, resize_sample

__all__ = [
    "Shapes",
    "ShardShapes",
    "SizedShapes",
    "SyntheticShapes",
    "batches",
    "open_shapes",
    "resized",
]

# What the numbers of a shape are drawn for: the order of its views, what stands behind it, the noise of its poses.
ORDER, BEHIND, NOISE = range(3)
# How many views of a synthetic shape there are to draw from, as many as `lsmgeo render` makes by default.
POOL = 20
# Of a set without an end, how many shapes are taken unless told.
SHAPES = 130


class Shapes(Protocol):
    """Shapes by number, each with views in an order that follows from the seed and its name alone."""

    @property
    def about(self) -> str:
        """Where the shapes come from, in words."""

    @property
    def categories(self) -> Sequence[str]:
        """The category of each."""

    @property
    def seed(self) -> int:
        """What orders and noise are drawn from."""

    @property
    def most_views(self) -> int:
        """The views that every shape has."""

    def __len__(self) -> int: ...

    def read(self, index: int, views: int, *, resolution: int | None, depth: bool, background: Background) -> Sample:
        """One shape with its first views.

        Args:
            index: which shape.
            views: how many.
            resolution: voxels a side of the occupancy; None for none.
            depth: whether depth is wanted.
            background: what stands behind the object.
        """


def generator_of(seed: int, name: str, use: int) -> np.random.Generator:
    """Random numbers that belong to one shape and one use, whatever else is evaluated."""
    digest = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return np.random.default_rng(np.random.SeedSequence([seed, digest, use]))


def noise_of(seed: int, name: str, run: int = 0) -> torch.Generator:
    """The same for noise that torch draws."""
    drawn = int(
        np.random.SeedSequence([int(generator_of(seed, name, NOISE).integers(2**32)), run]).generate_state(1)[0]
    )
    return torch.Generator().manual_seed(drawn)


def view_order(seed: int, name: str, there: int) -> list[int]:
    """All views of a shape in its order."""
    # The sorting of uniform numbers is the same in all versions of numpy.
    order: list[int] = np.argsort(generator_of(seed, name, ORDER).random(there), kind="stable").tolist()
    return order


@dataclass(frozen=True, eq=False)
class ShardShapes:
    """Shapes of one split of a training set.

    Args:
        shards: the set.
        indices: which of its shapes.
        seed: of the order of views.
    """

    shards: ShardSet
    indices: Sequence[int]
    seed: int

    @property
    def about(self) -> str:
        """The folder's name: where it lies says nothing in a picture."""
        return f"{len(self)} shapes of {self.shards.folder.resolve().name}"

    @property
    def categories(self) -> list[str]:
        """The category of each."""
        return [self.shards.categories[index] or "all" for index in self.indices]

    @property
    def most_views(self) -> int:
        """The views that every shape has."""
        return int(self.shards.view_counts[list(self.indices)].min())

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, index: int, views: int, *, resolution: int | None, depth: bool, background: Background) -> Sample:
        """One shape with its first views, at the set's own size."""
        shape = self.indices[index]
        name = self.shards.names[shape]
        return self.shards.read(
            shape,
            views=view_order(self.seed, name, int(self.shards.view_counts[shape]))[:views],
            depth=depth,
            occupancy=resolution,
            background=background,
            generator=generator_of(self.seed, name, BEHIND),
        )


@dataclass(frozen=True, eq=False)
class SyntheticShapes:
    """Shapes of one split of synthetic-13, rendered when they are read.

    Args:
        indices: their numbers in the set.
        size: height and width of the pictures.
        seed: of the order of views.
        split: the part of the set that they are of.
        set_seed: which set.
    """

    indices: Sequence[int]
    size: int
    seed: int
    split: str = "test"
    set_seed: int = 0
    most_views: int = POOL

    @property
    def about(self) -> str:
        """The set."""
        return f"{len(self)} {self.split} shapes of synthetic-13, rendered at {self.size} x {self.size}"

    @property
    def categories(self) -> list[str]:
        """The category of each."""
        from lsmgeo.scenes import synthetic13

        names = tuple(synthetic13.CATEGORIES)
        return [names[index % len(names)] for index in self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, index: int, views: int, *, resolution: int | None, depth: bool, background: Background) -> Sample:
        """One shape with its first views."""
        from lsmgeo import scenes
        from lsmgeo.scenes import synthetic13

        number = self.indices[index]
        shape = synthetic13.shape(self.set_seed, number)
        there = synthetic13.views(self.set_seed, number, POOL, self.size)
        order = view_order(self.seed, shape.name, POOL)[:views]
        cameras = stack([select(there, 0, view) for view in order])
        picture = scenes.render([shape.scene], stack([cameras]), shape.lights)
        behind, generator = make_background(background), generator_of(self.seed, shape.name, BEHIND)
        images = picture.images[0]
        if background != "white":
            drawn = [torch.from_numpy(behind(generator, self.size, self.size)) for _ in order]
            images = torch.where(picture.mask[0][:, None], images, torch.stack(drawn))
        return Sample(
            images,
            to(cameras, torch.float32),
            picture.depth[0] if depth else None,
            picture.mask[0],
            None if resolution is None else scenes.voxels([shape.scene], resolution)[0],
            None,
            shape.category,
            shape.name,
        )


@dataclass(frozen=True, eq=False)
class SizedShapes:
    """Shapes with pictures, silhouettes and depth at another size, as in training.

    Args:
        shapes: of any size.
        size: height and width.
    """

    shapes: Shapes
    size: int

    @property
    def about(self) -> str:
        """Where the shapes come from."""
        return self.shapes.about

    @property
    def categories(self) -> Sequence[str]:
        """The category of each."""
        return self.shapes.categories

    @property
    def most_views(self) -> int:
        """The views that every shape has."""
        return self.shapes.most_views

    @property
    def seed(self) -> int:
        """What orders are drawn from."""
        return self.shapes.seed

    def __len__(self) -> int:
        return len(self.shapes)

    def read(self, index: int, views: int, *, resolution: int | None, depth: bool, background: Background) -> Sample:
        """One shape with its first views."""
        sample = self.shapes.read(index, views, resolution=resolution, depth=depth, background=background)
        return resize_sample(sample, self.size)


def open_shapes(
    shards: str | Path | None,
    *,
    size: int,
    shapes: int | None = None,
    seed: int = 0,
    split: str = "test",
    categories: Sequence[str] | None = None,
) -> Shapes:
    """Open what is evaluated on.

    Args:
        shards: a folder of shards, or None for synthetic-13.
        size: of the pictures that are rendered; those of shards have their own.
        shapes: how many, taken from the categories in turn; by default all of the shards, or 130.
        seed: of the order of views, at least 0.
        split: the part of the set.
        categories: these alone; None for all.

    Raises:
        OptionError: no shape is left, or an option that is none.
        DataError: the shards cannot be read.
    """
    seed = check_whole("evaluate", "seed", seed, 0, 2**32 - 1)
    number = None if shapes is None else check_whole("evaluate", "shapes", shapes, 1, 10**7)
    if shards is None:
        return SyntheticShapes(_synthetic_numbers(number or SHAPES, split, categories), size, seed, split)
    there = ShardSet(shards)
    names = [category or "all" for category in there.categories]
    wanted = [
        index
        for index, (category, part) in enumerate(zip(names, there.splits, strict=True))
        if part == split and (categories is None or category in categories)
    ]
    if not wanted:
        raise OptionError(f"evaluate: no shape of {shards} is of the split {split!r} and the categories {categories}")
    return ShardShapes(there, _in_turn(wanted, [names[index] for index in wanted])[:number], seed)


def _synthetic_numbers(count: int, split: str, categories: Sequence[str] | None) -> list[int]:
    from lsmgeo.scenes import synthetic13

    names = tuple(synthetic13.CATEGORIES)
    kept = [place for place, name in enumerate(names) if categories is None or name in categories]
    if not kept:
        raise OptionError(f"evaluate: categories must be among {', '.join(names)}; got {categories}")

    def of(place: int) -> Iterator[int]:
        numbers = itertools.count(place, len(names))
        return (number for number in numbers if synthetic13.split(0, number) == split)

    turns = zip(*(of(place) for place in kept), strict=True)
    return list(itertools.islice(itertools.chain.from_iterable(turns), count))


def _in_turn(indices: Sequence[int], categories: Sequence[str]) -> list[int]:
    """Indices reordered so that the categories take turns: any first part has about as many of each."""
    rounds: dict[str, int] = {}
    keyed = []
    for index, category in zip(indices, categories, strict=True):
        rounds[category] = rounds.get(category, -1) + 1
        keyed.append((rounds[category], category, index))
    return [index for _, _, index in sorted(keyed)]


def batches(
    shapes: Shapes,
    views: int,
    batch: int,
    *,
    resolution: int | None,
    depth: bool = False,
    background: Background = "white",
    progress: bool = False,
    words: str = "evaluating",
) -> Iterator[Batch]:
    """All shapes, some at a time, with a progress bar.

    Args:
        shapes: from `open_shapes`.
        views: of each.
        batch: shapes at a time.
        resolution: voxels a side of the truth; None for none.
        depth: whether depth is wanted.
        background: what stands behind the objects.
        progress: whether to show the bar (on a terminal).
        words: what stands before the bar.
    """
    from tqdm import tqdm

    with tqdm(total=len(shapes), desc=words, unit="shape", disable=None if progress else True) as bar:
        for start in range(0, len(shapes), batch):
            some = range(start, min(start + batch, len(shapes)))
            read = [
                shapes.read(index, views, resolution=resolution, depth=depth, background=background) for index in some
            ]
            yield collate(read)
            bar.update(len(some))


def resized(images: Tensor, cameras: CameraTensors, size: int) -> tuple[Tensor, CameraTensors]:
    """Pictures (B, V, 3, H, W) and their cameras at the size that a model takes, as in training.

    Args:
        images: of any size.
        cameras: leading shape (B, V).
        size: height and width.
    """
    if tuple(images.shape[-2:]) == (size, size):
        return images, cameras
    return resize_images(images.flatten(0, 1), size).unflatten(0, images.shape[:2]), resize(cameras, size, size)
