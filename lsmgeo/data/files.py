"""Reading files that nobody vouches for, and writing files and folders that are never half there.

Everything that comes from outside is hostile until checked: sizes are compared with the file before anything is
allocated, names stay inside their folder, and every failure is a :class:`lsmgeo.errors.DataError` that names the file.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import secrets
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

__all__ = [
    "AtomicFile",
    "atomic_file",
    "atomic_folder",
    "child",
    "clear_leftovers",
    "is_abandoned",
    "one_file",
    "parse_floats",
    "parse_ints",
    "plain_files",
    "read_bytes",
    "read_text",
    "refuse_unreadable",
    "refusing",
    "remove_folder",
    "write_atomic",
    "write_point_cloud",
]

MAX_TEXT_BYTES = 1 << 28
MAX_NUMBER_LENGTH = 64
# What a killed process leaves behind: on its way in, also as earlier versions called it, or on its way out.
_LEFTOVER = re.compile(r"\..+\.tmp|.+\.tmp-\d+|(?P<name>.+)\.old-\d+")


Options = ParamSpec("Options")
Content = TypeVar("Content")


@contextlib.contextmanager
def refusing(path: str | os.PathLike[str], what: str = "written") -> Iterator[None]:
    """Make what the system says in a block (no permission, a full disk, a name too long) a `DataError`.

    Args:
        path: the file or folder that is meant.
        what: what cannot be done with it.
    """
    try:
        yield
    except DataError:
        raise
    except OSError as error:
        raise DataError(path, f"cannot be {what} ({str(error)[:400]})") from error


def refuse_unreadable(read: Callable[Options, Content]) -> Callable[Options, Content]:
    """Make what the system says while a reader looks around a `DataError` of the path, its first argument."""

    @functools.wraps(read)
    def reading(*args: Options.args, **options: Options.kwargs) -> Content:
        with refusing(str(args[0] if args else options["path"]), "read"):
            return read(*args, **options)

    return reading


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises:
        DataError: the file is missing, not a plain file, unreadable, or larger than ``limit``.
    """
    with refusing(path, "read"):
        # A pipe or a device would block or never end, so only plain files are opened at all.
        if not path.is_file():
            raise DataError(path, "no such file")
        with path.open("rb") as stream:
            # Reading up to a limit takes memory for all of it.
            content = stream.read(min(os.fstat(stream.fileno()).st_size, limit) + 1)
    if len(content) > limit:
        raise DataError(path, f"is larger than the limit of {limit} bytes")
    return content


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file of at most ``limit`` bytes.

    Raises:
        DataError: as :func:`read_bytes`, or the content is not UTF-8 text.
    """
    try:
        # Windows puts a mark of byte order before its UTF-8.
        text = read_bytes(path, limit).decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise DataError(path, "is not a text file (invalid UTF-8)") from error
    if "\0" in text:
        raise DataError(path, "is not a text file (it holds a zero byte)")
    return text


def child(root: Path, name: str, source: Path) -> Path:
    """The path of ``name`` below ``root``, refusing every name that leads outside.

    Args:
        root: folder that must contain the result.
        name: relative name as written in ``source``.
        source: the file that gave the name, for the error message.

    Raises:
        DataError: the name is empty, absolute, not printable, or leads outside ``root`` (also through a link).
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
    """The plain files of a folder, sorted, that match the first of the patterns that any matches."""
    found = (sorted(path for path in folder.glob(pattern) if path.is_file()) for pattern in patterns)
    return next(filter(None, found), [])


def one_file(path: Path, *patterns: str) -> Path:
    """The path itself where it is no folder, else the one file in it, see `plain_files`.

    Raises:
        DataError: the folder holds none, or several.
    """
    files = plain_files(path, *patterns) if path.is_dir() else [path]
    if len(files) != 1:
        found = ", ".join(file.name for file in files[:5]) or "none"
        raise DataError(path, f"expected one file {' or '.join(patterns)}; found {found}: name the one meant")
    return files[0]


def parse_floats(tokens: Sequence[str], path: Path, where: str, *, finite: bool = True) -> list[float]:
    """Numbers from text, finite ones unless others are asked for.

    Raises:
        DataError: a token is not a number, is not finite or is absurdly long.
    """
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
    """Whole numbers from text that fit 64 bits.

    Raises:
        DataError: a token is not a whole number or needs more than 64 bits.
    """
    try:
        if any(len(token) > 20 for token in tokens):
            raise ValueError("number too long")
        values = [int(token) for token in tokens]
    except ValueError as error:
        raise DataError(path, f"{where}: expected whole numbers ({error})") from error
    if any(not -(2**63) <= value < 2**63 for value in values):
        raise DataError(path, f"{where}: whole numbers must fit 64 bits")
    return values


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
        with refusing(self.path):
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
        with refusing(path):
            _make_folder(path.parent)
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
            _lock(descriptor)
        yield AtomicFile(path, descriptor)
        with refusing(path):
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
        with refusing(path):
            if not replace and (path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir())))):
                raise DataError(path, "is there already and not an empty folder; name a new one")
            with contextlib.suppress(FileNotFoundError):
                is_current = path.samefile(".")
            if is_current:
                raise DataError(path, "is the current folder, which cannot be replaced; name a new one")
            _make_folder(path.parent)
            temporary.mkdir()
        yield temporary
        with refusing(path):
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
    with refusing(folder, "removed"):
        folder.replace(leftover)
        shutil.rmtree(leftover)


def clear_leftovers(folder: Path) -> None:
    """Remove what a killed process left behind. Only who alone writes into the folder may do this.

    Args:
        folder: it need not exist.

    Raises:
        DataError: the folder cannot be read, or a file not removed.
    """
    with refusing(folder):
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


def write_point_cloud(path: str | os.PathLike[str], positions: np.ndarray, colours: np.ndarray) -> Path:
    """Write coloured points as a binary PLY file, atomically.

    Args:
        path: the file to write.
        positions: (N, 3) world coordinates, N >= 1.
        colours: (N, 3) uint8 RGB.

    Returns:
        The path written.

    Raises:
        DataError: there is no point, shapes do not agree, a position is not finite, or the file cannot be written.
    """
    positions = np.asarray(positions)
    colours = np.asarray(colours)
    if positions.ndim != 2 or positions.shape[1:] != (3,) or len(positions) == 0:
        raise DataError(path, f"positions must be (N, 3) with N >= 1; got {positions.shape}")
    if colours.shape != positions.shape or colours.dtype != np.uint8:
        raise DataError(path, f"colours must be {positions.shape} uint8; got {colours.shape} {colours.dtype}")
    if not np.isfinite(positions).all():
        raise DataError(path, "positions must be finite")
    import trimesh

    content = trimesh.PointCloud(positions, colors=colours).export(file_type="ply")
    return write_atomic(path, content)
