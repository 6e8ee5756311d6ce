"""Analytic scenes: exact ray hits, depth, normals, silhouettes and occupancy of solids and their unions."""

from lsmgeo.scenes.lighting import Lights, shade
from lsmgeo.scenes.solids import Kind, Material, Solid, box, cone, cylinder, ellipsoid, half_space, sphere

__all__ = [
    "Kind",
    "Lights",
    "Material",
    "Solid",
    "box",
    "cone",
    "cylinder",
    "ellipsoid",
    "half_space",
    "shade",
    "sphere",
]
