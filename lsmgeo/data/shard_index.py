"""Where the members of a shard lie: read from its sidecar, or from the headers of the tar itself.

Both come from outside. Nothing is believed of them that the tar's size or another part of them contradicts.
"""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
from array import array
from dataclasses import dataclass
from pathlib import Path
from sys import intern
from typing import Any, NamedTuple

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.data.files import read_bytes
from lsmgeo.data.members import KEY, SUFFIX
from lsmgeo.data.metadata import decode_metadata, is_text
from lsmgeo.errors import DataError

__all__ = [
    "BLOCK",
    "MAX_MEMBERS",
    "MAX_MEMBER_BYTES",
    "MAX_SHAPES",
    "MAX_SIDECAR_BYTES",
    "Member",
    "ShardIndex",
    "index_tar",
    "open_index",
    "read_sidecar",
    "seal",
    "sidecar_path",
]

BLOCK = 512
MAX_SHAPES = 10_000
MAX_MEMBERS = 1_000_000  # in a shard
MAX_MEMBER_BYTES = 1 << 26
MAX_SIDECAR_BYTES = 1 << 24
MAX_EXTENSION_BYTES = 1 << 16
SEAL = b'{"index_sha256":"'


class Member(NamedTuple):
    """One file in a tar: where its content begins, its size, and its check sum where that is known."""

    name: str
    offset: int
    size: int
    crc32: int | None


@dataclass(frozen=True, eq=False)
class ShardIndex:
    """What one tar holds, in arrays: a set has millions of members.

    Attributes:
        path: the tar file.
        bytes: its size.
        settings: hash of the settings that it was made with; None where there is no sidecar, as `sha256`.
        sha256: of the tar.
        keys: of its N shapes.
        names: of its shapes.
        categories: of its shapes.
        splits: of its shapes.
        layouts: the different lists of suffixes.
        layout: (N,) which of them a shape has.
        first: (N,) where a shape's members begin in the next three.
        offsets: (M,) of all members.
        sizes: (M,)
        crc32: (M,), or None where there is no sidecar.
    """

    path: Path
    bytes: int
    settings: str | None
    sha256: str | None
    keys: list[str]
    names: list[str]
    categories: list[str | None]
    splits: list[str | None]
    layouts: list[dict[str, int]]
    layout: np.ndarray
    first: np.ndarray
    offsets: np.ndarray
    sizes: np.ndarray
    crc32: np.ndarray | None

    def __len__(self) -> int:
        return len(self.keys)

    def suffixes(self, row: int) -> dict[str, int]:
        """The suffixes of a shape's members and their places in it."""
        return self.layouts[self.layout[row]]

    def view_counts(self) -> np.ndarray:
        """(N,) how many pictures each shape has."""
        counts = [sum(s.endswith(".png") and "depth" not in s for s in layout) for layout in self.layouts]
        return np.array(counts, np.int64)[self.layout]

    def member(self, row: int, suffix: str) -> Member:
        """One member of a shape.

        Raises:
            DataError: the shape has no such member.
        """
        place = self.suffixes(row).get(suffix)
        name = f"{self.keys[row]}.{suffix}"
        if place is None:
            raise DataError(self.path, f"holds no {name}")
        at = int(self.first[row]) + place
        crc32 = None if self.crc32 is None else int(self.crc32[at])
        return Member(name, int(self.offsets[at]), int(self.sizes[at]), crc32)


def sidecar_path(path: Path) -> Path:
    """Where the index of a shard lies: ``NAME-000000.json`` beside ``NAME-000000.tar``."""
    return path.with_suffix(".json")


def open_index(path: Path) -> ShardIndex:
    """The index of a shard, from its sidecar, or from the tar's headers where it has none.

    Raises:
        DataError: no such tar, or what is there is damaged.
    """
    return read_sidecar(path) if os.path.lexists(sidecar_path(path)) else index_tar(path)


def _size_of(path: Path) -> int:
    try:
        if not path.is_file():
            raise DataError(path, "no such file")
        return path.stat().st_size
    except DataError:
        raise
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read ({error})") from error


def seal(index: bytes) -> bytes:
    """A JSON object with the SHA-256 of the rest of its text as its first value."""
    return SEAL + hashlib.sha256(index[1:]).hexdigest().encode() + b'",' + index[1:]


