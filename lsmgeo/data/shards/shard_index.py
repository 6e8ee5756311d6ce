"""The index of a shard, from the headers of its tar; and its sidecar, the check sums by which damage is detected.

Both files are untrusted: all their values are checked against the tar's size and against each other.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import tarfile
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path
from sys import intern
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.data.read_files import read_bytes
from lsmgeo.data.shards.shard_members import KEY, SUFFIX
from lsmgeo.data.shards.shard_metadata import decode_texts, is_text
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "BLOCK",
    "MAX_MEMBERS",
    "MAX_MEMBER_BYTES",
    "MAX_SHAPES",
    "ShardFile",
    "ShardIndex",
    "Sidecar",
    "add_digest",
    "read_index",
    "read_sidecar",
    "sidecar_path",
]

BLOCK = 512
MAX_SHAPES = 10_000
MAX_MEMBERS = 1_000_000  # in a shard
MAX_MEMBER_BYTES = 1 << 26
MAX_SIDECAR_BYTES = 1 << 24
MAX_EXTENSION_BYTES = 1 << 16
SEAL = b'{"index_sha256":"'
END = bytes(BLOCK)
MEMBER = re.compile(rf"({KEY.pattern})\.({SUFFIX.pattern})\0".encode())


class Sidecar(NamedTuple):
    """The content of a sidecar: the hash of the settings, the tar's SHA-256, the check sums of its members in order."""

    settings: str
    sha256: str
    crc32: array[int]


@dataclass(frozen=True, eq=False)
class ShardIndex:
    """The index of one tar, in arrays, since a set has millions of members.

    Attributes:
        path: the tar file.
        size: of the tar in bytes.
        keys, names, categories, splits: of its N shapes.
        layouts: the different lists of suffixes.
        layout: (N,) the row in ``layouts`` of each shape.
        first: (N,) the first column in ``members`` of each shape.
        members: (2, M) offsets and sizes of all members; (3, M) with check sums if there is a sidecar.
    """

    path: Path
    size: int
    keys: list[str]
    names: list[str]
    categories: list[str | None]
    splits: list[str | None]
    layouts: list[dict[str, int]]
    layout: np.ndarray
    first: np.ndarray
    members: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)

    def view_counts(self) -> np.ndarray:
        """(N,) number of images of each shape."""
        counts = [sum(s.endswith(".png") and "depth" not in s for s in layout) for layout in self.layouts]
        return np.array(counts, np.int64)[self.layout]

    def read(self, tar: ShardFile, row: int, suffix: str) -> bytes:
        """The content of a member of a shape; a DataError if there is none, or its header or check sum differs."""
        name, place = f"{self.keys[row]}.{suffix}", self.layouts[self.layout[row]].get(suffix)
        if place is None:
            raise DataError(self.path, f"holds no {name}")
        offset, size, *crc32 = self.members[:, self.first[row] + place].tolist()
        block = tar.read(offset - BLOCK, BLOCK + size)
        if len(block) != BLOCK + size:
            raise DataError(self.path, f"ends inside {name}")
        if block[:100].partition(b"\0")[0] != name.encode():
            raise DataError(self.path, f"{name} is not where it was; the file has changed since it was opened")
        content = block[BLOCK:]
        if crc32 and zlib.crc32(content) != crc32[0]:
            raise DataError(self.path, f"{name} is damaged (a wrong check sum)")
        return content


class ShardFile:
    """A tar open for reading; closed when no longer referenced.

    Args:
        path: the tar file.
        size: its size when its index was read.

    Raises:
        DataError: it cannot be read, is not a file, or is of another size.
    """

    def __init__(self, path: Path, size: int | None = None) -> None:
        self._descriptor = -1
        self.path = path
        try:
            # Without waiting: a pipe in place of the file would block.
            self._descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
            status = os.fstat(self._descriptor)
        except (OSError, ValueError) as error:
            raise DataError(path, f"cannot be read ({error})") from error
        if not stat.S_ISREG(status.st_mode):
            raise DataError(path, "no such file")
        self.size = status.st_size
        if size not in (None, self.size):
            raise DataError(path, f"has changed since it was opened: {self.size} bytes, not {size}")

    def read(self, offset: int, size: int) -> bytes:
        """Bytes from a position, fewer at the end of the file."""
        try:
            return os.pread(self._descriptor, size, offset)
        except OSError as error:
            raise DataError(self.path, f"cannot be read ({error})") from error

    def __del__(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)


def sidecar_path(path: Path) -> Path:
    """The sidecar of a shard: ``NAME-000000.json`` beside ``NAME-000000.tar``."""
    return path.with_suffix(".json")


def add_digest(content: bytes) -> bytes:
    """A JSON object with the SHA-256 of the rest of its text as its first value."""
    return SEAL + hashlib.sha256(content[1:]).hexdigest().encode() + b'",' + content[1:]


def read_sidecar(tar: ShardFile) -> Sidecar:
    """Read and check the sidecar of a shard, also of version 1, which has an index of the members as well.

    Raises:
        DataError: there is no sidecar, it is damaged, or it belongs to another tar.
    """
    sidecar = sidecar_path(tar.path)
    content = read_bytes(sidecar, MAX_SIDECAR_BYTES)
    if not content.startswith(SEAL):
        raise DataError(sidecar, "is not the index of a shard")
    body = content[len(SEAL) + 66 :]
    if add_digest(b"{" + body) != content:
        raise DataError(sidecar, "is damaged (a wrong check sum)")
    try:
        values = json.loads(b"{" + body)
    except (ValueError, RecursionError) as error:
        raise DataError(sidecar, f"is not JSON ({error})") from error
    try:
        return _parse_sidecar(values, tar)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(sidecar, reason) from error


