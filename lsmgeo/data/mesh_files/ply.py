"""Polygon files (PLY), text and binary."""

from __future__ import annotations

import struct
from itertools import islice
from typing import NamedTuple

import numpy as np

from .common import Parsed, Unreadable, fans, floats, text_lines, with_colours

__all__ = ["parse_ply"]

MAX_HEADER = 1 << 16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
LISTS = ("vertex_indices", "vertex_index")


class Property(NamedTuple):
    """A property: its numpy type code, and of a list also that of its length."""

    name: str
    kind: str
    length: str | None


class Element(NamedTuple):
    """What the header says of an element."""

    name: str
    rows: int
    properties: tuple[Property, ...]

    def smallest(self) -> int:
        """Fewest bytes of one row, its lists empty."""
        return sum(int((item.length or item.kind)[1]) for item in self.properties)


class Table(NamedTuple):
    """The rows of an element: its scalars by name, and of its polygons the sizes and all indices in a row."""

    scalars: dict[str, np.ndarray]
    sizes: np.ndarray
    indices: np.ndarray


def parse_ply(content: bytes, max_faces: int) -> Parsed:
    """Vertices, polygons and their colours (red, green, blue of the faces, or else of the vertices)."""
    form, elements, body = _header(content)
    tables: dict[str, Table] = {}
    names = [element.name for element in elements]
    if names.count("vertex") != 1 or names.count("face") != 1:
        raise Unreadable(f"must have the elements vertex and face; its header names {names[:8]}")
    rows = text_lines(body) if form == "ascii" else None
    offset = 0
    for element in elements:
        least = 2 * len(element.properties) if form == "ascii" else element.smallest()
        if element.rows * max(least, 1) > len(body) + 1:
            raise Unreadable(f"announces {element.rows} of {element.name}, more than it can hold")
        if element.name == "face" and element.rows > max_faces:
            raise Unreadable(f"has {element.rows} faces, the limit is {max_faces}")
        if rows is not None:
            table = _text_rows(element, list(islice(rows, element.rows)))
        else:
            table, offset = _binary_rows(element, body, offset, "<" if form == "binary_little_endian" else ">")
        tables[element.name] = table
        if len(tables) == len({*names}) or {"vertex", "face"} <= tables.keys():
            break
    vertex, face = tables["vertex"], tables["face"]
    vertices = np.stack([vertex.scalars[axis].astype(np.float64) for axis in "xyz"], 1)
    faces, owner = fans(face.sizes, face.indices, max_faces)
    of_faces = _colours(face.scalars)
    return with_colours(vertices, faces, _colours(vertex.scalars), None if of_faces is None else of_faces[owner])


def _header(content: bytes) -> tuple[str, list[Element], bytes]:
    head = content[:MAX_HEADER]
    end = head.find(b"end_header")
    if not head.startswith((b"ply\n", b"ply\r")) or end < 0:
        raise Unreadable("is not a PLY file (no header from ply to end_header)")
    stop = content.find(b"\n", end)
    form, elements = "", []
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            form = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append(Element(words[1], int(words[2][:20]), ()))
        elif words[0] == "property" and elements and len(words) in (3, 5):
            if (len(words) == 5) != (words[1] == "list") or not {*words[1:-1]} - {"list"} <= TYPES.keys():
                raise Unreadable(f"has the unknown property {line[:80]!r}")
            length = TYPES[words[2]] if len(words) == 5 else None
            item = Property(words[-1], TYPES[words[-2]], length)
            if length is not None and length[0] == "f":
                raise Unreadable(f"has a list whose length is no whole number: {line[:80]!r}")
            elements[-1] = elements[-1]._replace(properties=(*elements[-1].properties, item))
        else:
            raise Unreadable(f"has the unknown header line {line[:80]!r}")
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise Unreadable(f"has the unknown format {form[:40]!r}")
    if any(element.rows < 0 or len(element.properties) > 64 for element in elements) or len(elements) > 16:
        raise Unreadable("has an impossible header (a negative count, or too many properties)")
    for element in elements:
        found = [item.name for item in element.properties]
        if len(set(found)) != len(found):
            raise Unreadable(f"names a property of {element.name} twice")
    return form, elements, content[stop + 1 :] if stop >= 0 else b""


