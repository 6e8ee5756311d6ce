"""Writing shards: tar files in WebDataset naming, each with a sidecar of check sums.

``NAME-000000.tar`` has the members of some hundreds of shapes, see `shard_members`. Its sidecar ``NAME-000000.json``
has the SHA-256 of the tar, the check sums of its members and the hash of its settings. The tar is written first, then
the sidecar, both atomically: a tar with a matching sidecar is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lsmgeo._checks import describe
from lsmgeo.data.atomic_files import atomic_file, write_atomic
from lsmgeo.data.read_files import os_errors_as_data_errors
from lsmgeo.data.shards.shard_index import (
    BLOCK,
    MAX_MEMBER_BYTES,
    MAX_MEMBERS,
    MAX_SHAPES,
    ShardFile,
    add_digest,
    read_sidecar,
    sidecar_path,
)
from lsmgeo.data.shards.shard_members import SUFFIX, format_key
from lsmgeo.data.shards.shard_metadata import decode_metadata
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from lsmgeo.data.atomic_files import AtomicFile

__all__ = ["hash_settings", "verify_shard", "write_shard"]


def hash_settings(settings: Mapping[str, Any]) -> str:
    """The SHA-256 of settings, 64 hexadecimal digits, by which shards with other settings are detected.

    Args:
        settings: names and JSON values, in any order.

    Raises:
        OptionError: a value that JSON does not support.

    Example:
        >>> hash_settings({"views": 20, "size": 224}) == hash_settings({"size": 224, "views": 20})
        True
    """
    try:
        text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OptionError(f"hash_settings: settings must be JSON values ({error})") from error
    return hashlib.sha256(text.encode()).hexdigest()


def write_shard(
    path: str | os.PathLike[str], items: Iterable[tuple[int | str, Mapping[str, bytes]]], settings_hash: str
) -> Path:
    """Write a shard and its sidecar; the same content gives the same bytes.

    Shapes are written one at a time, so memory does not grow with their number. If writing stops at any moment, even
    by a loss of power, there is either no new shard or a complete one; the sidecar is written last. Only one process
    may write a shard at a time.

    Args:
        path: the tar file to write, ``NAME-000000.tar``.
        items: (key, members) of each shape, in order, with the members of `lsmgeo.data.encode_sample`: at most 10,000
            shapes and 1,000,000 members, each of at most 64 MiB.
        settings_hash: of the settings of the shard, see `hash_settings`.

    Returns:
        The path written.

    Raises:
        DataError: the path does not end in ``.tar``, or a file cannot be written.
        OptionError: no shape, more than the limits, an invalid or repeated key, a repeated name, or an invalid member.

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
    with atomic_file(path) as stream:
        tar = _TarWriter(path, stream)
        for key, members in items:
            tar.add(format_key(key), members)
        content = tar.finish(settings_hash)
        # Until the end the shard has no sidecar, rather than that of other content.
        with os_errors_as_data_errors(sidecar, "replaced"):
            sidecar.unlink(missing_ok=True)
    write_atomic(sidecar, content)
    return path


def verify_shard(path: str | os.PathLike[str], settings_hash: str) -> bool:
    """Whether a shard is complete and has these settings: its SHA-256 and settings are those of its sidecar.

    Args:
        path: the tar file.
        settings_hash: as given to `write_shard`.

    Returns:
        False also if the shard or its sidecar is missing or damaged.
    """
    path = Path(path)
    try:
        found = read_sidecar(ShardFile(path))
        if found.settings != settings_hash:
            return False
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest() == found.sha256
    except OSError:  # includes DataError
        return False


class _TarWriter:
    """A tar file whose headers have only names and sizes; raises where a reader would."""

    def __init__(self, path: Path, stream: AtomicFile) -> None:
        self._path, self._stream = path, stream
        self._digest, self._bytes = hashlib.sha256(), 0
        self._keys: set[str] = set()
        self._names: set[str] = set()
        self._crc32: list[int] = []

    def _write(self, content: bytes) -> None:
        self._stream.write(content)
        self._digest.update(content)
        self._bytes += len(content)

    def add(self, key: str, members: Mapping[str, bytes]) -> None:
        """Append the members of a shape."""
        self._check(key, members)
        for suffix, content in members.items():
            info = tarfile.TarInfo(f"{key}.{suffix}")  # mode 0644, owner 0, time 0
            info.size = len(content)
            self._write(info.tobuf(tarfile.USTAR_FORMAT))
            self._write(content)
            self._write(bytes(-len(content) % BLOCK))
            self._crc32.append(zlib.crc32(content))

    def _check(self, key: str, members: Mapping[str, bytes]) -> None:
        strange = [suffix for suffix in members if not SUFFIX.fullmatch(suffix)]
        if strange or next(iter(members), None) != "json":
            raise self._refusal(
                f"the members of shape {key} must be those of encode_sample, json first; "
                f"got {', '.join(map(repr, [*members][:8]))}"
            )
        try:
            metadata = decode_metadata(members["json"], key, self._path)
        except DataError as error:
            raise OptionError(f"write_shard: {error}") from error
        for what, value, seen in (("key", key, self._keys), ("name", metadata.name, self._names)):
            if value in seen:
                raise self._refusal(f"the {what} {value!r:.80} comes twice")
            seen.add(value)
        if len(self._keys) > MAX_SHAPES:
            raise self._refusal(f"more than {MAX_SHAPES} shapes; write several shards")
        if len(self._crc32) + len(members) > MAX_MEMBERS:
            raise self._refusal(f"more than {MAX_MEMBERS} members; write several shards")
        for suffix, content in members.items():
            if len(content) > MAX_MEMBER_BYTES:
                raise self._refusal(f"{key}.{suffix} has {len(content)} bytes, {MAX_MEMBER_BYTES} are the limit")

    def finish(self, settings_hash: str) -> bytes:
        """End the tar with two empty blocks, filled up to a full record as tar programs expect; returns its sidecar."""
        if not self._keys:
            raise self._refusal("there is no shape to write")
        self._write(bytes(2 * BLOCK))
        self._write(bytes(-self._bytes % tarfile.RECORDSIZE))
        values = {
            "format": "lsmgeo shard index",
            "version": 2,
            "tar": self._path.name,
            "bytes": self._bytes,
            "sha256": self._digest.hexdigest(),
            "settings": settings_hash,
            "crc32": self._crc32,
        }
        return add_digest(json.dumps(values, separators=(",", ":")).encode() + b"\n")

    def _refusal(self, reason: str) -> OptionError:
        return OptionError(f"write_shard: {self._path}: {reason}")
