"""Triangle meshes: one plain value, read from files that nobody vouches for."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo._checks import LARGEST_COUNT, check_choice, check_flag, describe
from lsmgeo.data.files import child, read_bytes, read_text
from lsmgeo.data.mesh_files import KINDS, Parsed, Unreadable, parse
from lsmgeo.data.mesh_topology import is_watertight
from lsmgeo.errors import DataError, DTypeError, OptionError, ShapeError

if TYPE_CHECKING:
    import trimesh

__all__ = ["DEFAULT_COLOUR", "Mesh", "from_trimesh", "load_mesh", "normalise"]

# What has no colour of its own: the grey of a default `lsmgeo.scenes.Material`.
DEFAULT_COLOUR = (0.7, 0.7, 0.7)
MAX_BYTES = 1 << 27
MAX_FACES = 1 << 21
MAX_LIBRARY_BYTES = 1 << 22
MAX_LIBRARIES = 16
# What a guarded parser may use.
GUARD_SECONDS = 60.0
GUARD_MEMORY = 1 << 30
GUARD_MEMORY_OF_A_BYTE = 8


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, checked when made; arrays must not be changed afterwards.

    Attributes:
        vertices: (N, 3) float64, finite, world units.
        faces: (F, 3) int64 vertex numbers, F >= 1; seen from outside, counter-clockwise.
        face_colours: (F, 3) float32 RGB in [0, 1], or None.

    Raises:
        ShapeError: a wrong shape, no face.
        DTypeError: no array of numbers.
        OptionError: a face that names no vertex, a number that is not finite, a colour outside [0, 1].

    Example:
        >>> import numpy as np
        >>> from lsmgeo.data import Mesh
        >>> Mesh(np.eye(3), np.array([[0, 1, 2]])).watertight
        False
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_colours: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        vertices = _array("vertices", self.vertices, "(N, 3) numbers", "fiu", np.float64)
        faces = _array("faces", self.faces, "(F, 3) whole numbers", "iu", np.int64)
        if not 1 <= len(faces) <= LARGEST_COUNT or len(vertices) > LARGEST_COUNT:
            raise ShapeError(f"Mesh: expected at least one face, fewer than 2^31; got {len(faces)}")
        if not np.isfinite(vertices).all():
            raise OptionError("Mesh: vertices must be finite; got a NaN or an infinity")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise OptionError(
                f"Mesh: faces must name vertices 0 to {len(vertices) - 1}; got {faces.min()}..{faces.max()}"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        if self.face_colours is None:
            return
        colours = _array("face_colours", self.face_colours, "(F, 3) numbers", "f", np.float32)
        if len(colours) != len(faces):
            raise ShapeError(f"Mesh: face_colours must be ({len(faces)}, 3), one a face; got {colours.shape}")
        if not ((colours >= 0) & (colours <= 1)).all():
            raise OptionError(f"Mesh: face_colours must be in [0, 1]; got {colours.min()}..{colours.max()}")
        object.__setattr__(self, "face_colours", colours)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    @cached_property
    def watertight(self) -> bool:
        """Whether every edge belongs to exactly two faces; vertices in one place count as one."""
        return is_watertight(self.vertices, self.faces)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3): the least and the greatest x, y, z of the vertices that faces use."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack((used.min(0), used.max(0)))


def _array(name: str, value: object, expected: str, kinds: str, dtype: type) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
        raise DTypeError(f"Mesh: {name} must be a numpy array, {expected}; got {describe(value)}")
    if value.ndim != 2 or value.shape[1] != 3:
        raise ShapeError(f"Mesh: {name} must be {expected}; got {value.shape}")
    return np.ascontiguousarray(value, dtype)


def check_mesh(who: str, mesh: object) -> None:
    """Require a `Mesh`."""
    if not isinstance(mesh, Mesh):
        raise DTypeError(f"{who}: mesh must be a lsmgeo.data.Mesh (see from_trimesh); got {describe(mesh)}")


def from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    """A `trimesh.Trimesh` as a `Mesh`; colours of faces or vertices are kept, textures are not.

    Example:
        >>> import trimesh
        >>> from lsmgeo.data import from_trimesh
        >>> from_trimesh(trimesh.creation.box((1, 1, 1))).watertight
        True
    """
    visual = getattr(mesh, "visual", None)
    colours = None
    if visual is not None and visual.defined and visual.kind in ("face", "vertex"):
        colours = np.asarray(visual.face_colors)[:, :3].astype(np.float32) / 255
    return Mesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64), colours)


def load_mesh(
    path: str | os.PathLike[str],
    *,
    max_bytes: int = MAX_BYTES,
    max_faces: int = MAX_FACES,
    guarded: bool = False,
) -> Mesh:
    r"""Read the triangles and plain colours of an OBJ, PLY, OFF, STL, GLB or glTF file.

    The file is hostile until checked. Its parsers are Python and numpy of this package, with no native decoder that a
    file could crash; they allocate for what is in the file, never for a count that it announces, and take no other
    file. So reading is not guarded by default, as a process more costs about 0.2 s a mesh; take ``guarded=True`` for
    files from strangers: the parser then runs in a process of its own with limited memory and time.

    What is read: polygons, as fans of triangles about their first vertex; colours of faces, or the means of colours of
    vertices; of OBJ, the diffuse colours (Kd) of material files in the same folder or below (a missing one is passed
    over, as ShapeNet lacks some); of glTF, transforms, baseColorFactor and vertex colours, numbers as they are written.
    No textures: a face that has only a texture is grey, or has its material's plain colour. Vertices that no face uses
    are dropped; nothing is moved, merged or repaired.

    Args:
        path: the file; its ending names the format and its content must agree.
        max_bytes: largest file accepted.
        max_faces: most triangles accepted.
        guarded: parse in another process, POSIX only.

    Returns:
        The mesh, in the file's own frame and units.

    Raises:
        DataError: the file is missing, too large, of another format, damaged, refers to files outside (glTF buffers,
            paths of OBJ materials that leave the folder), has a vertex that is not finite, a face that names no vertex,
            or no face with an area.
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
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise OptionError(f"{who}: {name} must be a whole number, 1 at least; got {describe(value)}")
    path = Path(path)
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise DataError(path, f"is no mesh that can be read; expected a name that ends in one of {', '.join(KINDS)}")
    content = read_bytes(path, max_bytes)
    try:
        parsed = _parse_guarded(path, content, kind, max_faces) if guarded else parse(content, kind, max_faces)
    except Unreadable as error:
        raise DataError(path, str(error)) from error
    return _finished(path, parsed)