def _text_rows(element: Element, rows: list[bytes]) -> Table:
    if len(rows) < element.rows:
        raise Unreadable(f"ends after {len(rows)} of {element.rows} rows of {element.name}")
    scalars: dict[str, list[float]] = {item.name: [] for item in element.properties if item.length is None}
    sizes: list[int] = []
    indices: list[int] = []
    for row in rows:
        tokens = row.split()
        place = 0
        for item in element.properties:
            if item.length is None:
                scalars[item.name].extend(floats(tokens[place : place + 1]))
                place += 1
            else:
                size = int(tokens[place][:20])
                if size < 0 or place + 1 + size > len(tokens):
                    raise Unreadable(f"a row of {element.name} ends inside a list")
                if item.name in LISTS:
                    sizes.append(size)
                    indices.extend(int(token[:20]) for token in tokens[place + 1 : place + 1 + size])
                place += 1 + size
        if place > len(tokens):
            raise Unreadable(f"a row of {element.name} has {len(tokens)} numbers, too few")
    kinds = {item.name: item.kind for item in element.properties}
    columns = {name: _typed(values, kinds[name]) for name, values in scalars.items()}
    return Table(columns, np.array(sizes, np.int64), np.array(indices, np.int64))


def _typed(values: list[float], kind: str) -> np.ndarray:
    """Numbers from text as the type that the header gives them, by which colours know their range."""
    column = np.array(values, np.float64)
    return column if kind[0] == "f" else np.clip(column, 0, 255).astype(np.uint8) if kind == "u1" else column


def _binary_rows(element: Element, body: bytes, offset: int, order: str) -> tuple[Table, int]:
    """The rows from ``offset`` on, and where they end."""
    # Nearly all files have scalars alone, or triangles alone: one table, read at once.
    fields: list[tuple] = []
    for number, item in enumerate(element.properties):
        if item.length is not None:
            fields.append((f"n{number}", order + item.length))
        fields.append((f"p{number}", order + item.kind, *((3,) if item.length is not None else ())))
    record = np.dtype(fields)
    if len(body) - offset >= element.rows * record.itemsize:
        table = np.frombuffer(body, record, element.rows, offset)
        lists = [number for number, item in enumerate(element.properties) if item.length is not None]
        if all((table[f"n{number}"] == 3).all() for number in lists):
            scalars = {p.name: table[f"p{k}"] for k, p in enumerate(element.properties) if p.length is None}
            polygons = [table[f"p{k}"] for k in lists if element.properties[k].name in LISTS]
            indices = polygons[0].astype(np.int64).reshape(-1) if polygons else np.zeros(0, np.int64)
            return Table(scalars, np.full(len(indices) // 3, 3), indices), offset + element.rows * record.itemsize
    return _mixed_rows(element, body, offset, order)


def _mixed_rows(element: Element, body: bytes, offset: int, order: str) -> tuple[Table, int]:
    """Rows of differing length, one at a time."""
    scalars: dict[str, list[float]] = {item.name: [] for item in element.properties if item.length is None}
    sizes: list[int] = []
    pieces: list[bytes] = []
    kind = "u4"
    for _ in range(element.rows):
        for item in element.properties:
            code = item.length or item.kind
            if offset + int(code[1]) > len(body):
                raise Unreadable(f"ends inside {element.name}")
            (value,) = struct.unpack_from(order + CODES[code], body, offset)
            offset += int(code[1])
            if item.length is None:
                scalars[item.name].append(value)
                continue
            span = value * int(item.kind[1])
            if span < 0 or offset + span > len(body):
                raise Unreadable(f"a list of {element.name} has {value} entries, more than are left")
            if item.name in LISTS:
                kind = item.kind
                sizes.append(value)
                pieces.append(body[offset : offset + span])
            offset += span
    kinds = {item.name: item.kind for item in element.properties}
    columns = {name: np.array(values, kinds[name]) for name, values in scalars.items()}
    indices = np.frombuffer(b"".join(pieces), order + kind).astype(np.int64)
    return Table(columns, np.array(sizes, np.int64), indices), offset


def _colours(scalars: dict[str, np.ndarray]) -> np.ndarray | None:
    """(rows, 3) red, green and blue in [0, 1], if they are there."""
    if not {"red", "green", "blue"} <= scalars.keys():
        return None
    columns = [scalars[name] for name in ("red", "green", "blue")]
    scale = {"u": {1: 255.0, 2: 65535.0}}.get(columns[0].dtype.kind, {}).get(columns[0].dtype.itemsize, 1.0)
    return np.stack([column.astype(np.float64) / scale for column in columns], 1)