def read_sidecar(path: Path) -> ShardIndex:
    """Read and check the sidecar of a shard.

    Args:
        path: the tar file.

    Raises:
        DataError: there is no tar or no sidecar, it is damaged, or it tells of another tar.
    """
    size = _size_of(path)
    sidecar = sidecar_path(path)
    content = read_bytes(sidecar, MAX_SIDECAR_BYTES)
    if not content.startswith(SEAL):
        raise DataError(sidecar, "is not the index of a shard")
    body = content[len(SEAL) + 66 :]
    if seal(b"{" + body) != content:
        raise DataError(sidecar, "is damaged (a wrong check sum)")
    try:
        values = json.loads(b"{" + body)
    except (ValueError, RecursionError) as error:
        raise DataError(sidecar, f"is not JSON ({error})") from error
    try:
        return _index(values, path, size)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(sidecar, reason) from error


def _index(values: Any, path: Path, size: int) -> ShardIndex:
    if not isinstance(values, dict) or values["format"] != "lsmgeo shard index":
        raise ValueError("is not the index of a shard")
    if values["version"] != 1:
        raise ValueError(f"has version {describe(values['version'])}; this program reads 1")
    if values["tar"] != path.name or type(values["bytes"]) is not int or values["bytes"] != size:
        raise ValueError(
            f"tells of {describe(values['tar'])} with {describe(values['bytes'])} bytes; {path.name} has {size}"
        )
    for field, longest in (("settings", 128), ("sha256", 64)):
        if not is_text(values[field]) or len(values[field]) > longest:
            raise ValueError(f"{field} must be {longest} characters at most; got {describe(values[field])}")
    entries, layouts = values["entries"], _layouts(values["layouts"])
    if not isinstance(entries, list) or not 0 < len(entries) <= MAX_SHAPES or values["shapes"] != len(entries):
        raise ValueError(f"must hold 1 to {MAX_SHAPES} entries, as many as it announces")
    builder = _Builder(path, size, layouts)
    for entry in entries:
        if not isinstance(entry, dict):
            raise ValueError(f"an entry must be an object; got {describe(entry)}")
        builder.add(entry)
    return builder.finish(values["settings"], values["sha256"])


def _layouts(values: Any) -> list[dict[str, int]]:
    if not isinstance(values, list) or len(values) > MAX_SHAPES:
        raise ValueError(f"layouts must be a list; got {describe(values)}")
    layouts = []
    for suffixes in values:
        if not isinstance(suffixes, list) or not all(isinstance(s, str) and SUFFIX.fullmatch(s) for s in suffixes):
            raise ValueError(f"a layout must be a list of suffixes; got {describe(suffixes)}")
        layout = {intern(suffix): place for place, suffix in enumerate(suffixes)}
        if len(layout) != len(suffixes) or "json" not in layout:
            raise ValueError("a layout must hold json, and no suffix twice")
        layouts.append(layout)
    return layouts


class _Builder:
    """Collects entries, from a sidecar or from headers, and checks them alike."""

    def __init__(self, path: Path, size: int, layouts: list[dict[str, int]]) -> None:
        self.path, self.size, self.layouts = path, size, layouts
        self.keys: list[str] = []
        self.names: list[str] = []
        self.categories: list[str | None] = []
        self.splits: list[str | None] = []
        self.layout, self.first = array("q"), array("q")
        self.columns = {"offsets": array("q"), "sizes": array("q"), "crc32": array("q")}

    def add(self, entry: dict[str, Any]) -> None:
        """Take one entry.

        Raises:
            KeyError, TypeError, ValueError, OverflowError: it is not as it should be.
        """
        key, name = entry["key"], entry["name"]
        if not isinstance(key, str) or not KEY.fullmatch(key):
            raise ValueError(f"a key must be eight digits; got {describe(key)}")
        if not is_text(name):
            raise ValueError(f"the name of {key} must be 1 to 1024 printable characters; got {describe(name)}")
        for field, texts in (("category", self.categories), ("split", self.splits)):
            text = entry[field]
            if text is not None and not is_text(text):
                raise ValueError(f"the {field} of {key} must be printable characters or null; got {describe(text)}")
            texts.append(None if text is None else intern(text))
        layout = entry["layout"]
        if type(layout) is not int or not 0 <= layout < len(self.layouts):
            raise ValueError(f"the layout of {key} must be one of {len(self.layouts)}; got {describe(layout)}")
        self.keys.append(key)
        self.names.append(name)
        self.layout.append(layout)
        self.first.append(len(self.columns["sizes"]))
        for field, column in self.columns.items():
            values = entry[field]
            if values is None and field == "crc32":
                continue
            if not isinstance(values, list) or len(values) != len(self.layouts[layout]):
                raise ValueError(f"the {field} of {key} must be {len(self.layouts[layout])} whole numbers")
            column.extend(values)  # refuses what is no whole number of 64 bits
        if len(self.columns["sizes"]) > MAX_MEMBERS:
            raise ValueError(f"holds more than {MAX_MEMBERS} members")

    def finish(self, settings: str | None, sha256: str | None) -> ShardIndex:
        """The index, after the checks that concern all entries together."""
        if len(set(self.keys)) != len(self.keys):
            raise ValueError("uses a key twice")
        if len(set(self.names)) != len(self.names):
            raise ValueError("uses a name twice")
        offsets, sizes, crc32 = (np.frombuffer(column, np.int64) for column in self.columns.values())
        good = (offsets >= BLOCK) & (sizes >= 0) & (sizes <= MAX_MEMBER_BYTES) & (offsets <= self.size - sizes)
        if not good.all():
            raise ValueError(f"a member lies outside the {self.size} bytes of {self.path.name}")
        order = np.argsort(offsets, kind="stable")
        if (offsets[order][1:] < (offsets + sizes)[order][:-1]).any():
            raise ValueError("members overlap")
        return ShardIndex(
            self.path,
            self.size,
            settings,
            sha256,
            self.keys,
            self.names,
            self.categories,
            self.splits,
            self.layouts,
            np.frombuffer(self.layout, np.int64),
            np.frombuffer(self.first, np.int64),
            offsets,
            sizes,
            crc32 if len(crc32) else None,
        )


