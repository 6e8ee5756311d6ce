"""Batches for training and evaluation: from shards, or from synthetic shapes rendered on the device that trains.

A sample is a function of (seed, epoch, index) only, not of workers or of what was read before.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lsmgeo._torch_compat import tree_map
from lsmgeo.data import Batch, EpochSampler, ShapeDataset, ShardSet, collate
from lsmgeo.data.shards.shape_sets import ShapeSet, SyntheticSet, render_batch, synthetic_numbers
from lsmgeo.data.shards.shape_transforms import TransformedShapes
from lsmgeo.errors import OptionError
from lsmgeo.training.config import DataConfig
from lsmgeo.training.launch import ignore_stop

__all__ = ["Need", "Shapes", "endless_order", "open_shapes", "training_batches", "validation_batches"]


class Need(NamedTuple):
    """What the training of a model needs besides images and cameras."""

    image_size: int
    voxels: int | None  # a side of the occupancy, or None
    depth: bool


@dataclass(frozen=True)
class Shapes:
    """A split of a set: a data set of (epoch, index), and the function that makes a batch of its items.

    Attributes:
        dataset: of items for `collate`.
        collate: makes a batch; in a worker, unless `on_device`.
        identity: a hash of the shapes and their order.
        on_device: whether `collate` renders on the model's device.
    """

    dataset: Dataset[Any]
    collate: Callable[[Sequence[Any]], Batch]
    identity: str
    on_device: bool = False

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]


def open_shapes(
    config: DataConfig,
    need: Need,
    *,
    seed: int,
    device: torch.device,
    views: int | None = None,
    is_training: bool,
    folder: Path | None = None,
) -> Shapes:
    """Open the split of a set for training or for evaluation.

    Args:
        config: of the data.
        need: what the model needs of a shape.
        seed: of views, backgrounds and noise.
        device: where synthetic shapes are rendered.
        views: how many views of each shape; by default those of the configuration.
        is_training: training takes `split`, `categories` and pose noise; evaluation `validation_split` and
            `validation_categories`, skips no shapes and adds no pose noise.
        folder: of the run, where ``bad_samples.jsonl`` lists the skipped shapes; by default beside the shards.

    Raises:
        OptionError: the shards hold no shape of this kind, no depth or no voxels of this resolution.
        DataError: the shards cannot be read, or have fewer views.
    """
    if is_training:
        split, categories = config.split, config.categories
    else:
        split = config.validation_split
        categories = config.categories if config.validation_categories is None else config.validation_categories
    names = categories_of(categories)
    found: ShapeSet
    part: dict[str, Any]
    if config.source == "synthetic-13":
        found, part = _synthetic(config, need, split, names), {}
    else:
        found, part = ShardSet(config.source), {"categories": names, "split": split}
        _check_content(found, need)
    dataset = ShapeDataset(
        found,
        views=config.views if views is None else views,
        seed=seed,
        depth=need.depth,
        occupancy=need.voxels,
        background=config.background,
        on_error=config.on_error if is_training else "raise",
        max_bad_fraction=config.max_bad_fraction,
        bad_samples=None if folder is None else folder / "bad_samples.jsonl",
        **part,
    )
    length = len(dataset) if config.limit is None else min(config.limit, len(dataset))
    noise = config.pose_noise if is_training else 0.0
    adapted = TransformedShapes(dataset, need.image_size, noise, seed, length)
    if isinstance(found, SyntheticSet):
        on_device = device.type != "cpu"
        render = partial(render_batch, depth=need.depth, device=device, at_once=on_device)
        identifiers = [f"{found.seed}/{found.pool}/{number}" for number in found.numbers]
        return Shapes(adapted, render, _identity(identifiers), on_device)
    return Shapes(adapted, collate, _identity(dataset.names[:length]))


def _synthetic(config: DataConfig, need: Need, split: str, categories: Sequence[str] | None) -> SyntheticSet:
    """The shapes of one split of a finite set, which are rendered as batches."""
    endless = synthetic_numbers(split, categories, config.set_seed)
    below = itertools.takewhile(lambda number: number < config.shapes, endless)
    numbers = list(itertools.islice(below, config.limit))
    if not numbers:
        raise OptionError(
            f"data: none of {config.shapes} shapes of synthetic-13 is of split {split!r}, categories {categories}"
        )
    return SyntheticSet(numbers, need.image_size, config.set_seed, config.pool, is_rendered=False)


def categories_of(wanted: str | Sequence[str]) -> tuple[str, ...] | None:
    """The categories of "all" (None), "first", "second", a name or several."""
    from lsmgeo.scenes.synthetic13 import CLASS_SPLITS

    if wanted == "all":
        return None
    if isinstance(wanted, str):
        return CLASS_SPLITS.get(wanted, (wanted,))
    return tuple(wanted)


def _check_content(shards: ShardSet, need: Need) -> None:
    """Check before the first step that shards have what the training needs."""
    first = shards.metadata(0)
    if need.depth and first.depth_step is None:
        raise OptionError(
            f"data: source has no depth, which the model needs: {shards.folder} "
            "(lsmgeo render writes it, unless --no_depth)"
        )
    if need.voxels is not None and need.voxels not in first.voxels:
        known = ", ".join(map(str, first.voxels)) or "none"
        raise OptionError(
            f"data: source has no voxels at the model's resolution {need.voxels}: {shards.folder} has {known} "
            f"(lsmgeo render --voxels {need.voxels} makes them)"
        )
    if min(first.size) < need.image_size:
        warnings.warn(
            f"images of {min(first.size)} pixels are enlarged to the {need.image_size} of the model, which expects "
            f"more detail; lsmgeo render --size {need.image_size} makes them",
            stacklevel=4,
        )


def _identity(names: Sequence[str]) -> str:
    return hashlib.sha256(json.dumps(list(names)).encode()).hexdigest()[:16]


def endless_order(
    length: int, *, seed: int, start: int, batch: int, rank: int = 0, processes: int = 1
) -> Iterator[list[tuple[int, int]]]:
    """The endless batches of one process of a run, as (epoch, index) from sample `start` of all processes on.

    Every epoch has its own order. A batch may hold the end of one epoch and the start of the next, so that every step
    takes equally many of the `length` shapes.

    Example:
        >>> stream = endless_order(3, seed=0, start=0, batch=2, rank=1, processes=2)
        >>> [epoch for epoch, _ in next(stream)], [epoch for epoch, _ in next(stream)]
        ([0, 1], [1, 2])
    """
    sampler = EpochSampler(length, seed=seed)
    epoch, order = -1, np.empty(0, np.int64)
    for first in itertools.count(start + rank, batch * processes):
        items = []
        for place in range(first, first + batch * processes, processes):
            if place // length != epoch:
                epoch = place // length
                order = sampler.order(epoch)
            items.append((epoch, int(order[place % length])))
        yield items


def training_batches(
    shapes: Shapes, *, seed: int, start: int, batch: int, workers: int, device: torch.device, rank: int, processes: int
) -> Generator[Batch, None, None]:
    """Endless batches for training, on the device. Close them: their workers ignore SIGTERM.

    Args:
        shapes: of `open_shapes`.
        seed: of the order.
        start: samples that all processes together have taken before.
        batch: samples of a batch.
        workers: processes that prefetch; 0 reads in this process when a batch is needed.
        device: of the batches.
        rank: of this process.
        processes: how many there are.
    """
    order = endless_order(len(shapes), seed=seed, start=start, batch=batch, rank=rank, processes=processes)
    return _batches(shapes, order, workers, device)


def validation_batches(
    shapes: Shapes,
    *,
    seed: int,
    count: int,
    batch: int,
    device: torch.device,
    workers: int = 0,
    rank: int = 0,
    processes: int = 1,
) -> Generator[Batch, None, None]:
    """Batches of at most `count` shapes, always the same with the same views, each in one process.

    Close them too; the other arguments are those of `training_batches`.
    """
    order = EpochSampler(len(shapes), seed=seed).order(0)[:count][rank::processes].tolist()
    chunks = [[(0, index) for index in order[first : first + batch]] for first in range(0, len(order), batch)]
    return _batches(shapes, chunks, workers, device)


def _batches(shapes: Shapes, order: Iterable[Any], workers: int, device: torch.device) -> Generator[Batch, None, None]:
    loader = DataLoader(
        shapes.dataset,
        batch_sampler=order,
        num_workers=workers,
        collate_fn=list if shapes.on_device else shapes.collate,
        worker_init_fn=ignore_stop,
        pin_memory=device.type == "cuda" and not shapes.on_device,
        # Its own: the loader draws a seed for its workers, which must not change the run's random numbers.
        generator=torch.Generator(),
    )
    for items in loader:
        yield shapes.collate(items) if shapes.on_device else to_device(items, device)


def to_device(batch: Batch, device: torch.device) -> Batch:
    """A batch with its tensors on a device, and its names as tuples again."""
    moved = tree_map(lambda x: x.to(device, non_blocking=True) if isinstance(x, Tensor) else x, batch)
    return moved._replace(mesh=tuple(batch.mesh), category=tuple(batch.category), name=tuple(batch.name))
