"""Writing shards: tar files in WebDataset naming, each with a sidecar that seals it.

``NAME-000000.tar`` holds the members of some hundreds of shapes (see `lsmgeo.data.members`); ``NAME-000000.json``, its
sidecar, holds the SHA-256 of the tar, the check sums of its members and the hash of the settings that it was made with.
The tar is written first and the sidecar after it, both atomically: a tar whose sidecar fits is whole.
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

    A shard holds 10,000 shapes and 1,000,000 members, each of 64 MiB, at most; what has more is cut into several.

    Args:
        path: the tar file to write, ``NAME-000000.tar``.
        items: (key, members) of each shape, in order, as `lsmgeo.data.encode_sample` makes the members.
        settings_hash: what the shard was made with, see `hash_settings`.

    Returns:
        The path written.

    Raises:
        DataError: the path does not end in ``.tar``, or a file cannot be written.
        OptionError: nothing to write, a key that is none, a key or a name that comes twice, a member that no shard
            holds, a json that is none, or more than a shard holds.

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
        # From here to the end the shard has no sidecar rather than one that tells of other content.
        try:
            sidecar.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(sidecar, f"cannot be replaced ({error})") from error
    write_atomic(sidecar, content)
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
        found = read_sidecar(ShardFile(path))
        if found.settings != settings_hash:
            return False
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest() == found.sha256
    except OSError:  # a DataError is one
        return False


class _TarWriter:
    """A tar file whose headers hold nothing but names and sizes; refuses what a reader would refuse."""

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
        """End the tar: two empty blocks, and more up to a full record, as tar programs expect. Returns its sidecar."""
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
