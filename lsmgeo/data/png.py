"""PNG by OpenCV: written fast, and read strictly where size and kind are known.

OpenCV refuses what is damaged, but it guesses the kind from the content, allocates what the file announces, and
inflates what no pixel needs. So the container is looked at first: the header must be the expected one, every chunk must
end inside the file, and the data must have the length of the pixels. Ancillary chunks (animation, transparency,
comments) are not given to the decoder.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from os import PathLike

__all__ = ["DEPTH", "RGBA", "PngKind", "decode_png", "encode_png"]

SIGNATURE = b"\x89PNG\r\n\x1a\n"
LEVEL = 3
SHAPES = {np.dtype(np.uint8): ((), (3,), (4,)), np.dtype(np.uint16): ((),)}


class PngKind(NamedTuple):
    """What a PNG's pixels are: bits of a channel and PNG's colour type, and the array that they give."""

    bit_depth: int
    colour_type: int
    channels: tuple[int, ...]
    dtype: np.dtype


RGBA = PngKind(8, 6, (4,), np.dtype(np.uint8))
DEPTH = PngKind(16, 0, (), np.dtype(np.uint16))


def encode_png(pixels: np.ndarray) -> bytes:
    """Write a picture as PNG; equal pixels give equal bytes.

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

    if pixels.ndim < 2 or pixels.shape[2:] not in SHAPES.get(pixels.dtype, ()) or 0 in pixels.shape:
        raise ValueError(
            f"pixels must be (H, W), (H, W, 3) or (H, W, 4) uint8, or (H, W) uint16; got {pixels.shape} {pixels.dtype}"
        )
    pixels = np.ascontiguousarray(pixels)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    # Rows as differences to the row above: of all filters the smallest on flat shaded pictures and depth.
    options = (cv2.IMWRITE_PNG_COMPRESSION, LEVEL, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    return bytes(cv2.imencode(".png", pixels, options)[1])


def decode_png(
    content: bytes, size: tuple[int, int], kind: PngKind, path: str | PathLike[str], member: str = ""
) -> np.ndarray:
    """Read a PNG of known size and kind.

    Args:
        content: the file's bytes, from outside.
        size: (height, width) that it must have.
        kind: `RGBA` or `DEPTH`.
        path: the file that holds it, for errors.
        member: its name in that file, for errors.

    Returns:
        (H, W, 4) uint8 or (H, W) uint16.

    Raises:
        DataError: not a PNG, of another size or kind, interlaced, or damaged.
    """
    import cv2

    where = f"{member}: " if member else ""
    if content[:16] != SIGNATURE + b"\0\0\0\rIHDR" or len(content) < 33:
        raise DataError(path, f"{where}is not a PNG picture")
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
        raise DataError(path, f"{where}is a damaged picture ({error})") from error
    if pixels is None or pixels.shape != (*size, *kind.channels) or pixels.dtype != kind.dtype:
        raise DataError(path, f"{where}is a damaged picture")
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA) if kind.channels else pixels
