"""Parses triangles and plain colours from the bytes of untrusted mesh files; imports nothing of this package.

PLY and glTF are parsed by trimesh, after a check of what they announce. The other formats are parsed here: trimesh
misreads vertex 0 of an OBJ and negative vertex numbers, reorders its faces by material, and accepts truncated faces of
an OFF.
"""

from __future__ import annotations

import base64
import io
import json
import re
import warnings
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

__all__ = ["KINDS", "parse_mesh"]

MAX_LINE = 1 << 16
MAX_NODES = 1 << 16
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
# Bytes of glTF's components, numbers of its types, and extensions that do not change triangles.
BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
DRACO = "KHR_draco_mesh_compression"
HARMLESS = ("KHR_materials_", "KHR_texture_transform", "KHR_lights_punctual")

HEADER = re.compile(
    rb"ply\r?\nformat (ascii|binary_little_endian|binary_big_endian) 1\.0\s*\n"
    rb"((comment|obj_info|element|property)\b[^\n]*\n)*"
)

Materials = Mapping[str, Sequence[float]]


class Unreadable(ValueError):
    """The reason why a file cannot be read."""


class Parsed(NamedTuple):
    """The content of a file: vertices (N, 3), faces (F, 3), indices unchecked, and colours (F, 3), NaN for none."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray


def parse_mesh(content: bytes, kind: str, max_faces: int, materials: Materials) -> dict[str, np.ndarray]:
    """Parse the bytes of a mesh file.

    Args:
        content: of the file.
        kind: one of `KINDS`.
        max_faces: the largest number of triangles accepted.
        materials: the diffuse colours of an OBJ file's materials.

    Returns:
        The fields of `Parsed`.

    Raises:
        ValueError: the file cannot be read, for this reason.
    """
    try:
        # NumPy warns of text that is not all numbers.
        with np.errstate(all="ignore"), warnings.catch_warnings(action="error", category=DeprecationWarning):
            parsed = PARSERS[kind](content, max_faces, materials)
    except Unreadable:
        raise
    except MemoryError as error:
        raise Unreadable("needs more memory than available") from error
    # Damaged files raise many kinds of errors.
    except Exception as error:
        raise Unreadable(f"is damaged ({type(error).__name__}: {str(error)[:200]})") from error
    return parsed._asdict()


def _obj(content: bytes, max_faces: int, materials: Materials) -> Parsed:
    """Wavefront OBJ: v (with colours, if any), f and usemtl; all else is ignored."""
    points, tints, corners, sizes, owners = array("d"), array("d"), array("q"), array("q"), array("d")
    colour: Sequence[float] = (np.nan,) * 3
    for line in _text_lines(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")):
        word, *tokens = line.split(None, 1)
        rest = tokens[0] if tokens else b""
        if word == b"v":
            values = _floats(rest.split())
            if len(values) not in (3, 4, 6, 7):
                raise Unreadable(f"a vertex has {len(values)} numbers; expected x, y, z or x, y, z, r, g, b")
            points.extend(values[:3])
            tints.extend(values[-3:] if len(values) >= 6 else (np.nan,) * 3)
        elif word == b"f":
            count, before = len(points) // 3, len(corners)
            for token in rest.split():
                index = int(token.split(b"/", 1)[0][:20])
                # Counted from 1, or backwards from the last vertex; all vertices of a face precede it.
                if index == 0 or abs(index) > count:
                    raise Unreadable(f"a face names vertex {index}, of {count} so far")
                corners.append(index - 1 if index > 0 else count + index)
            sizes.append(len(corners) - before)
            owners.extend(colour)
            if len(sizes) > max_faces:
                raise Unreadable(f"has more faces than the limit of {max_faces}")
        elif word == b"usemtl":
            colour = materials.get(rest.decode("utf-8", "replace"), (np.nan,) * 3)
    return _fans(points, corners, sizes, max_faces, np.array(tints).reshape(-1, 3), np.array(owners).reshape(-1, 3))


def _off(content: bytes, max_faces: int, _: Materials) -> Parsed:
    """Object File Format, as text: OFF, or COFF with colours at the vertices; colours after a face's vertices."""
    lines = _text_lines(content)
    head = next(lines, b"").split()
    if not head or head[0] not in (b"OFF", b"COFF"):
        raise Unreadable("is not an OFF file (it must begin with OFF or COFF)")
    counts = [int(token[:20]) for token in (head[1:] or next(lines, b"").split())]
    if len(counts) not in (2, 3) or min(counts[:2]) < 0 or 2 * (counts[0] + counts[1]) > len(content):
        raise Unreadable(f"announces {counts[:3]} vertices, faces and edges, more than it can hold")
    width = 7 if head[0] == b"COFF" else 3
    points, corners, sizes, colours = array("d"), array("q"), array("q"), array("d")
    for _row in range(counts[0]):
        points.extend(row := _floats(next(lines, b"").split()))
        if len(row) != width:
            raise Unreadable(f"a vertex does not have {width} numbers")
    for _row in range(counts[1]):
        tokens = next(lines, b"").split()
        size = int(tokens[0][:20])
        if size < 0 or len(tokens) < 1 + size:
            raise Unreadable(f"a face announces {size} vertices and has {len(tokens) - 1} numbers")
        sizes.append(size)
        corners.extend(int(token[:20]) for token in tokens[1 : 1 + size])
        tint = _floats(tokens[1 + size :])
        scale = 1.0 if any(b"." in token for token in tokens[1 + size :]) else 255.0
        colours.extend([value / scale for value in tint[:3]] if len(tint) in (3, 4) and width == 3 else (np.nan,) * 3)
    table = np.array(points).reshape(-1, width)
    tints = table[:, 3:6] / (255.0 if table.size and table[:, 3:6].max() > 1 else 1.0) if width == 7 else None
    return _fans(table[:, :3], corners, sizes, max_faces, tints, np.array(colours).reshape(-1, 3))


