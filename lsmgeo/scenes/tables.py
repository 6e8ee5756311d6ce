"""Scenes, and the numbers of their primitives as rows of tensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.scenes.primitives import Kind, Material, Solid

__all__ = ["Placed", "Scene", "Tables", "check_scenes", "layout"]

WAVES = 6


@dataclass(frozen=True, eq=False)
class Scene:
    """The union of solids.

    Attributes:
        solids: at least one `Solid`.

    Example:
        >>> from lsmgeo import scenes
        >>> scene = scenes.Scene([scenes.sphere((0, 0, 0), 0.5), scenes.box((0, -0.6, 0), (1, 0.2, 1))])
        >>> scene.bounds()[0]
        array([-0.5, -0.7, -0.5])
    """

    solids: tuple[Solid, ...]

    def __init__(self, solids: Sequence[Solid]) -> None:
        solids = tuple(solids)
        if not solids or not all(isinstance(solid, Solid) for solid in solids):
            raise OptionError(f"Scene: solids must be at least one Solid; got {solids!r:.80}")
        object.__setattr__(self, "solids", solids)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest (x, y, z) of the solids without cuts."""
        lower, upper = zip(*(solid.bounds() for solid in self.solids), strict=True)
        return np.min(lower, 0), np.max(upper, 0)

    def transformed(self, matrix: np.ndarray) -> Scene:
        """The scene transformed by an affine (3, 4) or (4, 4) matrix."""
        return Scene([solid.transformed(matrix) for solid in self.solids])


class Tables(NamedTuple):
    """N primitives, including those subtracted, as rows; float64.

    The surface of a primitive is where the largest of these functions of the local point is 0: ``x - high`` and
    ``low - x`` on each axis, and ``sqrt(round . x^2) - (radius + slope y)``.
    """

    kinds: tuple[Kind, ...]
    linear: Tensor  # (N, 3, 3): local = linear (world - center)
    axes: Tensor  # (N, 3, 3), its inverse
    center: Tensor  # (N, 3)
    low: Tensor  # (N, 3)
    high: Tensor  # (N, 3)
    round: Tensor  # (N, 3), 1 for an axis that the curved surface depends on
    radius: Tensor  # (N,)
    slope: Tensor  # (N,)
    taper: Tensor  # (N,)
    side: Tensor  # (N,), -1 for subtracted primitives, whose surface is visible from inside
    colour: Tensor  # (N, 2, 3)
    textured: Tensor  # (N,) bool
    checker: Tensor  # (N,) bool
    waves: Tensor  # (N, WAVES, 3) radians per world unit
    phase: Tensor  # (N, WAVES)
    weight: Tensor  # (N, WAVES)

    def to(self, device: torch.device, dtype: torch.dtype) -> Tables:
        """The tables on a device, numbers in ``dtype``."""
        return Tables(
            self.kinds, *(value.to(device, dtype if value.is_floating_point() else value.dtype) for value in self[1:])
        )


class Placed(NamedTuple):
    """The rows of a solid and its cuts in the tables."""

    kind: Kind
    row: int
    cuts: tuple[tuple[Kind, int], ...]


def check_scenes(who: str, scenes: Sequence[Scene]) -> tuple[Scene, ...]:
    """The scenes as a tuple.

    Raises:
        OptionError: not a sequence of `Scene`.
        ShapeError: no scene.
    """
    if isinstance(scenes, Scene) or not isinstance(scenes, Iterable):
        raise OptionError(f"{who}: scenes must be a sequence of Scene; got {scenes!r:.80}")
    scenes = tuple(scenes)
    if not all(isinstance(scene, Scene) for scene in scenes):
        raise OptionError(f"{who}: scenes must be a sequence of Scene; got {scenes!r:.80}")
    if not scenes:
        raise ShapeError(f"{who}: scenes must hold at least one Scene; got none")
    return scenes


