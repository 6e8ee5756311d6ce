"""glTF 2.0: triangles, transforms and plain colours; no textures, skins or compressed data."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from typing import Any

import numpy as np

from .common import Parsed, Unreadable

__all__ = ["parse_glb", "parse_gltf"]

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_NODES = 1 << 16
MAX_DEPTH = 256
# Extensions that a file may require and that leave triangles as they are.
HARMLESS = ("KHR_materials_", "KHR_texture_transform", "KHR_mesh_quantization", "KHR_lights_punctual")


def parse_glb(content: bytes, max_faces: int) -> Parsed:
    """Read binary glTF."""
    if len(content) < 20 or content[:4] != b"glTF":
        raise Unreadable("is not a binary glTF file")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2 or length != len(content):
        raise Unreadable(f"is glTF {version} of {length} bytes; expected glTF 2 of {len(content)}")
    chunks: list[tuple[bytes, bytes]] = []
    place = 12
    while place + 8 <= len(content) and len(chunks) < 16:
        (size,) = struct.unpack_from("<I", content, place)
        if place + 8 + size > len(content):
            raise Unreadable("ends inside a chunk")
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + size]))
        place += 8 + size
    if not chunks or chunks[0][0] != b"JSON":
        raise Unreadable("has no JSON chunk")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return _parse(chunks[0][1], binary, max_faces)


def parse_gltf(content: bytes, max_faces: int) -> Parsed:
    """Read glTF as text, its buffers inside it."""
    return _parse(content, None, max_faces)


def _parse(text: bytes, binary: bytes | None, max_faces: int) -> Parsed:
    document = json.loads(text.decode("utf-8"))
    if not isinstance(document, dict):
        raise Unreadable("is no glTF document")
    for name in document.get("extensionsRequired", []):
        if not str(name).startswith(HARMLESS):
            raise Unreadable(f"requires the extension {str(name)[:60]}, which is not read")
    file = _File(document, _buffers(document, binary))
    points, faces, colours = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros((0, 3), np.float32)]
    vertices = triangles = visited = 0
    for number, matrix in _placed_meshes(document):
        for primitive in file.items("meshes")[number].get("primitives", []):
            visited += 1
            if visited > MAX_NODES:
                raise Unreadable(f"places more than {MAX_NODES} primitives")
            # Counted before anything is made, as one mesh may stand in many places.
            triangles += file.count(primitive) // 3
            if triangles > max_faces:
                raise Unreadable(f"has more faces than the limit of {max_faces}")
            position, index, tint = file.primitive(primitive)
            if vertices + len(position) > 3 * max_faces:
                raise Unreadable(f"has more vertices than {3 * max_faces}")
            points.append(position @ matrix[:3, :3].T + matrix[:3, 3])
            # A mirroring transform turns faces inside out; glTF says to turn them back.
            faces.append((index[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else index) + vertices)
            colours.append(tint)
            vertices += len(position)
    face = np.concatenate(faces)
    return Parsed(np.concatenate(points), face, np.concatenate(colours), np.full(len(face), -1, np.int32))


def _buffers(document: dict[str, Any], binary: bytes | None) -> list[bytes]:
    result = []
    for number, entry in enumerate(document.get("buffers", [])):
        uri, length = entry.get("uri"), _whole(entry["byteLength"])
        if uri is None and number == 0 and binary is not None:
            data = binary
        elif isinstance(uri, str) and uri.startswith("data:") and ";base64," in uri[:256]:
            try:
                data = base64.b64decode(uri.split(";base64,", 1)[1], validate=True)
            except binascii.Error as error:
                raise Unreadable(f"buffer {number} is not base64 ({error})") from error
        else:
            raise Unreadable(f"buffer {number} is outside the file ({str(uri)[:80]!r}), which is not read")
        if length > len(data):
            raise Unreadable(f"buffer {number} announces {length} bytes and has {len(data)}")
        result.append(data[:length])
    return result


def _whole(value: Any, least: int = 0) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 2**40:
        raise Unreadable(f"expected a whole number, {least} at least; got {str(value)[:40]}")
    return value


class _File:
    """Accessors of a document, checked against its buffers before anything is made of them."""

    def __init__(self, document: dict[str, Any], buffers: list[bytes]) -> None:
        self.document, self.buffers = document, buffers
        self.checked: dict[str, list[dict[str, Any]]] = {}

    def items(self, name: str) -> list[dict[str, Any]]:
        if name not in self.checked:  # once, not for every node of a long list
            found = self.document.get(name, [])
            if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
                raise Unreadable(f"{name} must be a list of objects")
            self.checked[name] = found
        return self.checked[name]

    def item(self, name: str, index: Any) -> dict[str, Any]:
        items = self.items(name)
        if _whole(index) >= len(items):
            raise Unreadable(f"names {name}[{index}] of {len(items)}")
        return items[index]

    def count(self, primitive: dict[str, Any]) -> int:
        """How many corners a primitive of triangles has; 0 for points and lines."""
        mode = primitive.get("mode", 4)
        if mode in (0, 1, 2, 3):
            return 0
        if mode != 4:
            raise Unreadable(f"has triangles of mode {str(mode)[:20]} (strips or fans), which are not read")
        index = primitive.get("indices", primitive["attributes"]["POSITION"])
        return _whole(self.item("accessors", index)["count"])

    def values(self, index: Any) -> np.ndarray:
        """(count, width) of an accessor; normalised numbers as fractions."""
        accessor = self.item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise Unreadable("has a sparse or empty accessor, which is not read")
        view = self.item("bufferViews", accessor["bufferView"])
        if _whole(view["buffer"]) >= len(self.buffers):
            raise Unreadable(f"names buffer {view['buffer']} of {len(self.buffers)}")
        data = self.buffers[view["buffer"]]
        kind, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count, size = _whole(accessor["count"], 1), kind.itemsize * width
        stride = _whole(view.get("byteStride", size), size)
        begin = _whole(view.get("byteOffset", 0)) + _whole(accessor.get("byteOffset", 0))
        end = begin + stride * (count - 1) + size
        limit = min(len(data), _whole(view.get("byteOffset", 0)) + _whole(view["byteLength"]))
        if end > limit:
            raise Unreadable(f"accessor {index} ends at byte {end} of {limit}")
        table = np.ndarray((count, width), kind, data, begin, (stride, kind.itemsize))
        if accessor.get("normalized") and kind.kind in "iu":
            return np.maximum(table / float(np.iinfo(kind).max), -1.0)
        return np.ascontiguousarray(table)

    def primitive(self, primitive: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (N, 3), triangles (F, 3), colours (F, 3); points and lines have no triangles."""
        count = self.count(primitive)
        if count == 0:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)
        attributes = primitive["attributes"]
        position = self.values(attributes["POSITION"]).astype(np.float64)
        if position.shape[1] != 3:
            raise Unreadable("positions must be x, y, z")
        if "indices" in primitive:
            flat = self.values(primitive["indices"]).astype(np.int64)
        else:
            flat = np.arange(len(position))
        if flat.size % 3:
            raise Unreadable(f"has {flat.size} corners of triangles; expected a multiple of 3")
        index = flat.reshape(-1, 3)
        if index.size and index.max() >= len(position):
            raise Unreadable(f"a face names vertex {index.max()} of {len(position)}")
        factor = None
        if "material" in primitive:
            surface = self.item("materials", primitive["material"]).get("pbrMetallicRoughness", {})
            factor = np.array([float(value) for value in surface.get("baseColorFactor", (1, 1, 1, 1))[:3]])
        tint = np.full((len(index), 3), np.nan) if factor is None else np.tile(factor, (len(index), 1))
        if "COLOR_0" in attributes:
            corner = self.values(attributes["COLOR_0"])[:, :3].astype(np.float64)
            tint = corner[index].mean(1) * (1.0 if factor is None else factor)
        return position, index, tint.astype(np.float32)


