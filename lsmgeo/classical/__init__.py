"""Reconstruction without learning, with the operators of the library."""

from lsmgeo.classical.consistency import consistent_views
from lsmgeo.classical.depth_range import find_depth_range
from lsmgeo.classical.filtering import guided_filter
from lsmgeo.classical.matching import MatchingCosts, aggregate_views, matching_costs
from lsmgeo.classical.plane_sweep import DepthMap, kept, sweep
from lsmgeo.classical.planes import sweep_planes
from lsmgeo.classical.silhouettes import signed_distance, silhouettes
from lsmgeo.classical.stereo import Reconstruction, SceneReconstruction, reconstruct_scene, reconstruct_view
from lsmgeo.classical.surface import SurfaceMesh, drop_specks, extract_mesh, write_mesh
from lsmgeo.classical.tsdf import Tsdf, fuse_depth
from lsmgeo.classical.views import default_depth_range, select_neighbours
from lsmgeo.classical.visual_hull import VisualHull, default_grid, hull_box, visual_hull

__all__ = [
    "DepthMap",
    "MatchingCosts",
    "Reconstruction",
    "SceneReconstruction",
    "SurfaceMesh",
    "Tsdf",
    "VisualHull",
    "aggregate_views",
    "consistent_views",
    "default_depth_range",
    "default_grid",
    "drop_specks",
    "extract_mesh",
    "find_depth_range",
    "fuse_depth",
    "guided_filter",
    "hull_box",
    "kept",
    "matching_costs",
    "reconstruct_scene",
    "reconstruct_view",
    "select_neighbours",
    "signed_distance",
    "silhouettes",
    "sweep",
    "sweep_planes",
    "visual_hull",
    "write_mesh",
]
