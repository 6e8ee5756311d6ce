"""The operators as functions. All checks live here; the layers are one line over these.

Conventions of every function: pixel centres at integers, OpenCV camera axes, world-to-camera extrinsics, depth is
camera z; features (B, V, C, h, w), grids (B, C, D, H, W), cameras with batch B*V, view fastest. A feature map of
another size than the camera's image is resized for inside: never rescale K by hand.
"""

from lsmgeo.functional.image_sampling import (
    Unprojected,
    sample_views,
    unproject,
    unproject_points,
    unproject_slabs,
    view_statistics,
)
from lsmgeo.functional.volume_sampling import Projected, Sampled, plane_sweep_project, sample_volume, splat

__all__ = [
    "Projected",
    "Sampled",
    "Unprojected",
    "plane_sweep_project",
    "sample_views",
    "sample_volume",
    "splat",
    "unproject",
    "unproject_points",
    "unproject_slabs",
    "view_statistics",
]
