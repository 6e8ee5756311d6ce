"""Closed forms in NumPy float64, independent of the library: the values that tests call ``expected``.

Nothing here imports the library or PyTorch. Every function is the textbook formula for one view or one
ray bundle; :mod:`tests.oracle.operators` loops over scenes and views.
"""

from tests.oracle.operators import frustum_index, plane_sweep, sample_volume, splat, unproject, view_statistics
from tests.oracle.projection import (
    backproject,
    camera_center,
    frustum_sites,
    homography,
    is_in_image,
    look_at,
    pixel_lattice,
    project,
    ray_direction,
    resize_intrinsics,
    rotation,
    voxel_sites,
    world_from_lattice,
)
from tests.oracle.sampling import is_inside, sample
from tests.oracle.tracing import hit_box, hit_plane, hit_sphere

__all__ = [
    "backproject",
    "camera_center",
    "frustum_index",
    "frustum_sites",
    "hit_box",
    "hit_plane",
    "hit_sphere",
    "homography",
    "is_in_image",
    "is_inside",
    "look_at",
    "pixel_lattice",
    "plane_sweep",
    "project",
    "ray_direction",
    "resize_intrinsics",
    "rotation",
    "sample",
    "sample_volume",
    "splat",
    "unproject",
    "view_statistics",
    "voxel_sites",
    "world_from_lattice",
]
