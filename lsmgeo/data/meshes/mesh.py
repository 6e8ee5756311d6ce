"""Triangle meshes: a plain value."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo._checks import LARGEST_COUNT, check_choice, describe
from lsmgeo.data.meshes.mesh_topology import is_watertight
from lsmgeo.errors import DTypeError, OptionError, ShapeError

if TYPE_CHECKING:
    import trimesh

__all__ = ["DEFAULT_COLOUR", "Mesh", "check_mesh", "from_trimesh", "normalise"]

# Of faces without a colour: the grey of a default `lsmgeo.scenes.Material`.
DEFAULT_COLOUR = (0.7, 0.7, 0.7)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, checked at construction; the arrays must not be modified.

    Attributes:
        vertices: (N, 3) float64, finite, world units.
        faces: (F, 3) int64 vertex numbers; seen from outside, counter-clockwise.
        face_colours: (F, 3) float32 RGB in [0, 1], or None.
        colours: (N, 3) uint8 RGB of the vertices, or None.

    Raises:
        ShapeError: a wrong shape.
        DTypeError: not an array of numbers.
        OptionError: a face with a vertex out of range, a number that is not finite, a colour outside [0, 1].

    Example:
        >>> import numpy as np
        >>> from lsmgeo.data import Mesh
        >>> Mesh(np.eye(3), np.array([[0, 1, 2]])).watertight
        False
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_colours: np.ndarray | None = None
    colours: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        vertices = _array("vertices", self.vertices, "(N, 3) numbers", "fiu", np.float64)
        faces = _array("faces", self.faces, "(F, 3) whole numbers", "iu", np.int64)
        if max(len(faces), len(vertices)) > LARGEST_COUNT:
            raise ShapeError(f"Mesh: expected fewer than 2^31 vertices and faces; got {len(vertices)}, {len(faces)}")
        if not np.isfinite(vertices).all():
            raise OptionError("Mesh: vertices must be finite; got a NaN or an infinity")
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise OptionError(
                f"Mesh: faces must name vertices 0 to {len(vertices) - 1}; got {faces.min()}..{faces.max()}"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        for name, of, kind, dtype in (("face_colours", faces, "f", np.float32), ("colours", vertices, "u", np.uint8)):
            if (value := getattr(self, name)) is None:
                continue
            colours = _array(name, value, f"({len(of)}, 3) {np.dtype(dtype)}", kind, dtype)
            if len(colours) != len(of):
                raise ShapeError(f"Mesh: {name} must be ({len(of)}, 3); got {colours.shape}")
            if kind == "u" and value.dtype != np.uint8:
                raise DTypeError(f"Mesh: {name} must be uint8; got {value.dtype}")
            if kind == "f" and not ((colours >= 0) & (colours <= 1)).all():
                raise OptionError(f"Mesh: {name} must be in [0, 1]; got {colours.min()}..{colours.max()}")
            object.__setattr__(self, name, colours)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    @cached_property
    def watertight(self) -> bool:
        """Whether every edge belongs to exactly two faces; coinciding vertices count as one."""
        return is_watertight(self.vertices, self.faces)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3): minimum and maximum x, y, z of the vertices of faces."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack((used.min(0), used.max(0)))


def _array(name: str, value: object, expected: str, kinds: str, dtype: type) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
        raise DTypeError(f"Mesh: {name} must be a numpy array, {expected}; got {describe(value)}")
    if value.ndim != 2 or value.shape[1] != 3:
        raise ShapeError(f"Mesh: {name} must be {expected}; got {value.shape}")
    return np.ascontiguousarray(value, dtype)


def check_mesh(who: str, mesh: object, *, least: int = 1) -> None:
    """Raise unless ``mesh`` is a `Mesh` with at least ``least`` faces."""
    if not isinstance(mesh, Mesh):
        raise DTypeError(f"{who}: mesh must be a lsmgeo.data.Mesh (see from_trimesh); got {describe(mesh)}")
    if len(mesh.faces) < least:
        raise ShapeError(f"{who}: mesh must have at least one face; got {mesh}")


def from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    """A `trimesh.Trimesh` as a `Mesh`, with colours of faces or vertices but no textures.

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


def normalise(mesh: Mesh, *, to: str = "diagonal") -> Mesh:
    """Move the centre of the bounding box to the origin and scale it to unit size.

    Args:
        mesh: any mesh.
        to: "diagonal" makes the box's diagonal 1, as in ShapeNet, and "longest" its longest side.

    Returns:
        The mesh, within [-0.5, 0.5]^3.

    Raises:
        DTypeError: not a `Mesh`.
        ShapeError: a mesh without faces.
        OptionError: another `to`, or a mesh of zero size.

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
        raise OptionError(f"{who}: mesh must have a size that is positive and finite; got {size}")
    # Halves first: the sum of two large coordinates could overflow.
    return replace(mesh, vertices=(mesh.vertices - (0.5 * low + 0.5 * high)) / size)
