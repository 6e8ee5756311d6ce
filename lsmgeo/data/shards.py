"""Writing shards: tar files in WebDataset naming, each with an index beside it.

``NAME-000000.tar`` holds the members of some hundreds of shapes (see `lsmgeo.data.members`); ``NAME-000000.json``, its
sidecar, says where each begins, how long it is and what its check sum is, so that one shape can be read without the
others. The tar is written first and the sidecar after it, both atomically: a tar whose sidecar fits is whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tarfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lsmgeo._checks import describe
from lsmgeo.data.files import atomic_file
from lsmgeo.data.members import SUFFIX, format_key
from lsmgeo.data.metadata import decode_metadata
from lsmgeo.data.shard_index import BLOCK, MAX_SHAPES, read_sidecar, seal, sidecar_path
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from lsmgeo.data.files import AtomicFile

__all__ = ["hash_settings", "verify_shard", "write_shard"]


def hash_settings(settings: Mapping[str, Any]) -> str:
    """The SHA-256 of settings, by which shards made otherwise are told apart.

    Args:
        settings: names and values that JSON can hold; their order does not matter.

    Returns:
        64 hexadecimal digits.

    Raises:
        OptionError: a value that JSON cannot hold.

    Example:
        >>> hash_settings({"views": 20, "size": 224}) == hash_settings({"size": 224, "views": 20})
        True
    """
    try:
        text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OptionError(f"hash_settings: settings must be what JSON can hold ({error})") from error
    return hashlib.sha256(text.encode()).hexdigest()


def write_shard(
    path: str | os.PathLike[str], items: Iterable[tuple[int | str, Mapping[str, bytes]]], settings_hash: str
) -> Path:
    """Write a shard and its sidecar; the same content gives the same bytes.

    Shapes are taken one at a time and written at once, so memory does not grow with their number. Stopped at any
    moment, even by the loss of power, it leaves either no new shard or a whole one; the sidecar comes last. Only one
    process may write a shard at a time.

    Args:
        path: the tar file to write, ``NAME-000000.tar``.
        items: (key, members) of each shape, in order, as `lsmgeo.data.encode_sample` makes the members.
        settings_hash: what the shard was made with, see `hash_settings`.

    Returns:
        The path written.

    Raises:
        DataError: the path does not end in ``.tar``, nothing to write, or a file cannot be written.
        OptionError: a key that is none or comes twice, a member that no shard holds, or a json that is none.

    Example:
        >>> import tempfile, torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.data import Sample, encode_sample
        >>> cameras = orbit(torch.zeros(1), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        >>> sample = Sample(torch.rand(1, 3, 48, 48), cameras, None, None, None, None, "chair", "chair-0")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = write_shard(f"{folder}/set-000000.tar", [(0, encode_sample(sample, 0))], "made by hand")
        ...     verify_shard(path, "made by hand"), verify_shard(path, "made otherwise")
        (True, False)
    """
    path = Path(path)
    if path.suffix != ".tar" or path.name.startswith("."):
        raise DataError(path, "a shard's name must end in .tar and begin with no dot")
    if not isinstance(settings_hash, str) or not settings_hash.isprintable() or not 0 < len(settings_hash) <= 128:
        raise OptionError(f"write_shard: settings_hash must be 1 to 128 characters; got {describe(settings_hash)}")
    sidecar = sidecar_path(path)
    for file in (path, sidecar):
        _remove_leftovers(file)
    layouts: dict[tuple[str, ...], int] = {}
    entries: list[dict[str, Any]] = []
    with atomic_file(path) as stream:
        _lock(stream)
        writer = _TarWriter(stream)
        for key, members in items:
            entries.append(_append(writer, path, format_key(key), members, layouts))
        if not entries or len({entry["key"] for entry in entries}) != len(entries):
            raise OptionError(
                f"write_shard: {path}: {'a key comes twice' if entries else 'there is no shape to write'}"
            )
        if len(entries) > MAX_SHAPES:
            raise OptionError(f"write_shard: {path}: {len(entries)} shapes, {MAX_SHAPES} are the limit")
        writer.finish()
        # From here to the end the shard has no sidecar rather than one that tells of other content.
        try:
            sidecar.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(sidecar, f"cannot be replaced ({error})") from error
    index = {
        "format": "lsmgeo shard index",
        "version": 1,
        "tar": path.name,
        "bytes": writer.offset,
        "sha256": writer.digest.hexdigest(),
        "settings": settings_hash,
        "shapes": len(entries),
        "layouts": [list(layout) for layout in layouts],
        "entries": entries,
    }
    with atomic_file(sidecar) as stream:
        _lock(stream)
        stream.write(seal(json.dumps(index, separators=(",", ":")).encode() + b"\n"))
    return path


def verify_shard(path: str | os.PathLike[str], settings_hash: str) -> bool:
    """Whether a shard is whole and was made with these settings: its SHA-256 and settings are those of its sidecar.

    Args:
        path: the tar file.
        settings_hash: as given to `write_shard`.

    Returns:
        False too where the shard or its sidecar is missing or damaged: make it again.
    """
    path = Path(path)
    try:
        index = read_sidecar(path)
        if index.settings != settings_hash:
            return False
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest() == index.sha256
    except OSError:  # a DataError is one
        return False


class _TarWriter:
    """A tar file whose headers hold nothing but names and sizes."""

    def __init__(self, stream: AtomicFile) -> None:
        self.offset = 0
        self.digest = hashlib.sha256()
        self._stream = stream

    def _write(self, content: bytes) -> None:
        self._stream.write(content)
        self.digest.update(content)
        self.offset += len(content)

    def add(self, name: str, content: bytes) -> int:
        """Append a file; returns where its content begins."""
        info = tarfile.TarInfo(name)  # mode 0644, owner 0, time 0
        info.size = len(content)
        self._write(info.tobuf(tarfile.USTAR_FORMAT))
        begin = self.offset
        self._write(content)
        self._write(bytes(-len(content) % BLOCK))
        return begin

    def finish(self) -> None:
        """End the tar: two empty blocks, and more up to a full record, as tar programs expect."""
        self._write(bytes(2 * BLOCK))
        self._write(bytes(-self.offset % tarfile.RECORDSIZE))


def _append(
    writer: _TarWriter, path: Path, key: str, members: Mapping[str, bytes], layouts: dict[tuple[str, ...], int]
) -> dict[str, Any]:
    """Write the members of a shape; returns its entry in the index."""
    strange = [suffix for suffix in members if not SUFFIX.fullmatch(suffix)]
    if strange or next(iter(members), None) != "json":
        raise OptionError(
            f"write_shard: {path}: the members of shape {key} must be those of encode_sample, json first; "
            f"got {', '.join(map(repr, [*members][:8]))}"
        )
    try:
        metadata = decode_metadata(members["json"], key, path)
    except DataError as error:
        raise OptionError(f"write_shard: {error}") from error
    offsets = [writer.add(f"{key}.{suffix}", content) for suffix, content in members.items()]
    return {
        "key": key,
        "name": metadata.name,
        "category": metadata.category,
        "split": metadata.split,
        "layout": layouts.setdefault(tuple(members), len(layouts)),
        "offsets": offsets,
        "sizes": [len(content) for content in members.values()],
        "crc32": [zlib.crc32(content) for content in members.values()],
    }


def _lock(stream: AtomicFile) -> None:
    """Mark a temporary file as being written, until this process ends, however it does."""
    with contextlib.suppress(ImportError, OSError):  # no locks on this system, or on this file system
        import fcntl

        fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_leftovers(path: Path) -> None:
    """Remove what killed processes left of this file: temporary files that nobody holds locked."""
    try:
        import fcntl
    except ImportError:
        return
    for leftover in path.parent.glob(f".{path.name}.*.tmp"):
        with contextlib.suppress(OSError), leftover.open("rb") as stream:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink(missing_ok=True)
