"""Random access to shards: only the requested members of a shape are read."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lsmgeo._checks import check_flag, describe, is_whole
from lsmgeo.data.images import DEPTH, RGBA, PngKind, decode_png
from lsmgeo.data.read_files import path_inside
from lsmgeo.data.sample import Sample
from lsmgeo.data.shards.background_sources import Background, BackgroundError, make_background
from lsmgeo.data.shards.shard_index import ShardFile, ShardIndex, read_index
from lsmgeo.data.shards.shard_members import decode_occupancy
from lsmgeo.data.shards.shard_metadata import Metadata, decode_metadata
from lsmgeo.errors import DataError, OptionError

__all__ = ["ShardSet"]

OPEN_FILES = 128
# Of all images of one call: images of one colour compress a thousandfold, so a small tar may exceed all memory.
MAX_PIXELS_AT_ONCE = 1 << 28


class ShardSet:
    """The shapes of all shards (``*.tar``) of a folder, in the order of their names.

    The headers of the tars and the check sums of existing sidecars are read once, when the set is opened. Files are
    opened when first read, and reads share no file position, so the set may be used from several threads, in forked
    processes, and through pickle.

    Args:
        folder: of the shards.

    Raises:
        DataError: no such folder, no shard in it, a damaged one, or two shapes of one name.

    Attributes:
        folder: as given.
        names: of the N shapes.
        categories: of the shapes, or None.
        splits: of the shapes, or None.
        view_counts: (N,) number of views of each shape.

    Example:
        >>> import tempfile, torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.data import Sample, encode_sample, write_shard
        >>> cameras = orbit(torch.tensor([0.0, 90.0]), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        >>> sample = Sample(torch.rand(2, 3, 48, 48), cameras, None, None, None, None, "chair", "chair-0")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = write_shard(f"{folder}/set-000000.tar", [(0, encode_sample(sample, 0))], "made by hand")
        ...     shards = ShardSet(folder)
        ...     one = shards.read(0, views=[1], depth=False, occupancy=None)
        >>> len(shards), one.name, tuple(one.images.shape)
        (1, 'chair-0', (1, 3, 48, 48))
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        try:
            names = sorted(name for name in os.listdir(self.folder) if name.endswith(".tar") and name[0] != ".")
        except (OSError, ValueError) as error:
            raise DataError(folder, f"cannot be read ({error})") from error
        if not names:
            raise DataError(folder, "holds no shard (*.tar)")
        self._shards = [read_index(path_inside(self.folder, name, self.folder)) for name in names]
        self._ends = np.cumsum([len(shard) for shard in self._shards]).tolist()
        self.names = [name for shard in self._shards for name in shard.names]
        self.categories = [category for shard in self._shards for category in shard.categories]
        self.splits = [split for shard in self._shards for split in shard.splits]
        self.view_counts = np.concatenate([shard.view_counts() for shard in self._shards])
        self._open: dict[Path, ShardFile] = {}
        if len(set(self.names)) != len(self.names):
            seen: set[str] = set()
            name = next(name for name in self.names if name in seen or seen.add(name))  # type: ignore[func-returns-value]
            both = [shard.path.name for shard in self._shards if name in shard.names]
            raise DataError(folder, f"two shapes are named {name!r}, in {both[0]} and {both[-1]}")

    def __repr__(self) -> str:
        return f"ShardSet({str(self.folder)!r}, {len(self)} shapes)"

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def _locate(self, index: int) -> tuple[ShardIndex, int]:
        """The shard of a shape, and its row in the shard."""
        if not is_whole(index) or not 0 <= index < len(self):
            raise OptionError(f"ShardSet: index must be an integer from 0 to {len(self) - 1}; got {describe(index)}")
        number = bisect_right(self._ends, int(index))
        return self._shards[number], int(index) - (self._ends[number - 1] if number else 0)

    def path(self, index: int) -> Path:
        """The tar file of a shape."""
        return self._locate(index)[0].path

    def metadata(self, index: int) -> Metadata:
        """The content of a shape's json; an OptionError for an index out of range, a DataError if it is damaged."""
        shard, row = self._locate(index)
        metadata = decode_metadata(self._fetch(shard, row, "json"), shard.keys[row], shard.path)
        if metadata.name != shard.names[row]:
            raise DataError(shard.path, f"{shard.keys[row]}.json has changed since it was opened")
        if len(metadata.intrinsics) != self.view_counts[index]:
            reason = f"states {len(metadata.intrinsics)} views; the shard holds {self.view_counts[index]}"
            raise DataError(shard.path, f"{shard.keys[row]}.json: {reason}")
        return metadata

    def read(
        self,
        index: int,
        *,
        views: Sequence[int] | None = None,
        depth: bool = True,
        occupancy: int | None = 32,
        background: Background = "white",
        generator: np.random.Generator | None = None,
    ) -> Sample:
        """Read a shape, or some views of it.

        Args:
            index: of the shape.
            views: of the shape, in this order; None for all.
            depth: whether to read depth.
            occupancy: the resolution of the occupancy to read, or None for none.
            background: "white", an RGB colour in [0, 1], "random" or a folder of images; the last two are drawn anew
                for each view.
            generator: of random backgrounds.

        Returns:
            The sample: float32 cameras, the mask where the images' alpha is above 127.

        Raises:
            OptionError: an index or a view out of range, or an invalid option.
            DataError: the shard lacks the depth or occupancy, is damaged, or has more than 2^28 pixels in these views;
                or an image of the folder of backgrounds cannot be used.
        """
        shard, row = self._locate(index)
        key, metadata = shard.keys[row], self.metadata(index)
        source = make_background(background)
        chosen = _views(views, int(self.view_counts[index]))
        height, width = metadata.size
        if len(chosen) * height * width > MAX_PIXELS_AT_ONCE:
            raise DataError(
                shard.path,
                f"{key}: {len(chosen)} views of {height} x {width} are more than the "
                f"{MAX_PIXELS_AT_ONCE} pixels that one call may read; read fewer views",
            )
        # Images are decoded before arrays of their size are allocated, since a damaged json may state any size.
        rgba = [self._read_png(shard, row, f"{view:02d}.png", RGBA, metadata) for view in chosen]
        images = np.empty((len(chosen), 3, *metadata.size), np.float32)
        masks = np.empty((len(chosen), *metadata.size), np.bool_)
        for image, mask, pixels in zip(images, masks, rgba, strict=True):
            try:
                behind = source(generator, height, width)
            except DataError as error:
                raise BackgroundError(error.path, error.reason) from error
            _composite(image, mask, pixels, behind)
        depths = grid = None
        if check_flag("ShardSet.read", "depth", depth):
            if metadata.depth_step is None:
                raise DataError(shard.path, f"{key} has no depth; read it with depth=False")
            steps = [self._read_png(shard, row, f"{view:02d}.depth.png", DEPTH, metadata) for view in chosen]
            depths = torch.from_numpy(np.stack(steps).astype(np.float32) * np.float32(metadata.depth_step))
        if occupancy is not None:
            if occupancy not in metadata.voxels or isinstance(occupancy, bool):
                stored = ", ".join(map(str, metadata.voxels)) or "none"
                raise DataError(shard.path, f"{key} has no occupancy of {describe(occupancy)} voxels; it has {stored}")
            content = self._fetch(shard, row, f"vox{occupancy}.npy")
            grid = torch.from_numpy(decode_occupancy(content, occupancy, shard.path, f"{key}.vox{occupancy}.npy"))
        return Sample(
            torch.from_numpy(images),
            metadata.cameras(chosen),
            depths,
            torch.from_numpy(masks),
            grid,
            metadata.mesh,
            metadata.category,
            metadata.name,
        )

    def _read_png(self, shard: ShardIndex, row: int, suffix: str, kind: PngKind, metadata: Metadata) -> np.ndarray:
        content = self._fetch(shard, row, suffix)
        return decode_png(content, metadata.size, kind, shard.path, f"{shard.keys[row]}.{suffix}")

    def _fetch(self, shard: ShardIndex, row: int, suffix: str) -> bytes:
        tar = self._open.get(shard.path)
        if tar is None:
            if len(self._open) >= OPEN_FILES:  # a file is closed after its last reader
                self._open.clear()
            tar = self._open[shard.path] = ShardFile(shard.path, shard.size)
        return shard.read(tar, row, suffix)


def _views(views: Sequence[int] | None, there: int) -> Sequence[int]:
    if views is None:
        return range(there)
    try:
        chosen = [int(view) for view in views if not isinstance(view, bool) and int(view) == view]
    except (TypeError, ValueError):
        chosen = []
    if not chosen or len(chosen) != len(views) or not all(0 <= view < there for view in chosen):
        raise OptionError(f"ShardSet.read: views must be numbers from 0 to {there - 1}; got {describe(views)}")
    return chosen


def _composite(image: np.ndarray, mask: np.ndarray, rgba: np.ndarray, background: np.ndarray) -> None:
    """Fill (3, H, W) with the colours of an RGBA image where its alpha is above 127, else with the background."""
    planes = np.ascontiguousarray(rgba.transpose(2, 0, 1))
    np.greater(planes[3], 127, out=mask)
    np.divide(planes[:3], np.float32(255), out=image, dtype=np.float32)
    np.copyto(image, background, where=~mask)
