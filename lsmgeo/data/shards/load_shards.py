"""Shapes for a training run: which of them, in which order, with which of their views.

Every random choice comes from ``SeedSequence([seed, epoch, index])``, not from a state that advances: the samples are
the same for any number of workers, and a run resumes from three integers (epoch, position, seed).
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from torch.utils.data import Dataset, Sampler

from lsmgeo._checks import check_choice, check_flag, check_number, check_whole, describe, is_whole
from lsmgeo.data.sample import Sample
from lsmgeo.data.shards.background_sources import Background, BackgroundError, make_background
from lsmgeo.data.shards.shape_sets import ShapeSet
from lsmgeo.errors import DataError, OptionError

__all__ = ["EpochSampler", "ShapeDataset"]

SUBSTITUTES = 16  # shapes tried in place of a bad one


class ShapeDataset(Dataset[Sample]):
    """The shapes of shards as a map-style data set, with other views in each epoch.

    An item is ``dataset[(epoch, index)]``, the pair that `EpochSampler` yields; ``dataset[index]`` is of epoch 0. It
    depends only on seed, epoch and index.

    A shape that cannot be read raises a `DataError` that names its shard (in a loader's worker a ``RuntimeError`` with
    its text). With ``on_error="skip"`` another shape replaces it, drawn by a hash of seed, epoch and index, and a line
    is added to `bad_samples`; if more than `max_bad_fraction` of the data set is bad, the error is raised. Each process
    counts only the bad shapes that it met: with W workers up to W times as many may be bad. A background image that
    cannot be used always raises.

    Args:
        shards: the shapes.
        views: how many different views of a shape, in random order; (low, high) for a random number of them, both
            included; None for all in order.
        seed: of views and backgrounds, at least 0.
        depth: whether to read depth.
        occupancy: the resolution of the occupancy to read, or None for none.
        background: see `ShardSet.read`.
        categories: use only shapes of these categories.
        split: use only shapes of this split.
        on_error: "raise" or "skip"; "skip" is for training, since it changes the shapes that an evaluation averages.
        max_bad_fraction: the largest fraction of bad shapes with "skip".
        bad_samples: the file of JSON lines for "skip"; by default ``bad_samples.jsonl`` beside the shards.

    Raises:
        OptionError: an invalid option, or no shape is left.
        DataError: a shape has too few views, or the folder of backgrounds cannot be read.

    Example:
        >>> import tempfile, torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.data import ShardSet, collate, encode_sample, write_shard
        >>> cameras = orbit(torch.zeros(5), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        >>> sample = Sample(torch.rand(5, 3, 48, 48), cameras, None, None, None, None, "chair", "chair-0")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = write_shard(f"{folder}/set-000000.tar", [(0, encode_sample(sample, 0))], "made by hand")
        ...     dataset = ShapeDataset(ShardSet(folder), views=(1, 4), depth=False, occupancy=None)
        ...     loader = torch.utils.data.DataLoader(
        ...         dataset, 1, sampler=EpochSampler(len(dataset), seed=0), collate_fn=collate
        ...     )
        ...     [batch.name for batch in loader]
        [('chair-0',)]
    """

    def __init__(
        self,
        shards: ShapeSet,
        *,
        views: int | tuple[int, int] | None = 4,
        seed: int = 0,
        depth: bool = True,
        occupancy: int | None = 32,
        background: Background = "white",
        categories: Collection[str] | None = None,
        split: str | None = None,
        on_error: str = "raise",
        max_bad_fraction: float = 0.001,
        bad_samples: str | os.PathLike[str] | None = None,
    ) -> None:
        self.shards = shards
        self.views = _view_range(views)
        self.seed = check_whole("ShapeDataset", "seed", seed, 0)
        self.depth = check_flag("ShapeDataset", "depth", depth)
        self.occupancy = occupancy
        self.background = make_background(background)
        self.on_error = check_choice("ShapeDataset", "on_error", on_error, ("raise", "skip"))
        self.max_bad_fraction = check_number(
            "ShapeDataset", "max_bad_fraction", max_bad_fraction, "a share in [0, 1]", 0, 1
        )
        self.bad_samples = Path(bad_samples if bad_samples is not None else shards.folder / "bad_samples.jsonl")
        self.indices = _filtered(shards, categories, split)
        self._bad: set[int] = set()
        counts = shards.view_counts[self.indices]
        if self.views is not None and counts.min() < self.views[1]:
            index = int(self.indices[counts.argmin()])
            reason = f"{shards.names[index]} has {counts.min()} views; {self.views[1]} are asked for"
            raise DataError(shards.path(index), reason)

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def names(self) -> list[str]:
        """The names of the shapes, in the order of their indices."""
        return [self.shards.names[index] for index in self.indices.tolist()]

    def __getitem__(self, item: int | tuple[int, int]) -> Sample:
        pair = item if isinstance(item, (tuple, list)) else (0, item)
        if len(pair) != 2:
            raise OptionError(f"ShapeDataset: an item is an index or (epoch, index); got {describe(item)}")
        epoch, index = pair
        if not is_whole(index) or not 0 <= index < len(self):
            if is_whole(index):  # ends Python's iteration over the data set
                raise IndexError(f"ShapeDataset: index must be from 0 to {len(self) - 1}; got {index}")
            raise OptionError(f"ShapeDataset: an item is an index or (epoch, index); got {describe(item)}")
        epoch, index = check_whole("ShapeDataset", "epoch", epoch, 0), int(index)
        for attempt in range(SUBSTITUTES + 1):
            drawn = np.random.SeedSequence([self.seed, epoch, index, attempt]).generate_state(1, np.uint64)
            place = int(drawn[0]) % len(self) if attempt else index
            if attempt and place == index:
                continue
            try:
                return self._read(epoch, place, attempt)
            except DataError as error:
                if self.on_error == "raise" or isinstance(error, BackgroundError):
                    raise
                self._report(epoch, place, error)
        raise DataError(
            self.shards.folder, f"found no shape in the place of {self.names[index]} in {SUBSTITUTES} tries"
        )

    def _read(self, epoch: int, index: int, attempt: int) -> Sample:
        shape = int(self.indices[index])
        generator = np.random.default_rng(np.random.SeedSequence([self.seed, epoch, index, attempt]))
        chosen = None
        if self.views is not None:
            # Only uniform numbers are drawn: other distributions may differ between versions of numpy.
            low, high = self.views
            count = low + int(generator.random() * (high - low + 1))
            order = np.argsort(generator.random(int(self.shards.view_counts[shape])), kind="stable")
            chosen = order[:count].tolist()
        return self.shards.read(
            shape,
            views=chosen,
            depth=self.depth,
            occupancy=self.occupancy,
            background=self.background,
            generator=generator,
        )

    def _report(self, epoch: int, index: int, error: DataError) -> None:
        """Note a bad shape, once in each process; too many raise."""
        if index not in self._bad:
            self._bad.add(index)
            name = self.shards.names[int(self.indices[index])]
            line = {"name": name, "index": index, "epoch": epoch, "path": str(error.path), "reason": error.reason}
            try:
                # One short line in one call, so that lines of several processes do not mix.
                with self.bad_samples.open("ab", buffering=0) as stream:
                    stream.write(json.dumps(line).encode() + b"\n")
            except OSError as cause:
                raise DataError(self.bad_samples, f"cannot be written ({cause})") from error
        if len(self._bad) > self.max_bad_fraction * len(self):
            raise DataError(
                error.path,
                f"{error.reason}; with this, {len(self._bad)} of {len(self)} shapes are bad, more than the "
                f"{self.max_bad_fraction:g} that max_bad_fraction allows (see {self.bad_samples})",
            ) from error


class EpochSampler(Sampler[tuple[int, int]]):
    """The order of a data set's items, different in each epoch, from any position on; yields (epoch, index).

    The order follows from seed and epoch. `position` counts the samples of this epoch that all ranks together have
    consumed: a run resumed at a position sees the samples that an uninterrupted run would have seen, also with another
    number of workers or processes. Workers prefetch, so the training loop counts and sets the position.

    All ranks get equally many samples: if the rest of an epoch does not divide, its first samples are repeated at the
    end (at most ``world_size - 1`` of them). A set that must be read exactly once is read by one rank.

    Args:
        length: the number of items.
        seed: of the orders, at least 0.
        epoch: at least 0.
        position: the first sample of the epoch; at its end or beyond, the epoch is empty.
        rank: of this process.
        world_size: the number of processes.
        shuffle: False for 0, 1, 2, ... in every epoch.

    Raises:
        OptionError: an invalid option.

    Example:
        >>> sampler = EpochSampler(5, seed=0, shuffle=False, rank=1, world_size=2)
        >>> list(sampler)
        [(0, 1), (0, 3), (0, 0)]
        >>> sampler.load_state_dict({"epoch": 3, "position": 2, "seed": 0})
        >>> list(sampler)
        [(3, 3), (3, 0)]
    """

    def __init__(
        self,
        length: int,
        *,
        seed: int,
        epoch: int = 0,
        position: int = 0,
        rank: int = 0,
        world_size: int = 1,
        shuffle: bool = True,
    ) -> None:
        self.length = check_whole("EpochSampler", "length", length, 1)
        self.world_size = check_whole("EpochSampler", "world_size", world_size, 1)
        self.rank = check_whole("EpochSampler", "rank", rank, 0)
        if self.rank >= self.world_size:
            raise OptionError(f"EpochSampler: rank must be below world_size = {world_size}; got {rank}")
        self.shuffle = check_flag("EpochSampler", "shuffle", shuffle)
        self.load_state_dict({"epoch": epoch, "position": position, "seed": seed})

    def set_epoch(self, epoch: int, position: int = 0) -> None:
        """Set the epoch and the position at which the next iteration begins.

        Args:
            epoch: at least 0.
            position: samples of the epoch that all ranks together have consumed.
        """
        self.epoch = check_whole("EpochSampler", "epoch", epoch, 0)
        self.position = check_whole("EpochSampler", "position", position, 0)

    def state_dict(self) -> dict[str, int]:
        """Epoch, position and seed, as last set."""
        return {"epoch": self.epoch, "position": self.position, "seed": self.seed}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Restore a state; length, rank and world size are unchanged. An OptionError for an invalid number."""
        self.seed = check_whole("EpochSampler", "seed", state["seed"], 0)
        self.set_epoch(state["epoch"], state["position"])

    def order(self, epoch: int) -> np.ndarray:
        """All indices in the order of an epoch, (length,) int64."""
        if not self.shuffle:
            return np.arange(self.length)
        # Sorting uniform numbers gives the same order in all versions of numpy; its permutations may not.
        epoch = check_whole("EpochSampler", "epoch", epoch, 0)
        generator = np.random.default_rng(np.random.SeedSequence([self.seed, epoch]))
        return np.argsort(generator.random(self.length), kind="stable")

    def __len__(self) -> int:
        return -(-max(0, self.length - self.position) // self.world_size)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, count = self.epoch, len(self)
        order = self.order(epoch)
        wanted = np.arange(self.position, self.position + count * self.world_size) % self.length
        for index in order[wanted][self.rank :: self.world_size].tolist():
            yield epoch, index


def _view_range(views: int | tuple[int, int] | None) -> tuple[int, int] | None:
    if views is None:
        return None
    pair = [views, views] if is_whole(views) else list(views) if isinstance(views, (tuple, list)) else []
    if len(pair) != 2:
        raise OptionError(f"ShapeDataset: views must be a number, (low, high) or None; got {describe(views)}")
    low, high = (check_whole("ShapeDataset", "views", value, 1) for value in pair)
    if low > high:
        raise OptionError(f"ShapeDataset: views must be (low, high), low <= high; got {describe(views)}")
    return low, high


def _filtered(shards: ShapeSet, categories: Collection[str] | None, split: str | None) -> np.ndarray:
    """The indices of the selected shapes, ascending."""
    wanted = np.ones(len(shards), bool)
    if isinstance(categories, str):
        categories = (categories,)
    for field, have, keep in (
        ("categories", shards.categories, categories),
        ("split", shards.splits, None if split is None else (split,)),
    ):
        if keep is not None:
            missing = sorted(set(map(str, keep)) - set(filter(None, have)))
            if missing or not keep:
                there = ", ".join(sorted(set(filter(None, have)))) or "none"
                raise OptionError(f"ShapeDataset: {field}: no shape is of {missing}; the shards have {there}")
            wanted &= np.array([value in keep for value in have])
    if not wanted.any():
        raise OptionError(f"ShapeDataset: no shape is of categories {categories} and split {split!r}")
    return np.flatnonzero(wanted)
