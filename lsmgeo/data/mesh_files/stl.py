"""Stereolithography files."""

from __future__ import annotations

from array import array

import numpy as np

from .common import Parsed, Unreadable, floats, text_lines, with_colours

__all__ = ["parse_stl"]

RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


def parse_stl(content: bytes, max_faces: int) -> Parsed:
    """Stereolithography, binary (its size must be what its count says) or text."""
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if count >= 0 and len(content) == 84 + 50 * count:
        if count > max_faces:
            raise Unreadable(f"has {count} faces, the limit is {max_faces}")
        rows = np.frombuffer(content, RECORD, offset=84)
        points = rows["corners"].astype(np.float64).reshape(-1, 3)
    elif content.lstrip()[:5] == b"solid":
        found = array("d")
        for line in text_lines(content):
            tokens = line.split()
            if tokens[0] == b"vertex":
                if len(tokens) != 4:
                    raise Unreadable("a vertex does not have 3 numbers")
                found.extend(floats(tokens[1:]))
        points = np.array(found, np.float64).reshape(-1, 3)
        if len(points) % 3:
            raise Unreadable("ends inside a triangle")
    else:
        raise Unreadable("is not an STL file (neither text nor as long as its count says)")
    faces = np.arange(len(points), dtype=np.int64).reshape(-1, 3)
    return with_colours(points, faces, None, None)
