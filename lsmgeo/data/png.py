"""Two kinds of PNG, written fast and read strictly: 8-bit RGBA pictures and 16-bit grey depth.

Shards hold twenty pictures a shape, nearly all of them flat, and their pixels must be right or refused. Image
libraries accept more than that (a picture that ends early is grey from there on) and guess the file's kind from its
content. So the container is read here: signature, header against what is expected, check sums, and exactly as many
bytes as the header's size needs; nothing is allocated from a number in the file. Rows that other writers filtered
otherwise than we do are left to OpenCV, after all these checks.
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
# Rows as differences to the row above: of all filters the fastest to undo and, on flat shaded pictures, the smallest.
UP = 2
LEVEL = 3


class PngKind(NamedTuple):
    """What a PNG's pixels are."""

    bit_depth: int
    colour_type: int
    channels: int
    dtype: np.dtype


RGBA = PngKind(8, 6, 4, np.dtype(np.uint8))
DEPTH = PngKind(16, 0, 1, np.dtype(np.uint16))


def encode_png(pixels: np.ndarray) -> bytes:
    """Write a picture as PNG; equal pixels give equal bytes.

    Args:
        pixels: (H, W, 4) uint8 or (H, W) uint16.

    Returns:
        The file's content.

    Raises:
        ValueError: an array of another shape or dtype.

    Example:
        >>> content = encode_png(np.full((48, 64), 40_000, np.uint16))
        >>> content[1:4], int(decode_png(content, (48, 64), DEPTH, "memory")[0, 0])
        (b'PNG', 40000)
    """
    kind = next((k for k in (RGBA, DEPTH) if pixels.dtype == k.dtype and pixels.ndim == (3 if k is RGBA else 2)), None)
    if kind is None or pixels.shape[2:] != ((4,) if kind is RGBA else ()) or 0 in pixels.shape:
        raise ValueError(f"pixels must be (H, W, 4) uint8 or (H, W) uint16; got {pixels.shape} {pixels.dtype}")
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels.astype(kind.dtype.newbyteorder(">"), copy=False)).view(np.uint8)
    rows = rows.reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    return _contain(zlib.compress(filtered.tobytes(), LEVEL), (height, width), kind)


def _contain(data: bytes, size: tuple[int, int], kind: PngKind) -> bytes:
    """The file that holds these compressed pixels and nothing else."""
    header = struct.pack(">IIBBBBB", size[1], size[0], kind.bit_depth, kind.colour_type, 0, 0, 0)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(name)))


def decode_png(
    content: bytes,
    size: tuple[int, int],
    kind: PngKind,
    path: str | PathLike[str],
    member: str = "",
    *,
    extras: bool = False,
) -> np.ndarray:
    """Read a PNG of known size and kind.

    Args:
        content: the file's bytes, from outside.
        size: (height, width) that it must have.
        kind: `RGBA` or `DEPTH`.
        path: the file that holds it, for errors.
        member: its name in that file, for errors.
        extras: step over what PNG calls ancillary, such as resolution, gamma and comments, instead of refusing it.

    Returns:
        (H, W, 4) uint8, its memory perhaps in planes, or (H, W) uint16.

    Raises:
        DataError: not a PNG, of another size or kind, interlaced, damaged, or with more or less data than its size
            needs.
    """
    where = f"{member}: " if member else ""
    data = _image_data(content, size, kind, path, where, extras=extras)
    height, width = size
    stride = 1 + width * kind.channels * kind.dtype.itemsize
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(data, height * stride + 1)
    except zlib.error as error:
        raise DataError(path, f"{where}is a damaged picture ({error})") from error
    if len(raw) != height * stride or not inflate.eof:
        raise DataError(path, f"{where}holds more or less data than {width} x {height} pixels need")
    rows = np.frombuffer(raw, np.uint8).reshape(height, stride)
    filters = rows[:, 0]
    if not (filters <= 4).all():
        raise DataError(path, f"{where}is a damaged picture (an unknown filter)")
    if not (filters == UP).all():
        return _by_opencv(_contain(data, size, kind), size, kind, path, where)
    if kind is RGBA:
        # Into planes, which is where all readers want the colours; it takes no longer.
        planes = np.empty((4, height, width), np.uint8)
        np.add.accumulate(rows[:, 1:].reshape(height, width, 4).transpose(2, 0, 1), axis=1, dtype=np.uint8, out=planes)
        return planes.transpose(1, 2, 0)
    pixels = np.empty((height, stride - 1), np.uint8)
    np.add.accumulate(rows[:, 1:], axis=0, dtype=np.uint8, out=pixels)
    return pixels.view(">u2").astype(np.uint16)


def _image_data(
    content: bytes, size: tuple[int, int], kind: PngKind, path: str | PathLike[str], where: str, *, extras: bool
) -> bytes:
    """The compressed pixels of a PNG whose container has been checked."""
    if not content.startswith(SIGNATURE):
        raise DataError(path, f"{where}is not a PNG picture")
    header, parts, offset, last = b"", [], len(SIGNATURE), b""
    while last != b"IEND":
        if offset + 12 > len(content):
            raise DataError(path, f"{where}ends inside a PNG chunk")
        length, name = struct.unpack_from(">I4s", content, offset)
        if length > len(content) - offset - 12:
            raise DataError(path, f"{where}ends inside a PNG chunk")
        chunk = content[offset + 8 : offset + 8 + length]
        if struct.unpack_from(">I", content, offset + 8 + length)[0] != zlib.crc32(chunk, zlib.crc32(name)):
            raise DataError(path, f"{where}is a damaged picture (a wrong check sum)")
        # Anything else could change what the pixels mean (palettes, transparency, animation), but for a small first
        # letter, by which PNG marks what may be stepped over.
        ancillary = extras and name[:1].islower()
        if not ancillary and name not in (b"IDAT", b"IEND") if last else name != b"IHDR":
            raise DataError(path, f"{where}holds a PNG chunk {name!r}; expected IHDR, IDAT and IEND alone")
        if name == b"IHDR":
            header = chunk
            _check_header(header, size, kind, path, where)
        elif name == b"IDAT":
            parts.append(chunk)
        offset, last = offset + 12 + length, name
    if offset != len(content):
        raise DataError(path, f"{where}holds {len(content) - offset} bytes after its last PNG chunk")
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _check_header(header: bytes, size: tuple[int, int], kind: PngKind, path: str | PathLike[str], where: str) -> None:
    if len(header) != 13:
        raise DataError(path, f"{where}holds a PNG header of {len(header)} bytes")
    width, height, *rest = struct.unpack(">IIBBBBB", header)
    if (height, width) != tuple(size):
        raise DataError(path, f"{where}is {width} x {height} pixels (width x height); expected {size[1]} x {size[0]}")
    if rest != [kind.bit_depth, kind.colour_type, 0, 0, 0]:
        raise DataError(
            path,
            f"{where}has bit depth {rest[0]}, colour type {rest[1]}, interlacing {rest[4]}; "
            f"expected {kind.bit_depth}, {kind.colour_type}, 0",
        )


def _by_opencv(
    content: bytes, size: tuple[int, int], kind: PngKind, path: str | PathLike[str], where: str
) -> np.ndarray:
    import cv2

    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DataError(path, f"{where}is a damaged picture ({error})") from error
    expected = (*size, 4) if kind is RGBA else tuple(size)
    if pixels is None or pixels.shape != expected or pixels.dtype != kind.dtype:
        raise DataError(path, f"{where}is a damaged picture")
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA) if kind is RGBA else pixels
