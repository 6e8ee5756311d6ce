"""Mesh files written byte by byte, by code that shares nothing with the readers, and small closed meshes."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]  # seen from outside
FANS = np.array([[quad[0], quad[k], quad[k + 1]] for quad in QUADS for k in (1, 2)])
TINTS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [51, 102, 153]])


def obj(*, materials: Sequence[str] = (), library: str = "cube.mtl", backwards: bool = False, end: str = "\n") -> bytes:
    """The cube in quads, each of its own material if wanted; indices counted from the end if wanted."""
    lines = ["# a cube", f"mtllib {library}"] if materials else ["# a cube"]
    lines += [f"v {x} {y} {z}" for x, y, z in CUBE] + ["vn 0 0 1", "vt 0 0"]
    for index, quad in enumerate(QUADS):
        lines += [f"usemtl {materials[index]}"] if materials else []
        names = [k - 8 if backwards else k + 1 for k in quad]
        lines.append("f " + " ".join(f"{k}/1/1" for k in names))
    return (end.join(lines) + end).encode()


def mtl(names: Sequence[str]) -> bytes:
    """A material file; the colours are `TINTS`."""
    return "".join(
        f"newmtl {name}\nNs 10\nKd {r / 255} {g / 255} {b / 255}\nmap_Kd ../../etc/passwd\n"
        for name, (r, g, b) in zip(names, TINTS, strict=True)
    ).encode()


def ply(form: str, *, triangles: bool = False, tinted: str = "face", mixed: bool = False) -> bytes:
    """The cube, with an element before the faces that no reader needs, with lists of different lengths if ``mixed``.

    Colours are at "face" or "vertex".
    """
    faces = FANS.tolist() if triangles else QUADS
    tints = np.repeat(TINTS, 2, 0) if triangles else TINTS
    at = {"vertex": [], "face": []} | {tinted: ["property uchar red", "property uchar green", "property uchar blue"]}
    head = ["ply", f"format {form} 1.0", "comment made here", f"element vertex {len(CUBE)}"]
    head += ["property double x", "property float y", "property float z", *at["vertex"]]
    head += ["element strange 2", "property list uchar short odd", "property int even"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", *at["face"], "end_header\n"]
    order = ">" if "big" in form else "<"
    body = b""
    rows: list[str] = []
    for index, point in enumerate(CUBE):
        tint = TINTS[index % 6].tolist() if tinted == "vertex" else []
        body += struct.pack(f"{order}dff", *point) + bytes(tint)
        rows.append(" ".join(map(str, [*point, *tint])))
    for size in (0 if mixed else 3, 3):
        body += struct.pack(f"{order}B{size}hi", size, *range(size), -7)
        rows.append(" ".join(map(str, [size, *range(size), -7])))
    for face, tint in zip(faces, tints.tolist(), strict=True):
        more = tint if tinted == "face" else []
        body += struct.pack(f"{order}B{len(face)}i", len(face), *face) + bytes(more)
        rows.append(" ".join(map(str, [len(face), *face, *more])))
    return "\n".join(head).encode() + (("\n".join(rows) + "\n").encode() if form == "ascii" else body)


def off(*, head: str = "OFF") -> bytes:
    """The cube in quads with colours at the faces."""
    lines = [head, "# a cube", f"{len(CUBE)} {len(QUADS)} 0"] + [f"{x} {y} {z}" for x, y, z in CUBE]
    lines += [f"4 {' '.join(map(str, quad))} {r} {g} {b}" for quad, (r, g, b) in zip(QUADS, TINTS, strict=True)]
    return "\n".join(lines).encode()


def stl(*, text: bool = False) -> bytes:
    """The cube in triangles."""
    if text:
        lines = ["solid cube"]
        for face in FANS:
            lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {x} {y} {z}" for x, y, z in CUBE[face])]
            lines += ["endloop", "endfacet"]
        return "\n".join([*lines, "endsolid"]).encode()
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *CUBE[face].reshape(-1), 0) for face in FANS)
    return bytes(80) + struct.pack("<I", len(FANS)) + body


def gltf(**changes: Any) -> dict[str, Any]:
    """The cube under two nodes: one turned by 90 degrees about y and moved, its child mirrored and doubled in x."""
    data = CUBE.astype("<f4").tobytes() + FANS.astype("<u2").tobytes()
    half = float(np.sqrt(0.5))
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"mesh": 0, "translation": [10, 0, 0], "rotation": [0, half, 0, half], "children": [1]},
            {"mesh": 0, "scale": [-2, 1, 1]},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1.0]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 8},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 36},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 72},
        ],
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }
    return document | changes


def glb(document: dict[str, Any]) -> bytes:
    """The document in one file with its first buffer."""
    uri = document["buffers"][0].get("uri", "data:;base64,")
    binary = base64.b64decode(uri.split(",", 1)[1]) if uri.startswith("data:") else b""
    plain = document | {"buffers": [{"byteLength": document["buffers"][0]["byteLength"]}]}
    text = json.dumps(plain).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def samples() -> dict[str, bytes]:
    """One good file of every format and form, by name."""
    return {
        "quads.obj": obj(),
        "backwards.obj": obj(backwards=True, end="\r\n"),
        "text.ply": ply("ascii", mixed=True),
        "little.ply": ply("binary_little_endian"),
        "big.ply": ply("binary_big_endian"),
        "triangles.ply": ply("binary_little_endian", triangles=True),
        "tinted.ply": ply("ascii", tinted="vertex"),
        "faces.off": off(),
        "binary.stl": stl(),
        "text.stl": stl(text=True),
        "nodes.gltf": json.dumps(gltf()).encode(),
        "nodes.glb": glb(gltf()),
    }
