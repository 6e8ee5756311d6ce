"""Multi-view stereo networks: V-LSM, D-LSM and the baseline 3D-R2N2, their losses and weights."""

from lsmgeo._old_names import old_names
from lsmgeo.models.blocks import Model
from lsmgeo.models.creating import create, from_settings, settings_of
from lsmgeo.models.depth_lsm import DepthLSM
from lsmgeo.models.losses import compute_loss, sum_loss
from lsmgeo.models.outputs import DepthOutput, DepthResult, VoxelOutput, VoxelResult
from lsmgeo.models.r2n2 import R2N2, R2N2Settings
from lsmgeo.models.settings import DepthSettings, TrunkSettings, VoxelSettings
from lsmgeo.models.voxel_lsm import VoxelLSM
from lsmgeo.models.weights import load, write_weights

__all__ = [
    "R2N2",
    "DepthLSM",
    "DepthOutput",
    "DepthResult",
    "DepthSettings",
    "Model",
    "R2N2Settings",
    "TrunkSettings",
    "VoxelLSM",
    "VoxelOutput",
    "VoxelResult",
    "VoxelSettings",
    "compute_loss",
    "create",
    "from_settings",
    "load",
    "settings_of",
    "sum_loss",
    "write_weights",
]

__getattr__ = old_names(__name__, {"MachineSettings": "TrunkSettings"})
