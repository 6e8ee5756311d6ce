"""Shapes by number: a seed and an index determine a shape, its lights and its views.

Equal numbers give equal shapes on one installation. Another installation may differ by rounding, with numpy's LAPACK,
or entirely, if numpy changes a random stream.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from lsmgeo._checks import check_size, check_whole
from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.errors import OptionError
from lsmgeo.scenes.lighting import Lights
from lsmgeo.scenes.primitives import Kind, Solid
from lsmgeo.scenes.synthetic13.parameters import Parameters, random_palette
from lsmgeo.scenes.tables import Scene

__all__ = ["CATEGORIES", "CLASS_SPLITS", "SyntheticShape", "random_lights", "shape", "split", "views"]

CATEGORIES = {
    "airplane": "02691156",
    "bench": "02828884",
    "cabinet": "02933112",
    "car": "02958343",
    "chair": "03001627",
    "display": "03211117",
    "lamp": "03636649",
    "speaker": "03691459",
    "rifle": "04090263",
    "sofa": "04256520",
    "table": "04379243",
    "telephone": "04401088",
    "vessel": "04530566",
}
"""The categories in their order, with the ShapeNet synset of each."""

CLASS_SPLITS = {
    "first": ("cabinet", "chair", "lamp", "table", "telephone", "vessel"),
    "second": ("airplane", "bench", "car", "display", "speaker", "rifle", "sofa"),
}
"""The two halves of the experiment that trains on some categories and tests on the others."""

# No part is thinner than this, so that a grid of 64 voxels per side cannot miss one.
LEAST_THICKNESS = 0.026
# By how much each part is grown more than the previous one: over a hundred roundings of a depth of 2 in float32, but
# the last of forty parts grows by only a sixth of a pixel of a 224 pixel image.
SEPARATION = 2e-5
# The last number of the seed: the purpose of the stream.
GEOMETRY, COLOURS, LIGHTS, VIEWS, SPLIT = range(5)


class SyntheticShape(NamedTuple):
    """One shape of the set.

    Attributes:
        name: category and index, unique in a set.
        category: one of `CATEGORIES`.
        structure: the discrete choices as "name=value", in the order they were made.
        parameters: the continuous parameters, by name, in the units of the category's generator.
        counts: the numbers of repeated parts, by name.
        scene: the parts, y up, facing +x; their bounding box without cuts is centred and has a diagonal of 1.
        lights: two or three distant lights and ambient light, float64.
    """

    name: str
    category: str
    structure: tuple[str, ...]
    parameters: dict[str, float]
    counts: dict[str, int]
    scene: Scene
    lights: Lights


def shape(seed: int, index: int, category: str | None = None) -> SyntheticShape:
    """One shape of the set; it depends only on the arguments.

    Faces of different parts do not coincide: each part is grown by a little more than the previous one, so of two parts
    with a common surface the later one is visible, regardless of rounding.

    Args:
        seed: the set, 0 <= seed < 2**32.
        index: the shape's number in the set, 0 <= index < 2**32.
        category: one of `CATEGORIES`; None cycles through the categories (``index % 13``), so that the
            first shapes of a set have as many of each.

    Returns:
        The shape, with its appearance.

    Raises:
        OptionError: a number out of range, an unknown category.

    Example:
        >>> from lsmgeo.scenes import synthetic13
        >>> chair = synthetic13.shape(0, 4)
        >>> chair.name, len(chair.scene.solids)
        ('chair-00000004', 5)
        >>> chair.structure
        ('base=pedestal', 'back=none', 'seat=round')
    """
    geometry = _generator("shape", seed, index, GEOMETRY)
    if category is None:
        category = tuple(CATEGORIES)[index % len(CATEGORIES)]
    if category not in CATEGORIES:
        raise OptionError(f"shape: category must be one of {', '.join(CATEGORIES)}; got {category!r}")
    build = importlib.import_module(f"lsmgeo.scenes.synthetic13.{category}").build
    parameters = Parameters(geometry)
    parts = _normalised(build(parameters, random_palette(_generator("shape", seed, index, COLOURS))))
    parts = [_grown(_thickened(part, LEAST_THICKNESS), SEPARATION * place) for place, part in enumerate(parts)]
    return SyntheticShape(
        name=f"{category}-{index:08d}",
        category=category,
        structure=tuple(f"{name}={value}" for name, value in parameters.choices.items()),
        parameters=parameters.numbers,
        counts=parameters.counts,
        scene=Scene(_normalised(parts)),
        lights=random_lights(_generator("shape", seed, index, LIGHTS)),
    )


def views(seed: int, index: int, count: int, size: int) -> CameraTensors:
    """Cameras that look at a shape, drawn as in the LSM paper (Section 5): all around, from slightly above or below.

    Azimuths are uniform in [0, 360) degrees, elevations in [-20, 30]; the distance is 2 and the focal length
    1.875 ``size``. The first views do not depend on ``count``.

    Args:
        seed: the set, as in `shape`.
        index: the shape's number in the set.
        count: number of views, at least 1.
        size: image height and width in pixels.

    Returns:
        Cameras with leading shape (count,), float64.

    Raises:
        OptionError: seed or index out of range.
        ShapeError: no views, no pixels.

    Example:
        >>> from lsmgeo.scenes import synthetic13
        >>> cameras = synthetic13.views(0, 4, 20, 224)
        >>> cameras.cam_from_world.shape, cameras.intrinsics[0, 0, 0].item()
        (torch.Size([20, 4, 4]), 420.0)
    """
    (count,) = check_size("views", "count", (count,), 1, "an integer")
    angles = torch.from_numpy(_generator("views", seed, index, VIEWS).random((count, 2)))
    azimuth, elevation = 360 * angles[:, 0], 50 * angles[:, 1] - 20
    return orbit(azimuth, elevation, 2.0, focal_length=1.875 * size, height=size, width=size)


def split(seed: int, index: int) -> str:
    """The split that a shape and all its views belong to: "train", "val" or "test".

    A hash of (seed, index) modulo ten: seven classes are train, one is val, two are test. So the splits have 0.7, 0.1
    and 0.2 of the shapes on average, and do not change when a set grows.

    Args:
        seed: the set, as in `shape`.
        index: the shape's number in the set.

    Returns:
        The name of the split.

    Raises:
        OptionError: a number out of range.

    Example:
        >>> from lsmgeo.scenes import synthetic13
        >>> [synthetic13.split(0, index) for index in range(4)]
        ['test', 'train', 'train', 'train']
    """
    ticket = int(_sequence("split", seed, index, SPLIT).generate_state(1, np.uint64)[0]) % 10
    return "train" if ticket < 7 else "val" if ticket == 7 else "test"


def random_lights(generator: np.random.Generator) -> Lights:
    """Two or three distant lights, mostly from above, and ambient light, all nearly white.

    A white surface that faces all lights would have 1.05 to 1.3 of full brightness; about one hundredth of a white
    sphere is clipped.

    Args:
        generator: the source of randomness.

    Returns:
        Lights without leading axes, float64.

    Example:
        >>> import numpy as np
        >>> from lsmgeo.scenes.synthetic13 import random_lights
        >>> random_lights(np.random.default_rng(0)).directions.shape
        torch.Size([3, 3])
    """
    count = int(generator.integers(2, 4))
    azimuth = 2 * np.pi * (generator.random() + (np.arange(count) + generator.uniform(-0.3, 0.3, count)) / count)
    elevation = np.deg2rad(generator.uniform(5, 70, count))
    directions = np.stack(
        (np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)), 1
    )
    ambient = generator.uniform(0.3, 0.5)
    shares = generator.uniform(0.5, 1.0, count) * np.array([1.5, 1.0, 1.0])[:count]
    power = (generator.uniform(1.05, 1.3) - ambient) * shares / shares.sum()
    tint = generator.uniform(0.94, 1.0, (count + 1, 3))
    return Lights(
        torch.from_numpy(directions), torch.from_numpy(power[:, None] * tint[:-1]), torch.from_numpy(ambient * tint[-1])
    )


def _sequence(who: str, seed: int, index: int, salt: int) -> np.random.SeedSequence:
    for name, value in (("seed", seed), ("index", index)):
        check_whole(who, name, value, 0, 2**32 - 1)
    return np.random.SeedSequence([int(seed), int(index), salt])


def _generator(who: str, seed: int, index: int, salt: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(_sequence(who, seed, index, salt)))


def _normalised(parts: list[Solid]) -> list[Solid]:
    """The parts centred at the origin, with a bounding box of diagonal 1."""
    bounds = [part.bounds() for part in parts]
    low, high = np.min([low for low, _ in bounds], 0), np.max([high for _, high in bounds], 0)
    scale = 1 / np.linalg.norm(high - low)
    matrix = np.c_[scale * np.eye(3), -scale * (low + high) / 2]
    return [part.transformed(matrix) for part in parts]


def _thickened(part: Solid, least: float) -> Solid:
    """The part with semi-axes of at least half of ``least``, about its own centre; its cuts stay."""
    left, sizes, right = np.linalg.svd(part.world_from_local[:, :3])
    if sizes[-1] >= least / 2:
        return part
    linear = (left * np.maximum(sizes, least / 2)) @ right
    return replace(part, world_from_local=np.c_[linear, part.world_from_local[:, 3]])


def _grown(part: Solid, distance: float) -> Solid:
    """The part with its faces moved outwards by ``distance``, and cuts adjusted so that openings stay open.

    Flat faces and round cylinders move by exactly ``distance``, whatever their size: coincident surfaces separate if
    their distances differ, and touching parts overlap. Bounded cuts grow like the faces they open; half-spaces clip
    less.
    """
    cuts = tuple(_grown(cut, -distance if cut.kind is Kind.HALF_SPACE else distance) for cut in part.cuts)
    inverse = np.linalg.inv(part.world_from_local[:, :3])
    # A row is the gradient of a local coordinate: its faces are at a distance of 1 / length from the centre.
    lengths = np.linalg.norm(inverse, axis=1)
    if part.kind is Kind.HALF_SPACE:
        return part.moved(distance / lengths[1] * inverse[1])
    return replace(part, world_from_local=part.world_from_local * np.append(1 + distance * lengths, 1.0), cuts=cuts)
