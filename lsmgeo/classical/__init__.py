"""Reconstruction without learning, on the library's own operators."""

from lsmgeo.classical.plane_sweep import DepthMap, kept, sweep
from lsmgeo.classical.reconstruct import Reconstruction, reconstruct_view
from lsmgeo.classical.views import default_depth_range, select_neighbours

__all__ = [
    "DepthMap",
    "Reconstruction",
    "default_depth_range",
    "kept",
    "reconstruct_view",
    "select_neighbours",
    "sweep",
]
