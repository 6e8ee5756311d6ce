"""Image files: PNG and JPEG are read as RGB or RGBA, PNG is written, and PNG of known size and kind is read.

OpenCV refuses damaged files, but it guesses the kind from the content, allocates what the file announces, and inflates
data beyond the pixels. So the container is checked first: the header must be the expected one, every chunk must end
inside the file, and the data must have the length of the pixels. Ancillary chunks (animation, transparency, comments)
are not passed to the decoder.
"""

from __future__ import annotations

import contextlib
import struct
import warnings
import zlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from os import PathLike
    from pathlib import Path

    from PIL import Image

__all__ = [
    "DEPTH",
    "MAX_IMAGE_BYTES",
    "MAX_PIXELS",
    "RGBA",
    "SUFFIXES",
    "PngKind",
    "decode_png",
    "encode_png",
    "has_alpha",
    "image_size",
    "read_cut_out",
    "read_image",
]

# Above the 61 megapixels of today's cameras, below the size at which Pillow suspects a decompression bomb.
MAX_PIXELS = 1 << 26
MAX_IMAGE_BYTES = 4096 + 8 * MAX_PIXELS
# Suffixes of image files, in lower case.
SUFFIXES = (".png", ".jpg", ".jpeg")
SIGNATURE = b"\x89PNG\r\n\x1a\n"
LEVEL = 3
ENCODED = {np.dtype(np.uint8): ((), (3,), (4,)), np.dtype(np.uint16): ((),)}


class PngKind(NamedTuple):
    """The pixels of a PNG: bits per channel, PNG's colour type, and channels and dtype of the array."""

    bit_depth: int
    colour_type: int
    channels: tuple[int, ...]
    dtype: np.dtype


RGBA = PngKind(8, 6, (4,), np.dtype(np.uint8))
DEPTH = PngKind(16, 0, (), np.dtype(np.uint16))


def encode_png(pixels: np.ndarray) -> bytes:
    """Encode an image as PNG; equal pixels give equal bytes.

    Args:
        pixels: (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA uint8, or (H, W) uint16.

    Returns:
        The file's content.

    Raises:
        ValueError: an array of another shape or dtype.

    Example:
        >>> content = encode_png(np.full((48, 64), 40_000, np.uint16))
        >>> content[1:4], int(decode_png(content, (48, 64), DEPTH, "memory")[0, 0])
        (b'PNG', 40000)
    """
    import cv2

    if pixels.ndim < 2 or pixels.shape[2:] not in ENCODED.get(pixels.dtype, ()) or 0 in pixels.shape:
        raise ValueError(
            f"pixels must be (H, W), (H, W, 3) or (H, W, 4) uint8, or (H, W) uint16; got {pixels.shape} {pixels.dtype}"
        )
    pixels = np.ascontiguousarray(pixels)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    # Of all filters this one (the difference to the row above) gives the smallest files of shaded images and depth.
    options = (cv2.IMWRITE_PNG_COMPRESSION, LEVEL, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    return bytes(cv2.imencode(".png", pixels, options)[1])


def decode_png(
    content: bytes, size: tuple[int, int], kind: PngKind, path: str | PathLike[str], member: str = ""
) -> np.ndarray:
    """Read a PNG of known size and kind.

    Args:
        content: the file's bytes, untrusted.
        size: the expected (height, width).
        kind: `RGBA` or `DEPTH`.
        path: the file that contains it, for errors.
        member: its name in that file, for errors.

    Returns:
        (H, W, 4) uint8 or (H, W) uint16.

    Raises:
        DataError: not a PNG, of another size or kind, interlaced, or damaged.
    """
    import cv2

    where = f"{member}: " if member else ""
    if content[:16] != SIGNATURE + b"\0\0\0\rIHDR" or len(content) < 33:
        raise DataError(path, f"{where}is not a PNG image")
    width, height, *rest = struct.unpack_from(">IIBBBBB", content, 16)
    if (height, width) != tuple(size):
        raise DataError(path, f"{where}is {width} x {height} pixels (width x height); expected {size[1]} x {size[0]}")
    if rest != [kind.bit_depth, kind.colour_type, 0, 0, 0]:
        reason = f"has bit depth {rest[0]}, colour type {rest[1]}, interlacing {rest[4]}"
        raise DataError(path, f"{where}{reason}; expected {kind.bit_depth}, {kind.colour_type}, 0")
    chunks, data, offset = [SIGNATURE], [], len(SIGNATURE)
    while offset < len(content):
        end = offset + 12 + int.from_bytes(content[offset : offset + 4])
        if end > len(content):
            raise DataError(path, f"{where}ends inside a PNG chunk")
        name = content[offset + 4 : offset + 8]
        if name in (b"IHDR", b"IDAT", b"IEND"):
            chunks.append(content[offset:end])
        if name == b"IDAT":
            data.append(content[offset + 8 : end - 4])
        offset = end
    needed = height * (1 + width * int(np.prod(kind.channels)) * kind.dtype.itemsize)
    try:
        if len(zlib.decompressobj().decompress(b"".join(data), needed + 1)) != needed:
            raise DataError(path, f"{where}holds more or less data than {width} x {height} pixels need")
        pixels = cv2.imdecode(np.frombuffer(b"".join(chunks), np.uint8), cv2.IMREAD_UNCHANGED)
    except (zlib.error, cv2.error) as error:
        raise DataError(path, f"{where}is a damaged image ({error})") from error
    if pixels is None or pixels.shape != (*size, *kind.channels) or pixels.dtype != kind.dtype:
        raise DataError(path, f"{where}is a damaged image")
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA) if kind.channels else pixels