# Of canonical primitives: low, high, round, radius; a cone's radius and slope follow from its taper.
INF = float("inf")
CANONICAL = {
    Kind.HALF_SPACE: ((-INF,) * 3, (INF, 0.0, INF), (0.0,) * 3, INF),
    Kind.SPHERE: ((-INF,) * 3, (INF,) * 3, (1.0,) * 3, 1.0),
    Kind.BOX: ((-1.0,) * 3, (1.0,) * 3, (0.0,) * 3, INF),
    Kind.CYLINDER: ((-INF, -1.0, -INF), (INF, 1.0, INF), (1.0, 0.0, 1.0), 1.0),
    Kind.CONE: ((-INF, -1.0, -INF), (INF, 1.0, INF), (1.0, 0.0, 1.0), 0.0),
}


def layout(scenes: Sequence[Scene]) -> tuple[Tables, list[list[Placed]]]:
    """The primitives of scenes as rows of one table, and a list for each scene with the rows of its solids."""
    primitives: list[Solid] = []
    sides: list[float] = []
    materials: list[Material] = []
    placed = []
    for scene in scenes:
        entries = []
        for solid in scene.solids:
            first = len(primitives)
            cuts = tuple((cut.kind, first + 1 + index) for index, cut in enumerate(solid.cuts))
            entries.append(Placed(solid.kind, first, cuts))
            primitives += (solid, *solid.cuts)
            sides += [1.0] + [-1.0] * len(cuts)
            materials += [solid.material] * (1 + len(cuts))
        placed.append(entries)
    return _tables(primitives, sides, materials), placed


def _tables(solids: Sequence[Solid], sides: Sequence[float], materials: Sequence[Material]) -> Tables:
    matrices = np.stack([solid.world_from_local for solid in solids])
    taper = np.array([solid.taper if solid.kind is Kind.CONE else 1.0 for solid in solids])
    is_cone = np.array([solid.kind is Kind.CONE for solid in solids])
    low, high, curved, radius = (np.array([CANONICAL[s.kind][i] for s in solids], dtype=np.float64) for i in range(4))
    looks = {material: _texture(material) for material in set(materials)}
    waves, phase, weight = (np.stack([looks[material][i] for material in materials]) for i in range(3))
    rows = (
        np.linalg.inv(matrices[:, :, :3]),
        matrices[:, :, :3],
        matrices[:, :, 3],
        low,
        high,
        curved,
        np.where(is_cone, (1 + taper) / 2, radius),
        np.where(is_cone, (taper - 1) / 2, 0.0),
        taper,
        np.asarray(sides, dtype=np.float64),
        np.array([(material.colour, material.second) for material in materials], dtype=np.float64),
        np.array([material.texture != "plain" for material in materials]),
        np.array([material.texture == "checker" for material in materials]),
        waves,
        phase,
        weight,
    )
    return Tables(tuple(solid.kind for solid in solids), *(torch.from_numpy(np.ascontiguousarray(row)) for row in rows))


def _texture(material: Material) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wave vectors (WAVES, 3), phases and weights of a material's texture."""
    random = np.random.default_rng([material.seed, 20171])
    directions = random.normal(size=(WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phase = random.uniform(0, 2 * np.pi, WAVES)
    waves = 2 * np.pi * material.frequency * directions
    if material.texture == "stripes":
        return waves, phase, np.eye(WAVES)[0] / 2
    if material.texture == "waves":
        # Frequencies from half of the stated one up to it; the sum is seldom outside [-1/2, 1/2], and clamped.
        return waves * np.linspace(0.5, 1, WAVES)[:, None], phase, np.full(WAVES, 0.5 / np.sqrt(WAVES))
    if material.texture == "checker":
        # The product of the signs of three orthogonal waves; half a period is the edge of a cube.
        basis = np.linalg.qr(directions[:3].T)[0].T
        return np.r_[2 * np.pi * material.frequency * basis, np.zeros((WAVES - 3, 3))], phase, np.zeros(WAVES)
    return np.zeros((WAVES, 3)), np.zeros(WAVES), np.zeros(WAVES)