def _finished(path: Path, parsed: Parsed) -> Mesh:
    used, faces = np.unique(parsed.faces, return_inverse=True)
    vertices, faces = parsed.vertices[used], faces.reshape(-1, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # Relative to the mesh, so that neither a tiny nor a huge unit makes rounding look like area.
    size = np.ptp(vertices, 0).max()
    if not (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14 * size * size).any():
        raise DataError(path, "has no face with an area")
    colours = parsed.colours.astype(np.float32)
    if parsed.libraries and (parsed.material >= 0).any():
        diffuse = _material_colours(path, parsed.libraries)
        table = np.array([diffuse.get(name, (np.nan,) * 3) for name in parsed.materials], np.float32)
        of_material = np.where(parsed.material[:, None] >= 0, table[parsed.material], np.nan)
        colours = np.where(np.isfinite(of_material), of_material, colours)
    known = np.asarray(np.isfinite(colours).all(1))
    if not known.any():
        return Mesh(vertices, faces)
    colours = np.where(known[:, None], np.clip(colours, 0, 1), DEFAULT_COLOUR)
    return Mesh(vertices, faces, colours.astype(np.float32))


def _material_colours(path: Path, libraries: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    """The diffuse colours of the materials in files beside an OBJ file."""
    colours: dict[str, tuple[float, ...]] = {}
    if len(libraries) > MAX_LIBRARIES:
        raise DataError(path, f"names {len(libraries)} material files, the limit is {MAX_LIBRARIES}")
    for library in libraries:
        file = child(path.parent, library, path)
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


def _parse_guarded(path: Path, content: bytes, kind: str, max_faces: int) -> Parsed:
    """Parse in a process of limited memory and time; arrays come back as an archive that holds no objects."""
    script = Path(__file__).parent / "mesh_files" / "alone.py"
    memory = GUARD_MEMORY + GUARD_MEMORY_OF_A_BYTE * len(content)
    # One thread: the pools of linear algebra reserve address space for every core.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-I", str(script), kind, str(max_faces), str(memory)]
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                command, input=content, stdout=output, stderr=subprocess.PIPE, env=environment, timeout=GUARD_SECONDS
            )
        except subprocess.TimeoutExpired as error:
            raise DataError(path, f"took more than {GUARD_SECONDS:g} s to parse") from error
        except OSError as error:
            raise DataError(path, f"no guarded process could be started ({error})") from error
        if done.returncode != 0:
            reason = done.stderr.decode("utf-8", "replace").strip()[-300:]
            raise DataError(path, reason or f"ended the guarded process with status {done.returncode}")
        output.seek(0)
        try:
            with np.load(io.BytesIO(output.read()), allow_pickle=False) as arrays:
                materials, libraries = (tuple(names) for names in json.loads(arrays["names"].tobytes()))
                vertices, faces, colours, material = (
                    arrays[name] for name in ("vertices", "faces", "colours", "material")
                )
        except (ValueError, KeyError, OSError, EOFError) as error:
            raise DataError(path, f"the guarded process gave no mesh ({error})") from error
    return Parsed(vertices, faces, colours, material, materials, libraries)


def normalise(mesh: Mesh, *, to: str = "diagonal") -> Mesh:
    """Move the centre of the bounding box to the origin and scale it to unit size.

    Args:
        mesh: any mesh.
        to: "diagonal" makes the box's diagonal 1, as in ShapeNet, and "longest" its longest side.

    Returns:
        The mesh, within [-0.5, 0.5]^3.

    Raises:
        DTypeError: not a `Mesh`.
        OptionError: another `to`, or a mesh that is a single point.

    Example:
        >>> import trimesh
        >>> from lsmgeo.data import from_trimesh, normalise
        >>> mesh = normalise(from_trimesh(trimesh.creation.box((2, 3, 6))))
        >>> mesh.bounds[1] * 14
        array([2., 3., 6.])
    """
    who = "normalise"
    check_mesh(who, mesh)
    check_choice(who, "to", to, ("diagonal", "longest"))
    low, high = mesh.bounds
    extent = high - low
    size = float(np.linalg.norm(extent) if to == "diagonal" else extent.max())
    if not 0 < size < np.inf:
        raise OptionError(f"{who}: mesh must have a size; got one of {size}")
    # Halves first: the sum of two large coordinates could overflow.
    return replace(mesh, vertices=(mesh.vertices - (0.5 * low + 0.5 * high)) / size)
