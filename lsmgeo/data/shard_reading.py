"""Random access to shards: of one shape only the members that are asked for are read."""

from __future__ import annotations

import os
import stat
import zlib
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lsmgeo._checks import check_flag, describe, is_whole
from lsmgeo.data.backgrounds import Background, BackgroundError, make_background
from lsmgeo.data.files import child
from lsmgeo.data.members import decode_depth, decode_occupancy, decode_picture
from lsmgeo.data.metadata import Metadata, decode_metadata
from lsmgeo.data.sample import Sample
from lsmgeo.data.shard_index import BLOCK, ShardIndex, open_index
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from lsmgeo.data.shard_index import Member

__all__ = ["ShardSet"]

OPEN_FILES = 128
# Of all pictures of one call. Flat pictures pack a thousandfold: small tars may hold more than any memory does.
MAX_PIXELS_AT_ONCE = 1 << 28


class ShardSet:
    """The shapes of all shards (``*.tar``) of a folder, in the order of their names.

    The indices are read once, at opening; a shard without a sidecar is indexed from its tar's headers. Files are opened
    when they are first read and at no common position, so the set may be used from several threads, and in processes
    forked from this one or sent it by pickle.

    Args:
        folder: where the shards lie.

    Raises:
        DataError: no such folder, no shard in it, a damaged index, or a name that two shapes have.

    Attributes:
        folder: as given.
        names: of the N shapes.
        categories: of the shapes, None where one has none.
        splits: of the shapes, likewise.
        view_counts: (N,) how many views each has.

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
            names = sorted(entry.name for entry in os.scandir(self.folder) if _is_shard(entry.name))
        except (OSError, ValueError) as error:
            raise DataError(folder, f"cannot be read ({error})") from error
        if not names:
            raise DataError(folder, "holds no shard (*.tar)")
        self._shards = [open_index(child(self.folder, name, self.folder)) for name in names]
        self._ends = np.cumsum([len(shard) for shard in self._shards]).tolist()
        self.names = [name for shard in self._shards for name in shard.names]
        self.categories = [category for shard in self._shards for category in shard.categories]
        self.splits = [split for shard in self._shards for split in shard.splits]
        self.view_counts = np.concatenate([shard.view_counts() for shard in self._shards])
        self._handles: dict[int, _Handle] = {}
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
        return {**self.__dict__, "_handles": {}}

    def _locate(self, index: int) -> tuple[int, int]:
        """The number of a shape's shard, and its row in that."""
        if not is_whole(index) or not 0 <= index < len(self):
            raise OptionError(f"ShardSet: index must be an integer from 0 to {len(self) - 1}; got {describe(index)}")
        number = bisect_right(self._ends, int(index))
        return number, int(index) - (self._ends[number - 1] if number else 0)

    def path(self, index: int) -> Path:
        """The tar file that holds a shape."""
        return self._shards[self._locate(index)[0]].path

    def metadata(self, index: int) -> Metadata:
        """What the json of a shape says.

        Raises:
            OptionError: no such shape.
            DataError: it is damaged.
        """
        number, row = self._locate(index)
        shard = self._shards[number]
        content = self._fetch(number, shard.member(row, "json"))
        metadata = decode_metadata(content, shard.keys[row], shard.path)
        for field, indexed in (("name", shard.names), ("category", shard.categories), ("split", shard.splits)):
            if getattr(metadata, field) != indexed[row]:
                reason = f"{field} is {getattr(metadata, field)!r:.80}, in the index {indexed[row]!r:.80}"
                raise DataError(shard.path, f"{shard.keys[row]}.json: {reason}")
        if len(metadata.intrinsics) != self.view_counts[index]:
            reason = f"tells of {len(metadata.intrinsics)} views, the shard holds {self.view_counts[index]}"
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
            index: which shape.
            views: which views and in which order; None for all.
            depth: whether to read depth.
            occupancy: the resolution of the occupancy to read, or None for none.
            background: what stands behind the object: "white", an RGB colour in [0, 1], "random" or a folder of
                pictures; the last two draw another for each view.
            generator: what they are drawn with.

        Returns:
            The sample: float32 cameras, the mask where the pictures' alpha is above 127.

        Raises:
            OptionError: no such shape or view, or an option that is none.
            DataError: what is asked for is not in the shard, it is damaged, it is more than 2^28 pixels at once (views
                times height times width), or a picture of the folder of backgrounds cannot be used.
        """
        number, row = self._locate(index)
        metadata = self.metadata(index)
        source = make_background(background)
        if source.is_random and generator is None:
            raise OptionError("ShardSet.read: a random background needs a generator")
        chosen = _views(views, int(self.view_counts[index]))
        height, width = metadata.size
        if len(chosen) * height * width > MAX_PIXELS_AT_ONCE:
            raise DataError(
                self._shards[number].path,
                f"{self._shards[number].keys[row]}: {len(chosen)} views of {height} x {width} are more than the "
                f"{MAX_PIXELS_AT_ONCE} pixels that are read at once; read fewer views",
            )
        # All are read before anything of their size is made: what a damaged json claims is made by nobody.
        pictures = [self._picture(number, row, view, metadata) for view in chosen]
        images = np.empty((len(chosen), 3, *metadata.size), np.float32)
        masks = np.empty((len(chosen), *metadata.size), np.bool_)
        for image, mask, picture in zip(images, masks, pictures, strict=True):
            try:
                behind = source(generator, height, width)
            except DataError as error:
                raise BackgroundError(error.path, error.reason) from error
            _composite(image, mask, picture, behind)
        depths = self._depth(number, row, chosen, metadata) if check_flag("ShardSet.read", "depth", depth) else None
        grid = None if occupancy is None else self._occupancy(number, row, occupancy, metadata)
        return Sample(
            torch.from_numpy(images),
            metadata.cameras(chosen),
            None if depths is None else torch.from_numpy(depths),
            torch.from_numpy(masks),
            None if grid is None else torch.from_numpy(grid),
            metadata.mesh,
            metadata.category,
            metadata.name,
        )

    def _picture(self, number: int, row: int, view: int, metadata: Metadata) -> np.ndarray:
        shard = self._shards[number]
        member = shard.member(row, f"{view:02d}.png")
        return decode_picture(self._fetch(number, member), metadata.size, shard.path, member.name)

    def _depth(self, number: int, row: int, views: Sequence[int], metadata: Metadata) -> np.ndarray:
        shard = self._shards[number]
        if metadata.depth_step is None:
            raise DataError(shard.path, f"{shard.keys[row]} has no depth; read it with depth=False")
        depths = []
        for view in views:
            member = shard.member(row, f"{view:02d}.depth.png")
            content = self._fetch(number, member)
            depths.append(decode_depth(content, metadata.size, metadata.depth_step, shard.path, member.name))
        return np.stack(depths)

    def _occupancy(self, number: int, row: int, side: int, metadata: Metadata) -> np.ndarray:
        shard = self._shards[number]
        if side not in metadata.voxels or isinstance(side, bool):
            there = ", ".join(map(str, metadata.voxels)) or "none"
            raise DataError(
                shard.path, f"{shard.keys[row]} has no occupancy of {describe(side)} voxels; it has {there}"
            )
        member = shard.member(row, f"vox{side}.npy")
        return decode_occupancy(self._fetch(number, member), side, shard.path, member.name)

    def _fetch(self, number: int, member: Member) -> bytes:
        """The content of a member, after a look at its header and its check sum."""
        shard = self._shards[number]
        handle = self._handles.get(number)
        if handle is None:
            if len(self._handles) >= OPEN_FILES:  # a file closes when its last reader lets go of it
                self._handles.clear()
            handle = self._handles[number] = _Handle(shard)
        block = handle.read(member.offset - BLOCK, BLOCK + member.size)
        if len(block) != BLOCK + member.size:
            raise DataError(shard.path, f"ends inside {member.name}")
        if block[:100].partition(b"\0")[0] != member.name.encode():
            raise DataError(shard.path, f"{member.name} is not where the index says; does the index belong to it?")
        content = block[BLOCK:]
        if member.crc32 is not None and zlib.crc32(content) != member.crc32:
            raise DataError(shard.path, f"{member.name} is damaged (a wrong check sum)")
        return content


class _Handle:
    """A tar that is open for reading, until nobody uses it."""

    def __init__(self, shard: ShardIndex) -> None:
        self._descriptor = -1
        self._path = shard.path
        try:
            # Without waiting: a pipe put in the file's place would not let go.
            self._descriptor = os.open(shard.path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
            status = os.fstat(self._descriptor)
        except OSError as error:
            raise DataError(shard.path, f"cannot be read ({error})") from error
        if not stat.S_ISREG(status.st_mode) or status.st_size != shard.bytes:
            raise DataError(shard.path, f"has changed since it was opened: {status.st_size} bytes, not {shard.bytes}")

    def read(self, offset: int, size: int) -> bytes:
        """Bytes from a position, fewer at the end of the file."""
        try:
            return os.pread(self._descriptor, size, offset)
        except OSError as error:
            raise DataError(self._path, f"cannot be read ({error})") from error

    def __del__(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)


def _is_shard(name: str) -> bool:
    return name.endswith(".tar") and not name.startswith(".")


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


def _composite(image: np.ndarray, mask: np.ndarray, picture: np.ndarray, background: np.ndarray) -> None:
    """Fill (3, H, W) with the colours of an RGBA picture where its alpha is above 127, else with the background."""
    planes = np.ascontiguousarray(picture.transpose(2, 0, 1))
    np.greater(planes[3], 127, out=mask)
    np.divide(planes[:3], np.float32(255), out=image, dtype=np.float32)
    np.copyto(image, background, where=~mask)
