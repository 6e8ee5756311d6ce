"""Convex primitives, and solids made of them by CSG subtraction: the parts of analytic scenes, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from lsmgeo._checks import check_whole
from lsmgeo.errors import OptionError

__all__ = ["Kind", "Material", "Solid", "box", "cone", "cylinder", "ellipsoid", "half_space", "sphere"]

Vector = Sequence[float] | np.ndarray


class Kind(IntEnum):
    """The canonical convex primitives in local coordinates (x, y, z); solids are affine images of them."""

    HALF_SPACE = 0  # y <= 0
    SPHERE = 1  # x^2 + y^2 + z^2 <= 1
    BOX = 2  # |x|, |y|, |z| <= 1
    CYLINDER = 3  # x^2 + z^2 <= 1, |y| <= 1
    CONE = 4  # x^2 + z^2 <= r(y)^2, |y| <= 1, r from 1 at y = -1 to taper at y = 1


TEXTURES = ("plain", "stripes", "checker", "waves")


@dataclass(frozen=True)
class Material:
    """The Lambertian colour of a solid's surface: one colour, or a solid texture between two.

    A texture is a function of the world position, so neighbouring solids of one material join without a seam.

    Attributes:
        colour: RGB in [0, 1].
        texture: "plain", "stripes" (soft bands), "checker" (cubes) or "waves" (six plane waves, band limited).
        second: the texture's other colour.
        frequency: periods per world unit.
        seed: of the texture's position and rotation.
    """

    colour: tuple[float, float, float] = (0.7, 0.7, 0.7)
    texture: str = "plain"
    second: tuple[float, float, float] = (0.2, 0.2, 0.2)
    frequency: float = 8.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("colour", "second"):
            colour = getattr(self, name)
            try:
                values = tuple(float(value) for value in colour)
            except (TypeError, ValueError):
                values = ()
            if len(values) != 3 or not all(0 <= value <= 1 for value in values):
                raise OptionError(f"Material: {name} must be three numbers in [0, 1]; got {colour!r:.80}")
            object.__setattr__(self, name, values)
        check_whole("Material", "seed", self.seed, 0)
        if self.texture not in TEXTURES:
            raise OptionError(f"Material: texture must be one of {', '.join(TEXTURES)}; got {self.texture!r}")
        if not 0 < self.frequency < float("inf"):
            raise OptionError(f"Material: frequency must be positive and finite; got {self.frequency!r}")


@dataclass(frozen=True, eq=False)
class Solid:
    """A primitive, an affine image of a canonical one, minus other primitives (CSG subtraction).

    Attributes:
        kind: the canonical primitive.
        world_from_local: (3, 4) float64, invertible; it may scale, shear and mirror.
        taper: of a cone: its radius at the far end over that at the near end, in [0, 1].
        material: the material of its surface, including the cut faces.
        cuts: the primitives subtracted from this one, and from no other; they have no cuts themselves.
    """

    kind: Kind
    world_from_local: np.ndarray
    taper: float = 1.0
    material: Material = field(default_factory=Material)
    cuts: tuple[Solid, ...] = ()

    def __post_init__(self) -> None:
        matrix = np.array(self.world_from_local, dtype=np.float64)
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise OptionError(f"Solid: world_from_local must be a finite (3, 4) matrix; got {matrix.shape}")
        sizes = np.linalg.norm(matrix[:, :3], axis=0)
        if not abs(np.linalg.det(matrix[:, :3])) > 1e-12 * sizes.prod() > 0:
            raise OptionError("Solid: world_from_local must be invertible; a size is zero")
        if not 0 <= self.taper <= 1:
            raise OptionError(f"Solid: taper must be in [0, 1]; got {self.taper!r}")
        if not all(isinstance(cut, Solid) and not cut.cuts for cut in self.cuts):
            raise OptionError("Solid: cuts must be Solids with no cuts of their own")
        matrix.setflags(write=False)
        object.__setattr__(self, "world_from_local", matrix)

    def transformed(self, matrix: Vector) -> Solid:
        """The solid and its cuts, transformed by an affine (3, 4) or (4, 4) matrix."""
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape not in ((3, 4), (4, 4)):
            raise OptionError(f"transformed: matrix must be affine, (3, 4) or (4, 4); got {matrix.shape}")
        matrix = matrix[:3]
        linear = matrix[:, :3] @ self.world_from_local
        linear[:, 3] += matrix[:, 3]
        return replace(self, world_from_local=linear, cuts=tuple(cut.transformed(matrix) for cut in self.cuts))

    def moved(self, offset: Vector) -> Solid:
        """The solid translated by (x, y, z)."""
        return self.transformed(np.c_[np.eye(3), np.asarray(offset, dtype=np.float64)])

    def rotated(self, axis: int, degrees: float, center: Vector = (0.0, 0.0, 0.0)) -> Solid:
        """The solid rotated about a line through ``center`` along x, y or z (``axis`` 0, 1, 2), right-handed."""
        R = rotation(axis, degrees)
        center = np.asarray(center, dtype=np.float64)
        return self.transformed(np.c_[R, center - R @ center])

    def scaled(self, factors: float | Vector, center: Vector = (0.0, 0.0, 0.0)) -> Solid:
        """The solid scaled along the coordinate axes from ``center``; a negative factor mirrors."""
        linear = np.diag(np.broadcast_to(np.asarray(factors, dtype=np.float64), 3))
        center = np.asarray(center, dtype=np.float64)
        return self.transformed(np.c_[linear, center - linear @ center])

    def mirrored(self, axis: int) -> Solid:
        """The solid reflected in the plane where coordinate ``axis`` is 0."""
        return self.scaled([-1.0 if index == axis else 1.0 for index in range(3)])

    def minus(self, *cuts: Solid) -> Solid:
        """The solid minus other primitives (CSG subtraction)."""
        return replace(self, cuts=self.cuts + cuts)

    def painted(self, material: Material) -> Solid:
        """The solid in another material."""
        return replace(self, material=material)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest (x, y, z), exact without cuts; infinite for a half-space."""
        linear, center = self.world_from_local[:, :3], self.world_from_local[:, 3]
        if self.kind is Kind.HALF_SPACE:
            return np.full(3, -np.inf), np.full(3, np.inf)
        if self.kind is Kind.SPHERE:
            reach = np.sqrt((linear**2).sum(1))
            return center - reach, center + reach
        if self.kind is Kind.BOX:
            reach = np.abs(linear).sum(1)
            return center - reach, center + reach
        # Two discs, at y = -1 and y = 1.
        disc = np.hypot(linear[:, 0], linear[:, 2])
        ends = np.stack((center - linear[:, 1], center + linear[:, 1]))
        reach = np.stack((disc, disc * (self.taper if self.kind is Kind.CONE else 1.0)))
        return (ends - reach).min(0), (ends + reach).max(0)


