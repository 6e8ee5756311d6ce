"""Triangles out of the bytes of a mesh file, whoever made it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .common import Parsed, Unreadable
from .gltf import parse_glb, parse_gltf
from .ply import parse_ply
from .stl import parse_stl
from .text import parse_obj, parse_off

__all__ = ["KINDS", "parse"]

FARTHEST = 1e15

_PARSERS: dict[str, Callable[[bytes, int], Parsed]] = {
    "glb": parse_glb,
    "gltf": parse_gltf,
    "obj": parse_obj,
    "off": parse_off,
    "ply": parse_ply,
    "stl": parse_stl,
}
KINDS = tuple(_PARSERS)


def parse(content: bytes, kind: str, max_faces: int) -> Parsed:
    """Read the bytes of a mesh file.

    Args:
        content: the whole file.
        kind: "obj", "ply", "off", "stl", "glb" or "gltf".
        max_faces: most triangles accepted.

    Raises:
        Unreadable: whatever is wrong.
    """
    try:
        with np.errstate(all="ignore"):
            parsed = _PARSERS[kind](content, max_faces)
    except Unreadable:
        raise
    # Whatever a damaged file provokes beyond the checks: numbers that are none, bytes that end, nesting without end.
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, AttributeError, RecursionError) as error:
        raise Unreadable(f"is damaged ({type(error).__name__}: {str(error)[:200]})") from error
    except MemoryError as error:
        raise Unreadable("needs more memory than there is") from error
    vertices, faces = parsed.vertices, parsed.faces
    if not len(faces):
        raise Unreadable("holds no face")
    if len(faces) > max_faces:
        raise Unreadable(f"has {len(faces)} faces, the limit is {max_faces}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise Unreadable(f"a face names vertex {faces.min() if faces.min() < 0 else faces.max()} of {len(vertices)}")
    if not np.isfinite(vertices).all() or not (np.abs(vertices) <= FARTHEST).all():
        raise Unreadable("vertices must be finite and at most 1e15 from 0")
    return parsed
