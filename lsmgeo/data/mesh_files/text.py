"""Mesh files that are text: Wavefront OBJ and the Object File Format."""

from __future__ import annotations

from array import array

import numpy as np

from .common import Parsed, Unreadable, fans, floats, text_lines, with_colours

__all__ = ["parse_obj", "parse_off"]

MAX_NAME = 512
MAX_NAMES = 1 << 16


def parse_obj(content: bytes, max_faces: int) -> Parsed:
    """Wavefront OBJ: v (with colours, if any), f, usemtl and mtllib; all else is passed over."""
    points, tints, corners, sizes, uses = array("d"), array("d"), array("q"), array("q"), array("i")
    names: dict[str, int] = {}
    libraries: list[str] = []
    current, coloured = -1, 0
    for line in text_lines(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        word, _, rest = line.partition(b" ") if b"\t" not in line else line.replace(b"\t", b" ").partition(b" ")
        if word == b"v":
            values = floats(rest.split())
            if len(values) not in (3, 4, 6, 7):
                raise Unreadable(f"a vertex has {len(values)} numbers; expected x, y, z or x, y, z, r, g, b")
            points.extend(values[:3])
            coloured += len(values) >= 6
            tints.extend(values[-3:] if len(values) >= 6 else (np.nan,) * 3)
        elif word == b"f":
            tokens = rest.split()
            count = len(points) // 3
            for token in tokens:
                index = int(token.split(b"/", 1)[0][:20])
                # Counted from 1, or backwards from the newest vertex; a face may name only vertices before it.
                if index == 0 or abs(index) > count:
                    raise Unreadable(f"a face names vertex {index}, of {count} so far")
                corners.append(index - 1 if index > 0 else count + index)
            sizes.append(len(tokens))
            uses.append(current)
            if len(sizes) > max_faces:
                raise Unreadable(f"has more faces than the limit of {max_faces}")
        elif word in (b"usemtl", b"mtllib"):
            name = rest.strip().decode("utf-8", "replace")
            if len(name) > MAX_NAME or len(names) + len(libraries) > MAX_NAMES:
                raise Unreadable("names too many materials, or one too long")
            if word == b"usemtl":
                current = names.setdefault(name, len(names))
            elif name not in libraries:
                libraries.append(name)
    vertices = np.array(points, np.float64).reshape(-1, 3)
    faces, owner = fans(np.array(sizes, np.int64), np.array(corners, np.int64), max_faces)
    tint = np.array(tints, np.float64).reshape(-1, 3) if coloured else None
    parsed = with_colours(vertices, faces, tint, None)
    material = np.array(uses, np.int32)[owner]
    return parsed._replace(material=material, materials=tuple(names), libraries=tuple(libraries))


def parse_off(content: bytes, max_faces: int) -> Parsed:
    """Object File Format, as text: OFF, or COFF with colours at the vertices; colours after a face's vertices."""
    lines = text_lines(content)
    head = next(lines, b"").split()
    if not head or head[0] not in (b"OFF", b"COFF"):
        raise Unreadable("is not an OFF file (OFF or COFF must stand first)")
    counts = [int(token[:20]) for token in (head[1:] or next(lines, b"").split())]
    if len(counts) not in (2, 3) or min(counts[:2]) < 0 or 2 * (counts[0] + counts[1]) > len(content):
        raise Unreadable(f"announces {counts[:3]} vertices, faces and edges, more than it can hold")
    if counts[1] > max_faces:
        raise Unreadable(f"has {counts[1]} faces, the limit is {max_faces}")
    rows = [floats(next(lines, b"").split()) for _ in range(counts[0])]
    width = 7 if head[0] == b"COFF" else 3
    if any(len(row) != width for row in rows):
        raise Unreadable(f"a vertex does not have {width} numbers")
    table = np.array(rows, np.float64).reshape(-1, width)
    sizes, corners, colours = array("q"), array("q"), array("d")
    for _ in range(counts[1]):
        tokens = next(lines, b"").split()
        size = int(tokens[0][:20])
        if size < 0 or len(tokens) < 1 + size:
            raise Unreadable(f"a face announces {size} vertices and has {len(tokens) - 1} numbers")
        sizes.append(size)
        corners.extend(int(token[:20]) for token in tokens[1 : 1 + size])
        tint = floats(tokens[1 + size :])
        scale = 1.0 if any(b"." in token for token in tokens[1 + size :]) else 255.0
        colours.extend([value / scale for value in tint[:3]] if len(tint) in (3, 4) else (np.nan,) * 3)
    faces, owner = fans(np.array(sizes, np.int64), np.array(corners, np.int64), max_faces)
    of_faces = np.array(colours, np.float64).reshape(-1, 3)[owner]
    tinted = table[:, 3:6] / (255.0 if table.size and table[:, 3:6].max() > 1 else 1.0) if width == 7 else None
    return with_colours(table[:, :3], faces, tinted, None if width == 7 else of_faces)
