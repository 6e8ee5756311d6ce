"""Reconstruction without learning, on the library's own operators."""

from lsmgeo.classical.matching import MatchingCosts, aggregate_views, matching_costs, matching_costs_slabs
from lsmgeo.classical.plane_sweep import DepthMap, kept, sweep
from lsmgeo.classical.planes import sweep_planes
from lsmgeo.classical.reconstruct import Reconstruction, reconstruct_view
from lsmgeo.classical.views import default_depth_range, select_neighbours

__all__ = [
    "DepthMap",
    "MatchingCosts",
    "Reconstruction",
    "aggregate_views",
    "default_depth_range",
    "kept",
    "matching_costs",
    "matching_costs_slabs",
    "reconstruct_view",
    "select_neighbours",
    "sweep",
    "sweep_planes",
]
