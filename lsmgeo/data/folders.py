"""Folders that are never half there."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["atomic_folder"]


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Fill a folder so that it is either wholly there or not at all.

    What the block writes goes to a temporary folder beside the target, which takes the target's name in one step when
    the block ends. If the block raises, nothing of it stays.

    Args:
        path: the folder to make: one that does not exist, or is empty. Parents are created.

    Yields:
        The temporary folder.

    Raises:
        DataError: something is there already, or the folder cannot be written. Errors of the block pass unchanged.
    """
    path = Path(path)
    temporary = None
    try:
        try:
            if path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir()))):
                raise DataError(path, "is there already and not an empty folder; name a new one")
            if path.resolve() == Path.cwd():
                raise DataError(path, "is the current folder, which cannot be replaced; name a new one")
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
        except OSError as error:
            if isinstance(error, DataError):
                raise
            raise DataError(path, f"cannot be written ({error})") from error
        yield temporary
        try:
            # mkdtemp makes a private folder; a result should have the permissions that the user's umask gives.
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o777 & ~umask)
            temporary.replace(path)
            temporary = None
        except OSError as error:
            raise DataError(path, f"cannot be written ({error})") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
