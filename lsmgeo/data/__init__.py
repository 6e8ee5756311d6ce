"""Images with known cameras from files, and shards of shapes for training: one typed sample for every format."""

from lsmgeo._old_names import old_names
from lsmgeo.data.atomic_files import atomic_file, write_atomic
from lsmgeo.data.formats.depth_files import DepthFile, DepthPng
from lsmgeo.data.formats.detection import FORMATS, Format, detect, open_scene
from lsmgeo.data.formats.format_binvox import read_binvox
from lsmgeo.data.formats.format_cameras_json import read_cameras_json
from lsmgeo.data.formats.format_colmap import read_colmap
from lsmgeo.data.formats.format_llff import read_llff
from lsmgeo.data.formats.format_lsm import read_lsm
from lsmgeo.data.formats.format_middlebury import Disparity, read_middlebury, read_stereo_pair
from lsmgeo.data.formats.format_opencv import Board, CalibratedLens, Calibration, Rig, read_calibration
from lsmgeo.data.formats.format_r2n2 import read_r2n2
from lsmgeo.data.formats.format_rgbd import read_rgbd, read_seven_scenes
from lsmgeo.data.formats.format_strecha import read_strecha
from lsmgeo.data.formats.format_transforms import read_transforms
from lsmgeo.data.formats.lenses import Lens
from lsmgeo.data.formats.scene_writers import write_cameras_json, write_colmap, write_point_cloud, write_transforms
from lsmgeo.data.images import read_image
from lsmgeo.data.meshes import Mesh, from_trimesh, load_mesh, normalise
from lsmgeo.data.meshes.mesh_rendering import render_mesh
from lsmgeo.data.meshes.voxelise import voxelise
from lsmgeo.data.posed_images import Observations, PosedImages, SparsePoints, Voxels
from lsmgeo.data.sample import Batch, Sample, check_sample, collate
from lsmgeo.data.shards import hash_settings, verify_shard, write_shard
from lsmgeo.data.shards.convert_set import convert_set
from lsmgeo.data.shards.load_shards import EpochSampler, ShapeDataset
from lsmgeo.data.shards.read_shards import ShardSet
from lsmgeo.data.shards.render_set import SetResult, render_set
from lsmgeo.data.shards.shape_sources import Recipe
from lsmgeo.data.shards.shard_members import encode_sample

open = open_scene
__getattr__ = old_names(__name__, {"Made": "SetResult"})

__all__ = [
    "FORMATS",
    "Batch",
    "Board",
    "CalibratedLens",
    "Calibration",
    "DepthFile",
    "DepthPng",
    "Disparity",
    "EpochSampler",
    "Format",
    "Lens",
    "Mesh",
    "Observations",
    "PosedImages",
    "Recipe",
    "Rig",
    "Sample",
    "SetResult",
    "ShapeDataset",
    "ShardSet",
    "SparsePoints",
    "Voxels",
    "atomic_file",
    "check_sample",
    "collate",
    "convert_set",
    "detect",
    "encode_sample",
    "from_trimesh",
    "hash_settings",
    "load_mesh",
    "normalise",
    "open",
    "open_scene",
    "read_binvox",
    "read_calibration",
    "read_cameras_json",
    "read_colmap",
    "read_image",
    "read_llff",
    "read_lsm",
    "read_middlebury",
    "read_r2n2",
    "read_rgbd",
    "read_seven_scenes",
    "read_stereo_pair",
    "read_strecha",
    "read_transforms",
    "render_mesh",
    "render_set",
    "verify_shard",
    "voxelise",
    "write_atomic",
    "write_cameras_json",
    "write_colmap",
    "write_point_cloud",
    "write_shard",
    "write_transforms",
]
