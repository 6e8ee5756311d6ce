"""Analytic scenes: exact ray hits, depth, normals, silhouettes and occupancy of CSG solids and their unions."""

from lsmgeo.scenes.backgrounds import background
from lsmgeo.scenes.inside import occupancy, voxels
from lsmgeo.scenes.lighting import Lights, shade
from lsmgeo.scenes.meshing import to_mesh
from lsmgeo.scenes.primitives import Kind, Material, Solid, box, cone, cylinder, ellipsoid, half_space, sphere
from lsmgeo.scenes.rendering import Hits, Rendering, render, trace
from lsmgeo.scenes.tables import Scene

__all__ = [
    "Hits",
    "Kind",
    "Lights",
    "Material",
    "Rendering",
    "Scene",
    "Solid",
    "background",
    "box",
    "cone",
    "cylinder",
    "ellipsoid",
    "half_space",
    "occupancy",
    "render",
    "shade",
    "sphere",
    "to_mesh",
    "trace",
    "voxels",
]