def _stl(content: bytes, max_faces: int, _: Materials) -> Parsed:
    """Stereolithography, binary (if its size fits its count) or text."""
    if len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        points = np.frombuffer(content, RECORD, offset=84)["corners"].astype(np.float64).reshape(-1, 3)
    elif content.lstrip()[:5] == b"solid":
        found = array("d")
        for line in _text_lines(content):
            if (tokens := line.split())[0] == b"vertex":
                if len(tokens) != 4:
                    raise Unreadable("a vertex does not have 3 numbers")
                found.extend(_floats(tokens[1:]))
        points = np.array(found).reshape(-1, 3)
    else:
        raise Unreadable("is not an STL file (neither text nor of the length of its count)")
    if len(points) % 3:
        raise Unreadable("ends inside a triangle")
    return _fans(points, np.arange(len(points)), np.full(len(points) // 3, 3), max_faces)


def _ply(content: bytes, max_faces: int, _: Materials) -> Parsed:
    """Polygon file, text or binary: colours of the faces, or else of the vertices."""
    from trimesh.exchange.ply import load_ply

    head, _mark, body = content.partition(b"end_header")
    form = HEADER.fullmatch(head[:MAX_LINE])
    if form is None:
        raise Unreadable("is not a PLY file (no header from ply and format to end_header, or an unknown line in it)")
    text = form[1] == b"ascii"
    # trimesh makes an array of each line of text.
    lines = body.count(b"\n") + body.count(b"\r") if text else 0
    if lines > 8 * max_faces + MAX_LINE or (text and body.translate(None, b"0123456789+-.eEnNaAiIfF \t\r\n")):
        raise Unreadable("holds values that are not numbers, or more lines than the limit of faces allows")
    try:
        elements = load_ply(io.BytesIO(content), skip_materials=True)["metadata"]["_ply_raw"]
    except ValueError as error:
        hint = "" if text else ", or binary with lists of different lengths (triangles and quads), which are not read"
        raise Unreadable(f"is damaged ({error}){hint}") from error
    for name, element in elements.items():
        rows = element.get("data")
        columns = [] if text or rows is None else [rows[column] for column in rows.dtype.names]
        lists = [column for column in columns if column.dtype.names]
        if any((column["f0"] != column["f1"].shape[1]).any() for column in lists):
            raise Unreadable(f"has lists of different lengths in {name}, which are not read from a binary file")
    vertex, face = (elements[name]["data"] for name in ("vertex", "face"))
    properties = list(elements["face"]["properties"])
    place = next(place for place, name in enumerate(properties) if name in ("vertex_indices", "vertex_index"))
    polygons = face[properties[place]] if text else face[properties[place]]["f1"]
    points = np.stack([np.ravel(vertex[axis]).astype(np.float64) for axis in "xyz"], 1)
    if len(points) != elements["vertex"]["length"] or len(polygons) != elements["face"]["length"]:
        raise Unreadable(f"ends after {len(points)} vertices and {len(polygons)} faces, before those that it announces")
    sizes = np.full(len(polygons), polygons.shape[-1]) if polygons.ndim == 2 else [len(one) for one in polygons]
    corners = np.ravel(polygons) if polygons.ndim == 2 else np.concatenate(list(polygons))
    if text:
        start = 1 + sum(elements[name]["length"] for name in list(elements)[: list(elements).index("face")])
        announced = [float(row.split()[place]) for row in body.splitlines()[start : start + len(sizes)]]
        if not np.array_equal(announced, sizes):
            raise Unreadable("a row of face ends inside its list")
    tints, colours = (
        _fractions(np.stack([np.ravel(rows[name]) for name in ("red", "green", "blue")], 1))
        if {"red", "green", "blue"} <= elements[element]["properties"].keys()
        else None
        for element, rows in (("vertex", vertex), ("face", face))
    )
    return _fans(points, corners, sizes, max_faces, tints, colours)


def _glb(content: bytes, max_faces: int, _: Materials) -> Parsed:
    """Binary glTF: as text, after 20 bytes of header."""
    if int.from_bytes(content[8:12], "little") != len(content):
        raise Unreadable(f"is not a glTF of {len(content)} bytes")
    return _gltf(content, max_faces, content[20 : 20 + int.from_bytes(content[12:16], "little")])


def _gltf(content: bytes, max_faces: int, text: Any) -> Parsed:
    """Text of glTF 2: triangles, transforms and plain colours; no textures, skins or compressed data."""
    from trimesh.exchange.gltf import load_glb, load_gltf

    binary = isinstance(text, bytes)
    document = json.loads(text if binary else content)
    lists = (document.get(name, []) for name in ("nodes", "meshes", "accessors", "bufferViews", "buffers"))
    nodes, meshes, accessors, views, buffers = lists
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    if max(map(len, (nodes, primitives, accessors, views, buffers))) > MAX_NODES:
        raise Unreadable(f"has more than {MAX_NODES} nodes, primitives, accessors or buffers")
    required = [str(name) for name in document.get("extensionsRequired", []) if not str(name).startswith(HARMLESS)]
    if required:
        raise Unreadable(f"requires the extension {required[0][:60]}, which is not read")
    if any(not str(buffer.get("uri", "data:")).startswith("data:") for buffer in buffers):
        raise Unreadable("has a buffer outside the file, which is not read")
    for buffer in buffers:
        length, encoded = _whole(buffer["byteLength"]), buffer.get("uri", "").partition(",")[2]
        if "uri" in buffer and len(base64.b64decode(encoded, validate=True)) < length:
            raise Unreadable(f"has a buffer of fewer bytes than the {length} that it announces")
    if any("sparse" in accessor or "bufferView" not in accessor for accessor in accessors):
        raise Unreadable("has a sparse or empty accessor, which is not read")
    # trimesh compares these with the buffers only by assertions, which Python can disable.
    for part in (*views, *accessors):
        for name in ("byteOffset", "byteLength", "byteStride"):
            _whole(part.get(name, 0))
    held = [BYTES[a["componentType"]] * WIDTHS[a["type"]] * _whole(a["count"]) for a in accessors]
    if sum(held) + sum(view["byteLength"] for view in views) > 8 * len(content):
        raise Unreadable("announces more than it can hold")
    if any(p.get("mode", 4) not in (0, 1, 4) or DRACO in p.get("extensions", {}) for p in primitives):
        raise Unreadable("has strips, fans or compressed triangles, which are not read")
    # A tree visits each node once: a second visit is a cycle or a node with two parents.
    roots = document["scenes"][_whole(document.get("scene", 0))].get("nodes", [])
    visited = [*roots, *(child for node in nodes for child in node.get("children", []))]
    if len({*visited}) != len(visited) or not all(_whole(number) < len(nodes) for number in visited):
        raise Unreadable("its nodes are not a tree")
    # Counted before anything is allocated, as many nodes may place one mesh.
    corners = 0
    for node in nodes:
        for primitive in meshes[_whole(node["mesh"])]["primitives"] if "mesh" in node else ():
            points = primitive["attributes"]["POSITION"]
            corners += max(accessors[_whole(index)]["count"] for index in (points, primitive.get("indices", points)))
    if corners > 3 * max_faces:
        raise Unreadable(f"has more faces or vertices than the limit of {max_faces} allows")
    load = load_glb if binary else load_gltf
    loaded = load(io.BytesIO(content), resolver={}, skip_materials=True)
    base = loaded["base_frame"]
    tints = dict(zip(loaded["geometry"], (_factor(document, one) for one in primitives), strict=True))
    placed, pieces, count = {base: np.eye(4)}, [Parsed(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)))], 0
    for edge in loaded["graph"]:
        placed[edge["frame_to"]] = matrix = placed[edge["frame_from"]] @ edge["matrix"]
        mesh = loaded["geometry"].get(edge.get("geometry"), {})
        if "faces" not in mesh:
            continue
        points, faces = mesh["vertices"].astype(np.float64), mesh["faces"].astype(np.int64)
        # A mirroring transform reverses the orientation of faces; glTF requires to restore it.
        placed_faces = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
        tint = np.tile(tints[edge["geometry"]], (len(faces), 1))
        if "vertex_colors" in mesh:
            tint = _fractions(mesh["vertex_colors"][:, :3])[faces].mean(1) * np.where(np.isfinite(tint), tint, 1)
        if faces.size and faces.max() >= len(points):
            raise Unreadable(f"a face names vertex {faces.max()} of {len(points)}")
        pieces.append(Parsed(points @ matrix[:3, :3].T + matrix[:3, 3], placed_faces + count, tint))
        count += len(points)
    return Parsed(*map(np.concatenate, zip(*pieces, strict=True)))