def _placed_meshes(document: dict[str, Any]) -> list[tuple[int, np.ndarray]]:
    """Which meshes stand where: (number, world from mesh) for each node of the scene that has one."""
    file = _File(document, [])
    nodes, meshes = file.items("nodes"), file.items("meshes")
    if len(nodes) > MAX_NODES:
        raise Unreadable(f"has {len(nodes)} nodes, the limit is {MAX_NODES}")
    if not file.items("scenes"):
        roots: list[Any] = [*({*range(len(nodes))} - {child for node in nodes for child in node.get("children", [])})]
    else:
        roots = file.item("scenes", document.get("scene", 0)).get("nodes", [])
    placed, seen = [], set()
    waiting = [(root, np.eye(4), 0) for root in reversed(roots)]
    while waiting:
        number, parent, depth = waiting.pop()
        node = file.item("nodes", number)
        # A tree visits each node once: a second visit is a cycle or a node with two parents.
        if number in seen or depth > MAX_DEPTH:
            raise Unreadable(f"its nodes are no tree (node {number})")
        seen.add(number)
        matrix = parent @ _matrix(node)
        if "mesh" in node:
            file.item("meshes", node["mesh"])
            placed.append((node["mesh"], matrix))
        waiting.extend((child, matrix, depth + 1) for child in reversed(node.get("children", [])))
    return placed if nodes else [(number, np.eye(4)) for number in range(len(meshes))]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        matrix = np.array([float(value) for value in node["matrix"]]).reshape(4, 4).T
    else:
        x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
        matrix = np.eye(4)
        rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        matrix[:3, :3] = rotation * np.array([float(value) for value in node.get("scale", (1, 1, 1))])
        matrix[:3, 3] = [float(value) for value in node.get("translation", (0, 0, 0))]
    if not np.isfinite(matrix).all():
        raise Unreadable("a node's transform must be finite")
    return matrix
