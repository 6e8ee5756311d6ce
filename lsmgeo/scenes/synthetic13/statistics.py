"""Measures of the variety of a category."""

from __future__ import annotations

from typing import NamedTuple

import torch

from lsmgeo._checks import check_size
from lsmgeo.errors import ShapeError
from lsmgeo.scenes.inside import voxels
from lsmgeo.scenes.synthetic13.shapes import shape

__all__ = ["Measured", "measure"]


class Measured(NamedTuple):
    """The variety of one category over a number of shapes.

    Attributes:
        structures: number of different structures.
        parameters: number of different continuous parameters.
        fewest: least number of continuous parameters of a shape.
        parts: mean number of solids.
        fill: mean fraction of occupied voxels.
        iou: mean intersection over union of the occupancy of two shapes, over all pairs.
    """

    structures: int
    parameters: int
    fewest: int
    parts: float
    fill: float
    iou: float


def measure(category: str, *, count: int = 40, seed: int = 0, size: int = 32) -> Measured:
    """Measure the variety of a category.

    Args:
        category: one of `CATEGORIES`.
        count: number of shapes, at least 2: those of index 0 to count - 1.
        seed: the set.
        size: voxels per side.

    Returns:
        The measures.

    Raises:
        OptionError: an unknown category.
        ShapeError: a count below 2.

    Example:
        >>> from lsmgeo.scenes import synthetic13
        >>> synthetic13.measure("lamp", count=6).iou < 0.6
        True
    """
    (count,) = check_size("measure", "count", (count,), 1, "an integer")
    if count < 2:
        raise ShapeError(f"measure: count must be at least 2, to have a pair; got {count}")
    shapes = [shape(seed, index, category) for index in range(count)]
    volumes = voxels([item.scene for item in shapes], size).flatten(1).float()
    shared, sizes = volumes @ volumes.T, volumes.sum(1)
    iou = shared / (sizes[:, None] + sizes - shared)
    first, second = torch.triu_indices(count, count, 1)
    return Measured(
        structures=len({item.structure for item in shapes}),
        parameters=len(set().union(*(item.parameters for item in shapes))),
        fewest=min(len(item.parameters) for item in shapes),
        parts=sum(len(item.scene.solids) for item in shapes) / count,
        fill=float(volumes.mean()),
        iou=float(iou[first, second].mean()),
    )
