"""Folders of files that are whole or not there, whatever kills the process that writes them."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

__all__ = ["clear_leftovers", "make_folder", "put_file", "put_folder", "remove_folder"]

# On its way in (tmp) or out (old), and the process that it belongs to.
_LEFTOVER = re.compile(r"(?P<name>.+)\.(?P<kind>tmp|old)-\d+")


def put_folder(final: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder: under another name, each file to the disk, then the folder, then renamed, then its parent.

    Args:
        final: the folder; one of this name is replaced.
        files: the content of its files.

    Raises:
        OSError: it cannot be written; what was there before stays, and nothing half-written does.
    """
    temporary = _temporary(final)
    try:
        os.mkdir(temporary)
        for name, content in files.items():
            _write(temporary / name, content)
        _sync(temporary)
        _take_place(temporary, final)
        _sync(final.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def put_file(path: Path, content: bytes) -> None:
    """Write one file in the same way.

    Args:
        path: the file.
        content: all of it.

    Raises:
        OSError: it cannot be written; what was there before stays, and nothing half-written does.
    """
    temporary = _temporary(path)
    try:
        _write(temporary, content)
        os.rename(temporary, path)
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def make_folder(folder: Path) -> None:
    """Make a folder and its parents, if they are not there.

    Args:
        folder: which.

    Raises:
        OSError: it cannot be made.
    """
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        _sync(folder.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder so that a kill in the middle leaves all of it, or nothing but a leftover.

    Args:
        folder: which.

    Raises:
        OSError: it cannot be removed.
    """
    leftover = _temporary(folder)
    os.rename(folder, leftover)
    shutil.rmtree(leftover)


def clear_leftovers(folder: Path) -> None:
    """Remove what a killed process left behind. Only who alone writes into the folder may do this.

    Args:
        folder: it need not exist.

    Raises:
        OSError: the folder cannot be read, or a file not removed.
    """
    for item in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = _LEFTOVER.fullmatch(item.name)
        if match is None:
            continue
        if match["kind"] == "old" and not (folder / match["name"]).exists():
            # Killed between the two renames of `_take_place`.
            os.rename(item, folder / match["name"])
        elif item.is_dir():
            shutil.rmtree(item)
        else:
            item.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    return path.with_name(f"{path.name}.tmp-{os.getpid()}")


def _take_place(temporary: Path, final: Path) -> None:
    if not final.exists():
        os.rename(temporary, final)
        return
    # A folder cannot replace a full one in one step. Readers know the old one by this name too.
    old = final.with_name(f"{final.name}.old-{os.getpid()}")
    os.rename(final, old)
    try:
        os.rename(temporary, final)
    except OSError:
        os.rename(old, final)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _write(path: Path, content: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(descriptor, rest) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
