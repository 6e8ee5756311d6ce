"""Reading files that nobody vouches for, and writing files that are never half there.

Everything that comes from outside is hostile until checked: sizes are compared with the file before anything is
allocated, names stay inside their folder, and every failure is a :class:`lsmgeo.errors.DataError` that names the file.
"""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, ParamSpec, TypeVar

import numpy as np

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from PIL import Image

__all__ = [
    "MAX_PIXELS",
    "AtomicFile",
    "atomic_file",
    "child",
    "has_alpha",
    "image_size",
    "parse_floats",
    "parse_ints",
    "read_bytes",
    "read_cut_out",
    "read_image",
    "read_text",
    "refuse_unreadable",
    "write_atomic",
    "write_point_cloud",
]

# Room for the 24 and 61 megapixels of today's cameras, below the size at which Pillow itself suspects a bomb.
MAX_PIXELS = 1 << 26
MAX_TEXT_BYTES = 1 << 28
MAX_NUMBER_LENGTH = 64


Options = ParamSpec("Options")
Content = TypeVar("Content")


def refuse_unreadable(read: Callable[Options, Content]) -> Callable[Options, Content]:
    """Make what the system says while a reader looks around (no permission, a name too long) a `DataError`."""

    @functools.wraps(read)
    def refusing(*args: Options.args, **options: Options.kwargs) -> Content:
        try:
            return read(*args, **options)
        except DataError:
            raise
        except OSError as error:
            path = args[0] if args else options["path"]
            raise DataError(str(path), f"cannot be read ({str(error)[:400]})") from error

    return refusing


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises:
        DataError: the file is missing, not a plain file, unreadable, or larger than ``limit``.
    """
    try:
        # A pipe or a device would block or never end, so only plain files are opened at all.
        if not path.is_file():
            raise DataError(path, "no such file")
        with path.open("rb") as stream:
            content = stream.read(limit + 1)
    except DataError:
        raise
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read ({error})") from error
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


def parse_floats(tokens: Sequence[str], path: Path, where: str) -> list[float]:
    """Finite numbers from text.

    Raises:
        DataError: a token is not a number, is not finite or is absurdly long.
    """
    try:
        if any(len(token) > MAX_NUMBER_LENGTH for token in tokens):
            raise ValueError("number too long")
        values = [float(token) for token in tokens]
    except ValueError as error:
        raise DataError(path, f"{where}: expected numbers ({error})") from error
    if not np.isfinite(values).all():
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


def image_size(path: Path, max_pixels: int = MAX_PIXELS) -> tuple[int, int]:
    """The (height, width) that a PNG or JPEG states in its header; no pixel is decoded.

    Raises:
        DataError: not a PNG or JPEG, or more than ``max_pixels``.
    """
    with _open_image(path, max_pixels) as image:
        return image.size[1], image.size[0]


def has_alpha(path: Path) -> bool:
    """Whether a PNG or JPEG says in its header that it has transparent pixels; none is decoded.

    Raises:
        DataError: as `image_size`.
    """
    with _open_image(path, MAX_PIXELS) as image:
        return image.mode in ("RGBA", "LA") or "transparency" in image.info


def read_image(path: Path, size: tuple[int, int] | None = None, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Read a PNG or JPEG photograph as 8-bit RGB.

    The pixels come as they are stored: an orientation that EXIF states is not applied, as COLMAP and instant-ngp do not
    apply it.

    Args:
        path: the image file.
        size: expected (height, width); checked before a pixel is decoded.
        max_pixels: largest number of pixels accepted.

    Returns:
        (H, W, 3) uint8.

    Raises:
        DataError: not a PNG or JPEG, another size than expected, too large, or damaged.
    """
    with _open_image(path, max_pixels) as image:
        _refuse_size(image, size, path)
        _refuse_deep(image, path)
        return np.array(image.convert("RGB"))


def read_cut_out(path: Path, size: tuple[int, int] | None = None, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Read a PNG or JPEG as 8-bit RGBA, alpha 255 where it has none; otherwise as `read_image`.

    Returns:
        (H, W, 4) uint8, not premultiplied.
    """
    with _open_image(path, max_pixels) as image:
        _refuse_size(image, size, path)
        _refuse_deep(image, path)
        return np.array(image.convert("RGBA"))


def _refuse_size(image: Image.Image, size: tuple[int, int] | None, path: Path) -> None:
    width, height = image.size
    if size is not None and (height, width) != tuple(size):
        reason = f"is {width} x {height} pixels (width x height); its camera expects {size[1]} x {size[0]}"
        raise DataError(path, reason)


def _refuse_deep(image: Image.Image, path: Path) -> None:
    if image.mode not in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK"):
        raise DataError(path, f"has mode {image.mode}; expected an 8-bit picture")


@contextlib.contextmanager
def _open_image(path: Path, max_pixels: int) -> Iterator[Image.Image]:
    from PIL import Image

    limit = 4096 + 8 * max_pixels
    try:
        # A pipe or a device would block or never end, so only plain files are opened at all.
        if not path.is_file():
            raise DataError(path, "no such file")
        if path.stat().st_size > limit:
            raise DataError(path, f"is larger than the limit of {limit} bytes")
        with warnings.catch_warnings():
            # Pillow warns of palettes and of second pictures in a JPEG, which are read as they should be.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # Sniffing among all of Pillow's formats would reach parsers (EPS, FITS) that run programs or expand files.
            # The file itself, not its bytes: of hundreds of photographs only the headers are read when a scene opens.
            with path.open("rb") as stream, Image.open(stream, formats=("PNG", "JPEG")) as image:
                width, height = image.size
                if width * height > max_pixels:
                    raise DataError(path, f"has {width} x {height} pixels, the limit is {max_pixels}")
                yield image
    except DataError:
        raise
    # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, zlib.error and more on damaged files.
    except Exception as error:
        raise DataError(path, f"is not a readable PNG or JPEG picture ({error})") from error


class AtomicFile:
    """A file being written by `atomic_file`: bytes go in, and only whole does it take its place."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path = path
        self._stream = stream

    def write(self, content: bytes) -> int:
        """Append bytes.

        Raises:
            DataError: the disk is full, and the like.
        """
        try:
            return self._stream.write(content)
        except OSError as error:
            raise DataError(self.path, f"cannot be written ({error})") from error

    def fileno(self) -> int:
        """The descriptor of the temporary file."""
        return self._stream.fileno()


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
    temporary = stream = None
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
            temporary = Path(name)
            stream = os.fdopen(descriptor, "wb")
        except OSError as error:
            raise DataError(path, f"cannot be written ({error})") from error
        yield AtomicFile(path, stream)
        try:
            stream.flush()
            os.fsync(stream.fileno())
            stream.close()
            # mkstemp makes a private file; a result should have the permissions that the user's umask gives.
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            temporary.replace(path)
            temporary = None
            _sync_folder(path.parent)
        except OSError as error:
            raise DataError(path, f"cannot be written ({error})") from error
    finally:
        if stream is not None:
            with contextlib.suppress(OSError):  # a full disk refuses the rest once more
                stream.close()
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Bring a folder's entries to the disk, where the system can: a rename is not kept before that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_atomic(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file so that it is either wholly there or not at all, as `atomic_file` does.

    Raises:
        DataError: the folder or the file cannot be written; nothing half-written stays.
    """
    with atomic_file(path) as stream:
        stream.write(content)
    return Path(path)


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