def index_tar(path: Path) -> ShardIndex:
    """Make the index of a shard from the headers of its tar, for one that has no sidecar; nothing is written.

    Only regular files with the names of members are taken. Extended headers are stepped over: a name that needs one
    is no member's.

    Raises:
        DataError: no such tar, a damaged one, or one that holds something else.
    """
    size = _size_of(path)
    try:
        with path.open("rb") as stream:
            members = list(_headers(stream, path, size))
            return _from_members(members, stream, path, size)
    except DataError:
        raise
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})") from error


def _headers(stream: Any, path: Path, size: int) -> Any:
    """(name, offset, size) of the regular files of a tar.

    The standard library's reader is not used: it follows extended headers of any length, and some versions never end
    on negative sizes.
    """
    position = count = 0
    while True:
        stream.seek(position)
        block = stream.read(BLOCK)
        if len(block) == BLOCK and not any(block):
            return
        try:
            info = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise DataError(path, f"has a damaged tar header at byte {position} ({error})") from error
        begin = position + BLOCK
        if not 0 <= info.size <= min(size - begin, MAX_MEMBER_BYTES):
            raise DataError(path, f"announces {info.size} bytes at byte {position}, more than it holds or may hold")
        count += 1
        if count > MAX_MEMBERS:
            raise DataError(path, f"holds more than {MAX_MEMBERS} members")
        if info.type in (tarfile.XHDTYPE, tarfile.XGLTYPE) and info.size <= MAX_EXTENSION_BYTES:
            pass
        elif info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise DataError(path, f"holds something else than regular files at byte {position}")
        else:
            yield info.name, begin, info.size
        position = begin + (info.size + BLOCK - 1) // BLOCK * BLOCK


def _from_members(members: list[tuple[str, int, int]], stream: Any, path: Path, size: int) -> ShardIndex:
    shapes: dict[str, dict[str, tuple[int, int]]] = {}
    for name, offset, length in members:
        key, _, suffix = name.partition(".")
        if not KEY.fullmatch(key) or not SUFFIX.fullmatch(suffix):
            raise DataError(path, f"holds a file that is no member of a shape: {name[:80]!r}")
        if suffix in shapes.setdefault(key, {}):
            raise DataError(path, f"holds {name} twice")
        shapes[key][suffix] = offset, length
    if not 0 < len(shapes) <= MAX_SHAPES:
        raise DataError(path, f"must hold 1 to {MAX_SHAPES} shapes; got {len(shapes)}")
    layouts: dict[tuple[str, ...], int] = {}
    entries = []
    for key, found in shapes.items():
        if "json" not in found:
            raise DataError(path, f"holds no {key}.json")
        offset, length = found["json"]
        stream.seek(offset)
        metadata = decode_metadata(stream.read(length), key, path)
        offsets, sizes = (list(column) for column in zip(*found.values(), strict=True))
        layout = layouts.setdefault(tuple(found), len(layouts))
        texts = {"name": metadata.name, "category": metadata.category, "split": metadata.split}
        entries.append({"key": key, **texts, "layout": layout, "offsets": offsets, "sizes": sizes, "crc32": None})
    builder = _Builder(path, size, [{intern(s): place for place, s in enumerate(layout)} for layout in layouts])
    try:
        for entry in entries:
            builder.add(entry)
        return builder.finish(None, None)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(path, str(error)) from error
