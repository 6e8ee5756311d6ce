"""Writing files and folders atomically: each is there complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from lsmgeo.data.read_files import os_errors_as_data_errors
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "AtomicFile",
    "atomic_file",
    "atomic_folder",
    "clear_leftovers",
    "is_abandoned",
    "remove_folder",
    "write_atomic",
]

# What a killed process leaves behind: a new file (also by the name of earlier versions), or a replaced folder.
_LEFTOVER = re.compile(r"\..+\.tmp|.+\.tmp-\d+|(?P<name>.+)\.old-\d+")


class AtomicFile:
    """A file that `atomic_file` is writing."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    def write(self, content: bytes) -> None:
        """Append bytes; a DataError if the disk is full, and the like."""
        rest = memoryview(content)
        with os_errors_as_data_errors(self.path):
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[AtomicFile]:
    """Write a file piece by piece, atomically: it is complete or not there at all.

    The bytes are written to a temporary file beside the target and synchronised to disk; it replaces the target in one
    step when the block ends. Parent folders are created. If the block raises, the target is unchanged.

    Args:
        path: the file to write.

    Yields:
        The file, with a method ``write(bytes)``.

    Raises:
        DataError: the folder or the file cannot be written. Errors of the block propagate unchanged.
    """
    path = Path(path)
    temporary, descriptor = _beside(path), -1
    try:
        with os_errors_as_data_errors(path):
            _make_folder(path.parent)
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
            _lock(descriptor)
        yield AtomicFile(path, descriptor)
        with os_errors_as_data_errors(path):
            os.fsync(descriptor)
            temporary.replace(path)
            _sync_folder(path.parent)
    finally:
        if descriptor >= 0:
            os.close(descriptor)
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_atomic(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file atomically, as `atomic_file` does.

    Raises:
        DataError: the folder or the file cannot be written.
    """
    with atomic_file(path) as stream:
        stream.write(content)
    return Path(path)


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Write a folder atomically: it is complete or not there at all.

    The block writes into a temporary folder beside the target, which is renamed to the target when the block ends. If
    the block raises, the temporary folder is removed.

    Args:
        path: the folder to make. Parents are created.
        replace: whether the folder may exist. It is then renamed first: a process killed between the two steps leaves
            it as ``NAME.old-PID``, which `clear_leftovers` restores. Otherwise the target must not exist or be empty.

    Yields:
        The temporary folder; write files in it with `write_atomic`, which synchronises them to disk.

    Raises:
        DataError: the target exists, or the folder cannot be written. Errors of the block propagate unchanged.
    """
    path = Path(path)
    temporary, is_current = _beside(path), False
    try:
        with os_errors_as_data_errors(path):
            if not replace and (path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir())))):
                raise DataError(path, "exists and is not an empty folder; choose another path")
            with contextlib.suppress(FileNotFoundError):
                is_current = path.samefile(".")
            if is_current:
                raise DataError(path, "is the current folder, which cannot be replaced; choose another path")
            _make_folder(path.parent)
            temporary.mkdir()
        yield temporary
        with os_errors_as_data_errors(path):
            _take_place(temporary, path) if replace else temporary.replace(path)
            _sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def is_abandoned(temporary: Path) -> bool:
    """Whether the process that wrote a temporary file of `atomic_file` has ended: its lock ends with it."""
    descriptor = os.open(temporary, os.O_RDONLY)
    try:
        return _lock(descriptor)
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Take a file's lock; False if another process holds it, always True on systems without locks."""
    with contextlib.suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass
    return True


def remove_folder(folder: Path) -> None:
    """Remove a folder; a process killed meanwhile leaves all of it, or a leftover. A DataError if that fails."""
    leftover = _beside(folder)
    with os_errors_as_data_errors(folder, "removed"):
        folder.replace(leftover)
        shutil.rmtree(leftover)


def clear_leftovers(folder: Path) -> None:
    """Remove what killed processes left in a folder, which need not exist; no other process may write into it.

    Raises:
        DataError: the folder cannot be read, or a file not removed.
    """
    with os_errors_as_data_errors(folder):
        for item in sorted(folder.iterdir()) if folder.is_dir() else ():
            match = _LEFTOVER.fullmatch(item.name)
            if match is None:
                continue
            if match["name"] and not (folder / match["name"]).exists():
                item.replace(folder / match["name"])
            elif item.is_dir():
                shutil.rmtree(item)
            else:
                item.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    """A new hidden name in the same folder, of the pattern of `clear_leftovers`."""
    return path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"


def _make_folder(folder: Path) -> None:
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        _sync_folder(folder.parent)


def _take_place(temporary: Path, path: Path) -> None:
    # A folder cannot replace another in one step. Readers of checkpoints also accept the old one by its new name.
    old = path.with_name(f"{path.name}.old-{os.getpid()}")
    is_there = path.exists()
    if is_there:
        path.replace(old)
    try:
        temporary.replace(path)
    except OSError:
        if is_there:
            old.replace(path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _sync_folder(folder: Path) -> None:
    """Synchronise a folder's entries to disk, where the system can: only then is a rename durable."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno in (errno.EIO, errno.ENOSPC, errno.EDQUOT):  # others: the system cannot synchronise folders
            raise
