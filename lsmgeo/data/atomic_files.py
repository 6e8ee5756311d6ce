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

# What a killed process leaves behind: on its way in, also as earlier versions called it, or on its way out.
_LEFTOVER = re.compile(r"\..+\.tmp|.+\.tmp-\d+|(?P<name>.+)\.old-\d+")


class AtomicFile:
    """A file being written by `atomic_file`: bytes go in, and only whole does it take its place."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    def write(self, content: bytes) -> None:
        """Append bytes.

        Raises:
            DataError: the disk is full, and the like.
        """
        rest = memoryview(content)
        with os_errors_as_data_errors(self.path):
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[AtomicFile]:
    """Write a file piece by piece so that it is either wholly there or not at all.

    The bytes go to a temporary file beside the target, reach the disk, and replace the target in one step when the
    block ends; parents are created. If the block raises, the target stays as it was and nothing half-written stays.

    Args:
        path: the file to write.

    Yields:
        The file, with ``write(bytes)``.

    Raises:
        DataError: the folder or the file cannot be written. Errors of the block itself pass unchanged.
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
    """Write a file so that it is either wholly there or not at all, as `atomic_file` does.

    Raises:
        DataError: the folder or the file cannot be written; nothing half-written stays.
    """
    with atomic_file(path) as stream:
        stream.write(content)
    return Path(path)


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Fill a folder so that it is either wholly there or not at all.

    What the block writes goes to a temporary folder beside the target, which takes the target's name when the block
    ends. If the block raises, nothing of it stays.

    Args:
        path: the folder to make. Parents are created.
        replace: whether the folder may be there already. It is then renamed out of the way first: a kill between the
            two steps leaves it as ``NAME.old-PID``, which `clear_leftovers` brings back. Otherwise the target must not
            exist, or be empty.

    Yields:
        The temporary folder; files in it are best written by `write_atomic`, which brings them to the disk.

    Raises:
        DataError: something is there already, or the folder cannot be written. Errors of the block pass unchanged.
    """
    path = Path(path)
    temporary, is_current = _beside(path), False
    try:
        with os_errors_as_data_errors(path):
            if not replace and (path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir())))):
                raise DataError(path, "is there already and not an empty folder; name a new one")
            with contextlib.suppress(FileNotFoundError):
                is_current = path.samefile(".")
            if is_current:
                raise DataError(path, "is the current folder, which cannot be replaced; name a new one")
            _make_folder(path.parent)
            temporary.mkdir()
        yield temporary
        with os_errors_as_data_errors(path):
            _take_place(temporary, path) if replace else temporary.replace(path)
            _sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def is_abandoned(temporary: Path) -> bool:
    """Whether the writer of a temporary file of `atomic_file` is gone: its lock ends with its process."""
    descriptor = os.open(temporary, os.O_RDONLY)
    try:
        return _lock(descriptor)
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Take a file's lock; False where another process has it. Systems without locks always give it."""
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
    """Remove a folder so that a kill in the middle leaves all of it, or nothing but a leftover.

    Raises:
        DataError: it cannot be removed.
    """
    leftover = _beside(folder)
    with os_errors_as_data_errors(folder, "removed"):
        folder.replace(leftover)
        shutil.rmtree(leftover)


def clear_leftovers(folder: Path) -> None:
    """Remove what a killed process left behind. Only who alone writes into the folder may do this.

    Args:
        folder: it need not exist.

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
    """A name in the same folder that nobody has: hidden, and known to `clear_leftovers`."""
    return path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"


def _make_folder(folder: Path) -> None:
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        _sync_folder(folder.parent)


def _take_place(temporary: Path, path: Path) -> None:
    # A folder cannot replace a full one in one step. Readers of checkpoints know the old one by its new name too.
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
    """Bring a folder's entries to the disk, where the system can: a rename is not kept before that."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno in (errno.EIO, errno.ENOSPC, errno.EDQUOT):  # others: a system that syncs no folders
            raise
