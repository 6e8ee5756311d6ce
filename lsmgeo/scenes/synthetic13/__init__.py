"""Synthetic-13: parametric shapes of the thirteen categories of the LSM paper, as analytic scenes."""

from lsmgeo.scenes.synthetic13.shapes import (
    CATEGORIES,
    CLASS_SPLITS,
    SyntheticShape,
    random_lights,
    shape,
    split,
    views,
)
from lsmgeo.scenes.synthetic13.statistics import Measured, measure

__all__ = [
    "CATEGORIES",
    "CLASS_SPLITS",
    "Measured",
    "SyntheticShape",
    "measure",
    "random_lights",
    "shape",
    "split",
    "views",
]