def image_size(path: Path) -> tuple[int, int]:
    """The (height, width) in the header of a PNG or JPEG; no pixel is decoded.

    Raises:
        DataError: not a PNG or JPEG, or more than `MAX_PIXELS`.
    """
    with _open_image(path) as image:
        return image.size[1], image.size[0]


def has_alpha(path: Path) -> bool:
    """Whether a PNG or JPEG has transparency by its header; a DataError as for `image_size`."""
    with _open_image(path) as image:
        return image.mode in ("RGBA", "LA") or "transparency" in image.info


def read_image(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a PNG or JPEG image as 8-bit RGB.

    The pixels are returned as stored: like COLMAP and instant-ngp, it does not apply the orientation in EXIF.

    Args:
        path: the image file.
        size: the expected (height, width), checked before a pixel is decoded.

    Returns:
        (H, W, 3) uint8.

    Raises:
        DataError: not a PNG or JPEG, another size than expected, too large, or damaged.
    """
    return _read(path, size, "RGB")


def read_cut_out(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """(H, W, 4) uint8 RGBA of a PNG or JPEG, not premultiplied, alpha 255 where it has none; see `read_image`."""
    return _read(path, size, "RGBA")


def _read(path: Path, size: tuple[int, int] | None, mode: str) -> np.ndarray:
    with _open_image(path) as image:
        width, height = image.size
        if size is not None and (height, width) != tuple(size):
            reason = f"is {width} x {height} pixels (width x height); its camera expects {size[1]} x {size[0]}"
            raise DataError(path, reason)
        if image.mode not in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK"):
            raise DataError(path, f"has mode {image.mode}; expected an 8-bit image")
        return np.array(image.convert(mode))


@contextlib.contextmanager
def _open_image(path: Path) -> Iterator[Image.Image]:
    from PIL import Image

    try:
        # A pipe or a device could block or never end, so only regular files are opened.
        if not path.is_file():
            raise DataError(path, "no such file")
        if path.stat().st_size > MAX_IMAGE_BYTES:
            raise DataError(path, f"is larger than the limit of {MAX_IMAGE_BYTES} bytes")
        with warnings.catch_warnings():
            # Pillow warns of palettes and of second images in a JPEG, which are read correctly.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # Pillow's other formats include parsers (EPS, FITS) that run programs or expand files. The file is passed,
            # not its bytes: opening a scene reads only the headers of hundreds of images.
            with path.open("rb") as stream, Image.open(stream, formats=("PNG", "JPEG")) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise DataError(path, f"has {width} x {height} pixels, the limit is {MAX_PIXELS}")
                yield image
    except DataError:
        raise
    # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, zlib.error and more on damaged files.
    except Exception as error:
        raise DataError(path, f"is not a readable PNG or JPEG image ({error})") from error