def _parse_sidecar(values: dict[str, Any], tar: ShardFile) -> Sidecar:
    if values["format"] != "lsmgeo shard index":
        raise ValueError("is not the index of a shard")
    version, settings, sha256 = values["version"], values["settings"], values["sha256"]
    if version not in (1, 2):
        raise ValueError(f"has version {describe(version)}; this program reads 1 and 2")
    if values["tar"] != tar.path.name or values["bytes"] != tar.size:
        stated = f"{describe(values['tar'])} with {describe(values['bytes'])} bytes"
        raise ValueError(f"belongs to {stated}; {tar.path.name} has {tar.size}")
    for field, text, longest in (("settings", settings, 128), ("sha256", sha256, 64)):
        if not is_text(text) or len(text) > longest:
            raise ValueError(f"{field} must be {longest} characters at most; got {describe(text)}")
    parts = [values["crc32"]] if version == 2 else [entry["crc32"] for entry in values["entries"]]
    crc32 = array("q")
    for part in parts:
        crc32.extend(array("q", part))  # refuses all but integers of 64 bits
    return Sidecar(settings, sha256, crc32)


def read_index(path: Path) -> ShardIndex:
    """Read the index of a shard from the headers of its tar, and the check sums of its sidecar, if it has one.

    Only regular files with the names of members are allowed. Extended headers are skipped, as no member needs one.

    Raises:
        DataError: no such tar, or it is damaged, or has other content.
    """
    tar = ShardFile(path)
    crc32 = read_sidecar(tar).crc32 if os.path.lexists(sidecar_path(path)) else None
    shapes: dict[bytes, dict[bytes, int]] = {}  # the number of each member in the tar
    texts: dict[bytes, dict[str, str | None]] = {}
    offsets, sizes = array("q"), array("q")
    for block, offset, size in _headers(tar):
        match = MEMBER.match(block)
        if match is None or block[345]:  # a name of two parts is a path
            raise DataError(path, f"holds a file that is not a member of a shape: {block[:80].rstrip(bytes(1))!r}")
        key, suffix = match.groups()
        members = shapes.setdefault(key, {})
        if members.setdefault(suffix, len(sizes)) != len(sizes):
            raise DataError(path, f"holds {match[0][:-1].decode()} twice")
        offsets.append(offset)
        sizes.append(size)
        if suffix == b"json":
            texts[key] = decode_texts(tar.read(offset, size), key.decode(), path)
    if not 0 < len(shapes) <= MAX_SHAPES:
        raise DataError(path, f"must hold 1 to {MAX_SHAPES} shapes; got {len(shapes)}")
    if crc32 is not None and len(crc32) != len(sizes):
        raise DataError(sidecar_path(path), f"has {len(crc32)} check sums; {path.name} holds {len(sizes)} members")
    layouts: dict[tuple[bytes, ...], int] = {}
    layout, first, order = array("q"), array("q"), array("q")  # members of a shape may be apart
    for key, members in shapes.items():
        if key not in texts:
            raise DataError(path, f"holds no {key.decode()}.json")
        layout.append(layouts.setdefault(tuple(members), len(layouts)))
        first.append(len(order))
        order.extend(members.values())
    columns = [offsets, sizes] if crc32 is None else [offsets, sizes, crc32]
    found = [texts[key] for key in shapes]
    return ShardIndex(
        path,
        tar.size,
        [key.decode() for key in shapes],
        [str(one["name"]) for one in found],
        [one["category"] and intern(one["category"]) for one in found],
        [one["split"] and intern(one["split"]) for one in found],
        [{suffix.decode(): place for place, suffix in enumerate(suffixes)} for suffixes in layouts],
        np.frombuffer(layout, np.int64),
        np.frombuffer(first, np.int64),
        np.stack([np.frombuffer(column, np.int64) for column in columns])[:, np.frombuffer(order, np.int64)],
    )


def _headers(tar: ShardFile) -> Iterator[tuple[bytes, int, int]]:
    """(header, offset, size) of the regular files of a tar.

    The standard library's reader is not used: it follows extended headers of any length, loops on negative sizes in
    some versions, and takes five times as long.
    """
    position = count = 0
    while (block := tar.read(position, BLOCK)) != END:
        try:
            size, total = int(block[124:135], 8), int(block[148:156].rstrip(b"\0 "), 8)
        except ValueError as error:
            raise DataError(tar.path, f"has a damaged tar header at byte {position} ({error})") from error
        if len(block) < BLOCK or sum(block) - sum(block[148:156]) + 8 * 32 != total:
            raise DataError(tar.path, f"has a damaged tar header at byte {position} (a wrong check sum)")
        begin = position + BLOCK
        if not 0 <= size <= min(tar.size - begin, MAX_MEMBER_BYTES):
            raise DataError(tar.path, f"announces {size} bytes at byte {position}, more than it holds or may hold")
        count += 1
        if count > MAX_MEMBERS:
            raise DataError(tar.path, f"holds more than {MAX_MEMBERS} members")
        kind = block[156:157]
        if kind in (tarfile.REGTYPE, tarfile.AREGTYPE):
            yield block, begin, size
        elif kind not in (tarfile.XHDTYPE, tarfile.XGLTYPE) or size > MAX_EXTENSION_BYTES:
            raise DataError(tar.path, f"holds something other than regular files at byte {position}")
        position = begin + -(-size // BLOCK) * BLOCK
