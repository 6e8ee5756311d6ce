"""The shapes that models are tested on: those of shards, or of synthetic-13, rendered on demand."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from lsmgeo._checks import check_whole
from lsmgeo.data import Batch, Sample, ShardSet, collate
from lsmgeo.data.shards.background_sources import Background
from lsmgeo.data.shards.shape_sets import ShapeSet, SyntheticSet, synthetic_numbers
from lsmgeo.data.shards.shape_transforms import resize_sample
from lsmgeo.errors import OptionError
from lsmgeo.scenes import synthetic13

__all__ = ["Shapes", "batches", "generator_of", "noise_of", "open_shapes"]

# The uses of the random numbers of a shape: the order of its views, its background, the noise of its poses.
ORDER, BACKGROUND, NOISE = range(3)
# The default number of shapes of an endless set.
SHAPES = 130


def generator_of(seed: int, name: str, use: int) -> np.random.Generator:
    """Random numbers for one shape and one use; they do not depend on the other shapes."""
    digest = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return np.random.default_rng(np.random.SeedSequence([seed, digest, use]))


def noise_of(seed: int, name: str) -> torch.Generator:
    """The same for the noise of poses, which torch draws."""
    drawn = int(np.random.SeedSequence([int(generator_of(seed, name, NOISE).integers(2**32)), 0]).generate_state(1)[0])
    return torch.Generator().manual_seed(drawn)


def view_order(seed: int, name: str, there: int) -> list[int]:
    """All views of a shape in a random order."""
    # The sorting of uniform numbers is the same in all versions of numpy.
    order: list[int] = np.argsort(generator_of(seed, name, ORDER).random(there), kind="stable").tolist()
    return order


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes by number, each with its views in an order that depends only on the seed and its name.

    Attributes:
        source: the set of shapes.
        indices: the shapes of the set that are used.
        seed: of orders and noise.
        about: a description for reports.
        size: height and width of images, silhouettes and depth, as in training; None for those of the set.
    """

    source: ShapeSet
    indices: Sequence[int]
    seed: int
    about: str
    size: int | None = None

    @property
    def categories(self) -> list[str]:
        """The category of each shape."""
        categories = self.source.categories
        return [categories[index] or "all" for index in self.indices]

    @property
    def most_views(self) -> int:
        """The number of views that every shape has at least."""
        return int(self.source.view_counts[list(self.indices)].min())

    def __len__(self) -> int:
        return len(self.indices)

    def at(self, size: int) -> Shapes:
        """The same shapes with images of another height and width."""
        return replace(self, size=size)

    def read(self, index: int, views: int, *, resolution: int | None, depth: bool, background: Background) -> Sample:
        """One shape with its first views.

        Args:
            index: the number of the shape.
            views: the number of views.
            resolution: voxels along a side of the occupancy; None to leave it out.
            depth: whether to read depth.
            background: the background of the object.
        """
        shape = self.indices[index]
        name = self.source.names[shape]
        sample = self.source.read(
            shape,
            views=view_order(self.seed, name, int(self.source.view_counts[shape]))[:views],
            depth=depth,
            occupancy=resolution,
            background=background,
            generator=generator_of(self.seed, name, BACKGROUND),
        )
        return sample if self.size is None else resize_sample(sample, self.size)


def open_shapes(
    shards: str | Path | None,
    *,
    size: int,
    shapes: int | None = None,
    seed: int = 0,
    split: str = "test",
    categories: Sequence[str] | None = None,
) -> Shapes:
    """Open the shapes to test on.

    Args:
        shards: a folder of shards, or None for synthetic-13.
        size: of rendered images; those of shards keep theirs.
        shapes: their number, taken from the categories in turn; by default all of the shards, or 130.
        seed: of the order of views, at least 0.
        split: the part of the set.
        categories: only these; None for all.

    Raises:
        OptionError: no shape is left, or an invalid option.
        DataError: the shards cannot be read.
    """
    seed = check_whole("evaluate", "seed", seed, 0, 2**32 - 1)
    number = None if shapes is None else check_whole("evaluate", "shapes", shapes, 1, 10**7)
    if shards is None:
        numbers = _synthetic_numbers(number or SHAPES, split, categories)
        about = f"{len(numbers)} {split} shapes of synthetic-13, rendered at {size} x {size}"
        return Shapes(SyntheticSet(numbers, size), range(len(numbers)), seed, about)
    there = ShardSet(shards)
    names = [category or "all" for category in there.categories]
    wanted = [
        index
        for index, (category, part) in enumerate(zip(names, there.splits, strict=True))
        if part == split and (categories is None or category in categories)
    ]
    if not wanted:
        raise OptionError(f"evaluate: no shape of {shards} is of the split {split!r} and the categories {categories}")
    taken = _in_turn(wanted, [names[index] for index in wanted])[:number]
    # The name without the path, which says nothing in a figure.
    return Shapes(there, taken, seed, f"{len(taken)} shapes of {there.folder.resolve().name}")


def _synthetic_numbers(count: int, split: str, categories: Sequence[str] | None) -> list[int]:
    synthetic_numbers(split, categories)  # raises on an unknown category
    kept = [name for name in synthetic13.CATEGORIES if categories is None or name in categories]
    turns = zip(*(synthetic_numbers(split, (name,)) for name in kept), strict=True)
    return list(itertools.islice(itertools.chain.from_iterable(turns), count))


def _in_turn(indices: Sequence[int], categories: Sequence[str]) -> list[int]:
    """Indices reordered so that the categories alternate: any first part has about as many of each."""
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
) -> Iterator[Batch]:
    """All shapes in batches of ``batch``, read as `Shapes.read` does, with a progress bar on a terminal."""
    from tqdm import tqdm

    with tqdm(total=len(shapes), desc="evaluating", unit="shape", disable=None if progress else True) as bar:
        for start in range(0, len(shapes), batch):
            some = range(start, min(start + batch, len(shapes)))
            read = [
                shapes.read(index, views, resolution=resolution, depth=depth, background=background) for index in some
            ]
            yield collate(read)
            bar.update(len(some))
