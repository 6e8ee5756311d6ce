"""Untrusted files: sizes are limited, names stay inside their folder, every failure is a `DataError` of the path."""

from __future__ import annotations

import contextlib
import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

__all__ = [
    "file_reader",
    "one_file",
    "os_errors_as_data_errors",
    "parse_floats",
    "parse_ints",
    "path_inside",
    "plain_files",
    "read_bytes",
    "read_text",
]

MAX_TEXT_BYTES = 1 << 28
MAX_NUMBER_LENGTH = 64
Options = ParamSpec("Options")
Content = TypeVar("Content")


@contextlib.contextmanager
def os_errors_as_data_errors(path: str | os.PathLike[str], what: str = "written") -> Iterator[None]:
    """Turn an OSError of a block (no permission, a full disk, a name too long) into a DataError: cannot be `what`."""
    try:
        yield
    except DataError:
        raise
    except OSError as error:
        raise DataError(path, f"cannot be {what} ({str(error)[:400]})") from error


def file_reader(read: Callable[Options, Content]) -> Callable[Options, Content]:
    """Decorate a reader: its OSErrors become DataErrors of the path, its first argument."""

    @functools.wraps(read)
    def reading(*args: Options.args, **options: Options.kwargs) -> Content:
        with os_errors_as_data_errors(str(args[0] if args else options["path"]), "read"):
            return read(*args, **options)

    return reading


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a regular file of at most ``limit`` bytes; all else raises a DataError."""
    with os_errors_as_data_errors(path, "read"):
        # A pipe or a device could block or never end, so only regular files are opened.
        if not path.is_file():
            raise DataError(path, "no such file")
        with path.open("rb") as stream:
            # Python allocates the number of bytes that it is asked for.
            content = stream.read(min(os.fstat(stream.fileno()).st_size, limit) + 1)
    if len(content) > limit:
        raise DataError(path, f"is larger than the limit of {limit} bytes")
    return content


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file of at most ``limit`` bytes; all else raises a DataError."""
    try:
        # Windows writes a byte order mark before UTF-8.
        text = read_bytes(path, limit).decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise DataError(path, "is not a text file (invalid UTF-8)") from error
    if "\0" in text:
        raise DataError(path, "is not a text file (it holds a zero byte)")
    return text


def path_inside(root: Path, name: str, source: Path) -> Path:
    """The path of ``name`` below ``root``; a name that leads outside is an error.

    Args:
        root: the folder that must contain the result.
        name: a relative name, as ``source`` states it.
        source: the file that states the name, for errors.

    Raises:
        DataError: the name is empty, absolute or not printable, or leads outside ``root``, also through a link.
    """
    if not name or len(name) > 512 or not name.isprintable():
        raise DataError(source, f"holds an unusable file name {name[:80]!r}")
    try:
        root = root.resolve()
        path = (root / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(source, f"holds an unusable file name {name[:80]!r} ({error})") from error
    if path == root or not path.is_relative_to(root):
        raise DataError(source, f"names a file outside its folder: {name[:80]!r}")
    return path


def plain_files(folder: Path, *patterns: str) -> list[Path]:
    """The regular files of a folder, sorted, that match the first pattern with a match."""
    found = (sorted(path for path in folder.glob(pattern) if path.is_file()) for pattern in patterns)
    return next(filter(None, found), [])


def one_file(path: Path, *patterns: str) -> Path:
    """The path itself if it is not a folder, else the one file in it (see `plain_files`); a DataError if not one."""
    files = plain_files(path, *patterns) if path.is_dir() else [path]
    if len(files) != 1:
        found = ", ".join(file.name for file in files[:5]) or "none"
        raise DataError(path, f"expected one file {' or '.join(patterns)}; found {found}: pass the path of one file")
    return files[0]


def parse_floats(tokens: Sequence[str], path: Path, where: str, *, finite: bool = True) -> list[float]:
    """Numbers from text, by default finite; a DataError if a token is not such a number, or is far too long."""
    try:
        if any(len(token) > MAX_NUMBER_LENGTH for token in tokens):
            raise ValueError("number too long")
        values = [float(token) for token in tokens]
    except ValueError as error:
        raise DataError(path, f"{where}: expected numbers ({error})") from error
    if finite and not np.isfinite(values).all():
        raise DataError(path, f"{where}: numbers must be finite")
    return values


def parse_ints(tokens: Sequence[str], path: Path, where: str) -> list[int]:
    """Integers from text; a DataError if a token is not an integer of 64 bits."""
    try:
        if any(len(token) > 20 for token in tokens):
            raise ValueError("number too long")
        values = [int(token) for token in tokens]
    except ValueError as error:
        raise DataError(path, f"{where}: expected whole numbers ({error})") from error
    if any(not -(2**63) <= value < 2**63 for value in values):
        raise DataError(path, f"{where}: whole numbers must fit 64 bits")
    return values
