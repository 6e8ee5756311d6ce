"""Posed photographs from files: one typed sample, whatever the format."""

from lsmgeo.data.colmap import read_colmap
from lsmgeo.data.detect import open_scene
from lsmgeo.data.files import read_image, write_atomic, write_point_cloud
from lsmgeo.data.middlebury import read_middlebury
from lsmgeo.data.posed import Observations, PosedImages, SparsePoints

open = open_scene

__all__ = [
    "Observations",
    "PosedImages",
    "SparsePoints",
    "open",
    "open_scene",
    "read_colmap",
    "read_image",
    "read_middlebury",
    "write_atomic",
    "write_point_cloud",
]
