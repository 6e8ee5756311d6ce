"""Posed photographs from files, and shards of shapes to train on: one typed sample, whatever the format."""

from lsmgeo.data.colmap import read_colmap
from lsmgeo.data.detect import open_scene
from lsmgeo.data.files import atomic_file, read_image, write_atomic, write_point_cloud
from lsmgeo.data.loading import EpochSampler, ShapeDataset
from lsmgeo.data.members import encode_sample
from lsmgeo.data.middlebury import read_middlebury
from lsmgeo.data.posed import Observations, PosedImages, SparsePoints
from lsmgeo.data.sample import Batch, Sample, check_sample, collate
from lsmgeo.data.shard_reading import ShardSet
from lsmgeo.data.shards import hash_settings, verify_shard, write_shard

open = open_scene

__all__ = [
    "Batch",
    "EpochSampler",
    "Observations",
    "PosedImages",
    "Sample",
    "ShapeDataset",
    "ShardSet",
    "SparsePoints",
    "atomic_file",
    "check_sample",
    "collate",
    "encode_sample",
    "hash_settings",
    "open",
    "open_scene",
    "read_colmap",
    "read_image",
    "read_middlebury",
    "verify_shard",
    "write_atomic",
    "write_point_cloud",
    "write_shard",
]