def rotation(axis: int, degrees: float) -> np.ndarray:
    """(3, 3) rotation about a coordinate axis, right-handed."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    matrix = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[[first, first, second, second], [first, second, first, second]] = cosine, -sine, sine, cosine
    return matrix


def sphere(center: Vector, radius: float, material: Material | None = None) -> Solid:
    """A ball."""
    return ellipsoid(center, (radius,) * 3, material)


def ellipsoid(center: Vector, radii: Vector, material: Material | None = None) -> Solid:
    """An ellipsoid with axes along x, y, z; rotate it with `Solid.rotated`."""
    return _placed(Kind.SPHERE, np.diag(_positive("ellipsoid", "radii", radii)), center, material)


def box(center: Vector, size: Vector, material: Material | None = None) -> Solid:
    """A box with edges of lengths ``size`` along x, y, z; rotate it with `Solid.rotated`."""
    return _placed(Kind.BOX, np.diag(_positive("box", "size", size)) / 2, center, material)


def cylinder(start: Vector, end: Vector, radius: float, material: Material | None = None) -> Solid:
    """A round cylinder between two points on its axis, flat at both ends."""
    return _round("cylinder", Kind.CYLINDER, start, end, radius, 1.0, material)


def cone(
    start: Vector, end: Vector, start_radius: float, end_radius: float = 0.0, material: Material | None = None
) -> Solid:
    """A cone, or a frustum of one, between two points on its axis; one radius may be 0."""
    if end_radius > start_radius:
        start, end, start_radius, end_radius = end, start, end_radius, start_radius
    if not end_radius >= 0:
        raise OptionError(f"cone: radii must not be negative; got {end_radius}")
    return _round("cone", Kind.CONE, start, end, start_radius, end_radius / max(start_radius, 1e-300), material)


def half_space(point: Vector, normal: Vector, material: Material | None = None) -> Solid:
    """The points on or below the plane through ``point``, on the side opposite to ``normal``.

    In a scene it is a floor or a wall; subtracted from a solid, it clips.
    """
    normal = np.asarray(normal, dtype=np.float64)
    frame = _frame("half_space", "normal", normal / _length("half_space", normal))
    return _placed(Kind.HALF_SPACE, frame, point, material)


def _round(
    who: str, kind: Kind, start: Vector, end: Vector, radius: float, taper: float, material: Material | None
) -> Solid:
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    half = (end - start) / 2
    length = _length(who, half)
    linear = _frame(who, "end", half / length) * np.array([_positive(who, "radius", [radius] * 3)[0], length, radius])
    return replace(_placed(kind, linear, (start + end) / 2, material), taper=float(taper))


def _placed(kind: Kind, linear: np.ndarray, center: Vector, material: Material | None) -> Solid:
    matrix = np.c_[linear, np.asarray(center, dtype=np.float64)]
    return Solid(kind, matrix, material=Material() if material is None else material)


def _positive(who: str, name: str, values: Vector) -> np.ndarray:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (3,) or not (np.isfinite(numbers) & (numbers > 0)).all():
        raise OptionError(f"{who}: {name} must be positive and finite; got {values!r}")
    return numbers


def _length(who: str, vector: np.ndarray) -> float:
    length = float(np.linalg.norm(vector))
    if not 0 < length < np.inf:
        raise OptionError(f"{who}: expected a direction of finite length above 0; got {vector.tolist()}")
    return length


def _frame(who: str, name: str, up: np.ndarray) -> np.ndarray:
    """A right-handed orthonormal frame (3, 3) whose second column is the unit vector ``up``."""
    if up.shape != (3,):
        raise OptionError(f"{who}: {name} must be (x, y, z); got shape {up.shape}")
    helper = np.eye(3)[np.abs(up).argmin()]
    x = np.cross(up, helper)
    x /= np.linalg.norm(x)
    return np.stack((x, up, np.cross(x, up)), 1)
