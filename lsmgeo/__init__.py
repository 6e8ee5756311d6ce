"""Features between images and 3D space: differentiable unprojection and plane-sweep projection on kornia cameras."""

from lsmgeo import cameras, errors, functional, fusion, kernels, rays
from lsmgeo.cameras import CameraTensors
from lsmgeo.debugging import debug
from lsmgeo.grids import FrustumGrid, VoxelGrid, depth_planes
from lsmgeo.layers import PlaneSweepProject, Unproject

__version__ = "0.1.0"

__all__ = [
    "CameraTensors",
    "FrustumGrid",
    "PlaneSweepProject",
    "Unproject",
    "VoxelGrid",
    "__version__",
    "cameras",
    "debug",
    "depth_planes",
    "errors",
    "functional",
    "fusion",
    "kernels",
    "rays",
]