def _factor(document: dict[str, Any], primitive: dict[str, Any]) -> Sequence[float]:
    if "material" not in primitive:
        return (np.nan,) * 3
    surface = document["materials"][_whole(primitive["material"])].get("pbrMetallicRoughness", {})
    return [float(value) for value in surface.get("baseColorFactor", (1, 1, 1, 1))[:3]]


PARSERS: dict[str, Callable[[bytes, int, Any], Parsed]] = {
    "glb": _glb,
    "gltf": _gltf,
    "obj": _obj,
    "off": _off,
    "ply": _ply,
    "stl": _stl,
}
KINDS = tuple(PARSERS)


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**40:
        raise Unreadable(f"expected a whole number of at least 0; got {str(value)[:40]}")
    return value


def _fractions(values: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] from integers of the full range of their type."""
    return values / float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else values.astype(np.float64)


def _fans(
    points: Any,
    corners: Any,
    sizes: Any,
    max_faces: int,
    of_vertices: np.ndarray | None = None,
    of_polygons: np.ndarray | None = None,
) -> Parsed:
    """Fans of polygons (concatenated vertices, sizes), with the polygons' colours, else means of the vertices'."""
    corners, sizes = np.array(corners, np.int64), np.array(sizes, np.int64)
    triangles = np.maximum(sizes - 2, 0)
    if int(triangles.sum()) > max_faces:
        raise Unreadable(f"has {int(triangles.sum())} triangles, the limit is {max_faces}")
    owner = np.repeat(np.arange(len(sizes)), triangles)
    first = (np.cumsum(sizes) - sizes)[owner]
    step = np.arange(len(owner)) - (np.cumsum(triangles) - triangles)[owner]
    faces = np.stack((corners[first], corners[first + step + 1], corners[first + step + 2]), 1)
    colours = np.full(faces.shape, np.nan) if of_polygons is None else of_polygons[owner]
    if of_vertices is not None:
        colours = np.where(np.isnan(colours), of_vertices[faces].mean(1), colours)
    return Parsed(np.array(points, np.float64).reshape(-1, 3), faces, colours)


def _text_lines(content: bytes) -> Iterator[bytes]:
    """The lines that are not empty, without comments (#) and surrounding blanks."""
    if b"\0" in content:
        raise Unreadable("is not a text file (it holds a zero byte)")
    for line in io.BytesIO(content):
        if len(line) > MAX_LINE:
            raise Unreadable(f"has a line of more than {MAX_LINE} bytes")
        line = line.split(b"#", 1)[0].strip()
        if line:
            yield line


def _floats(tokens: list[bytes]) -> list[float]:
    """Numbers from text, each of at most 64 characters."""
    if any(len(token) > 64 for token in tokens):
        raise Unreadable("has a number of more than 64 characters")
    return [float(token) for token in tokens]
