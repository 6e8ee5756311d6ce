"""Reading meshes from untrusted files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lsmgeo._checks import check_flag, check_whole
from lsmgeo.data.isolated import parse_isolated
from lsmgeo.data.meshes.mesh import DEFAULT_COLOUR, Mesh
from lsmgeo.data.meshes.mesh_parsing import KINDS, parse_mesh
from lsmgeo.data.read_files import path_inside, read_bytes, read_text
from lsmgeo.errors import DataError, LsmGeoError

__all__ = ["load_mesh"]

MAX_BYTES = 1 << 27
MAX_FACES = 1 << 21
MAX_LIBRARY_BYTES = 1 << 22
MAX_LIBRARIES = 16
FARTHEST = 1e15
# Limits of a guarded parser.
GUARD_SECONDS = 60.0
GUARD_MEMORY = 1 << 30
GUARD_MEMORY_OF_A_BYTE = 8


def load_mesh(
    path: str | os.PathLike[str],
    *,
    max_bytes: int = MAX_BYTES,
    max_faces: int = MAX_FACES,
    guarded: bool = False,
) -> Mesh:
    r"""Read the triangles and plain colours of an OBJ, PLY, OFF, STL, GLB or glTF file.

    What a file announces is compared with its size first, and it is parsed only by Python and NumPy (PLY and glTF by
    trimesh), without native decoders. So parsing is not isolated by default: a process takes from 0.2 s (OBJ, OFF, STL)
    to 1.5 s for each mesh. Pass ``guarded=True`` for files from strangers: the parser then runs in an isolated process
    with limited memory and time.

    Read are polygons, as fans of triangles about their first vertex; colours of faces, or means of the colours of their
    vertices; of OBJ, diffuse colours (Kd) in material files in the same folder or below, if they exist; of glTF, the
    scene's transforms, baseColorFactor and vertex colours. Textures are not read: such a face has the plain colour of
    its material, or grey. Vertices without a face are dropped; nothing is moved, merged or repaired. Refused are a
    binary PLY with lists of different lengths, such as triangles and quads (save it as text), a PLY whose faces have a
    second list, and a glTF with strips or fans, sparse or compressed data, or no scene.

    Args:
        path: the file, whose suffix states the format.
        max_bytes: the largest file accepted.
        max_faces: the largest number of triangles accepted.
        guarded: parse in an isolated process.

    Returns:
        The mesh, in the file's own frame and units.

    Raises:
        DataError: the file is missing, too large, of another format or damaged, refers to files outside (glTF buffers,
            OBJ materials outside the folder), has a vertex that is not finite, a face with a vertex out of range, or no
            face with an area.
        OptionError: a limit below 1.

    Example:
        >>> import tempfile, pathlib
        >>> from lsmgeo.data import load_mesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "square.obj"
        ...     _ = path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
        ...     load_mesh(path).faces
        array([[0, 1, 2],
               [0, 2, 3]])
    """
    who = "load_mesh"
    check_flag(who, "guarded", guarded)
    for name, value in (("max_bytes", max_bytes), ("max_faces", max_faces)):
        check_whole(who, name, value, 1)
    path = Path(path)
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise DataError(path, f"is not a mesh; expected a name that ends in one of {', '.join(KINDS)}")
    content = read_bytes(path, max_bytes)
    options = (kind, max_faces, _material_colours(path, content) if kind == "obj" else {})
    try:
        if not guarded:
            return _checked(path, parse_mesh(content, *options), max_faces)
        memory = GUARD_MEMORY + GUARD_MEMORY_OF_A_BYTE * len(content)
        (found,) = parse_isolated(parse_mesh, [path], *options, limit=max_bytes, memory=memory, seconds=GUARD_SECONDS)
    except ValueError as error:
        raise DataError(path, str(error)) from error
    if isinstance(found, DataError):
        raise found
    return _checked(path, found, max_faces)


def _checked(path: Path, parsed: Mapping[str, np.ndarray], max_faces: int) -> Mesh:
    """The mesh without unused vertices; the output of a parser is as untrusted as its file."""
    try:
        whole = Mesh(parsed["vertices"], parsed["faces"])
        with np.errstate(over="ignore"):
            colours = parsed["colours"].astype(np.float32).reshape(whole.faces.shape)
    except (LsmGeoError, KeyError, ValueError) as error:
        raise DataError(path, f"holds an invalid mesh ({error})") from error
    if not len(whole.faces) or len(whole.faces) > max_faces:
        raise DataError(path, f"holds no face, or more than the limit of {max_faces}; got {len(whole.faces)}")
    if np.abs(whole.vertices).max() > FARTHEST:
        raise DataError(path, "vertices must be at most 1e15 from 0")
    used, faces = np.unique(whole.faces, return_inverse=True)
    vertices, faces = whole.vertices[used], faces.reshape(-1, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # Relative to the size of the mesh, so that rounding is no area in any unit.
    size = np.ptp(vertices, 0).max()
    if not (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14 * size * size).any():
        raise DataError(path, "has no face with an area")
    known = np.asarray(np.isfinite(colours).all(1))
    if not known.any():
        return Mesh(vertices, faces)
    colours = np.where(known[:, None], np.clip(colours, 0, 1), DEFAULT_COLOUR)
    return Mesh(vertices, faces, colours.astype(np.float32))


def _material_colours(path: Path, content: bytes) -> dict[str, tuple[float, ...]]:
    """The diffuse colours of the materials in files beside an OBJ file."""
    colours: dict[str, tuple[float, ...]] = {}
    lines = re.findall(rb"^[ \t]*mtllib[ \t]([^\r\n#]*)", content, re.MULTILINE)
    libraries = dict.fromkeys(line.strip().decode("utf-8", "replace") for line in lines)
    if len(libraries) > MAX_LIBRARIES:
        raise DataError(path, f"names {len(libraries)} material files, the limit is {MAX_LIBRARIES}")
    for library in libraries:
        file = path_inside(path.parent, library, path)
        if not file.exists():
            continue
        current = None
        for line in read_text(file, MAX_LIBRARY_BYTES).splitlines():
            word, _, rest = line.strip().partition(" ")
            if word == "newmtl":
                current = rest.strip()
            elif word == "Kd" and current is not None:
                try:
                    values = tuple(float(token) for token in rest.split()[:3])
                except ValueError as error:
                    raise DataError(file, f"Kd of {current[:80]!r} must be three numbers ({error})") from error
                if len(values) != 3 or not np.isfinite(values).all():
                    raise DataError(file, f"Kd of {current[:80]!r} must be three finite numbers; got {rest[:80]!r}")
                colours.setdefault(current, values)
    return colours
