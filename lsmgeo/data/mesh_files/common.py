"""What the parsers of mesh files share."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

__all__ = ["Parsed", "Unreadable", "fans", "floats", "text_lines", "with_colours"]

MAX_LINE = 1 << 16


class Unreadable(ValueError):
    """What is wrong with the bytes, in words for whoever has the file."""


class Parsed(NamedTuple):
    """What a file says, indices checked, nothing else.

    Attributes:
        vertices: (N, 3) float64.
        faces: (F, 3) int64.
        colours: (F, 3) float32 as written, NaN where the file gives a face no colour of its own.
        material: (F,) int32 into `materials`, -1 for none.
        materials: names of materials (Wavefront OBJ).
        libraries: names of the files that hold them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    material: np.ndarray
    materials: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()


def fans(sizes: np.ndarray, indices: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Polygons (their sizes, their vertices one after another) as fans of triangles, and whose each triangle is."""
    if len(sizes) and sizes.min() < 0:
        raise Unreadable("a face has a negative number of vertices")
    triangles = np.maximum(sizes - 2, 0)
    if int(triangles.sum()) > max_faces:
        raise Unreadable(f"has {int(triangles.sum())} triangles, the limit is {max_faces}")
    owner = np.repeat(np.arange(len(sizes)), triangles)
    first = (np.cumsum(sizes) - sizes)[owner]
    step = np.arange(len(owner)) - (np.cumsum(triangles) - triangles)[owner]
    return np.stack((indices[first], indices[first + step + 1], indices[first + step + 2]), 1), owner


def with_colours(
    vertices: np.ndarray, faces: np.ndarray, of_vertices: np.ndarray | None, of_faces: np.ndarray | None
) -> Parsed:
    """A mesh with the colours of its faces, or else the means of its vertices'."""
    colours = np.full((len(faces), 3), np.nan, np.float32)
    if of_faces is not None:
        colours = of_faces.astype(np.float32)
    elif of_vertices is not None and len(faces) and 0 <= faces.min() and faces.max() < len(vertices):
        colours = of_vertices[faces].mean(1).astype(np.float32)
    return Parsed(vertices, faces, colours, np.full(len(faces), -1, np.int32))


def text_lines(content: bytes) -> Iterator[bytes]:
    """Lines without what follows a #, without blanks around and without empty ones."""
    if b"\0" in content:
        raise Unreadable("is not a text file (it holds a zero byte)")
    for line in io.BytesIO(content):
        if len(line) > MAX_LINE:
            raise Unreadable(f"has a line of more than {MAX_LINE} bytes")
        line = line.split(b"#", 1)[0].strip()
        if line:
            yield line


def floats(tokens: list[bytes]) -> list[float]:
    """Numbers from text, of which one that is absurdly long is none."""
    if any(len(token) > 64 for token in tokens):
        raise Unreadable("has a number of more than 64 characters")
    return [float(token) for token in tokens]
