"""Pinhole cameras: one plain form, conversion from and to kornia's classes, and the conventions of other tools.

Only this package imports kornia's camera classes. Conventions: OpenCV axes (x right, y down, z forward), world-to-
camera extrinsics ``X_cam = R X_world + t``, integer pixel centres.
"""

from lsmgeo.cameras.converters import (
    from_colmap,
    from_opencv,
    from_opengl,
    from_pytorch3d,
    to_colmap,
    to_opencv,
    to_opengl,
    to_pytorch3d,
)
from lsmgeo.cameras.projection import centers, project, rays, unproject_depth
from lsmgeo.cameras.tensors import CameraTensors, as_tensors, select, stack, to
from lsmgeo.cameras.transforms import crop, look_at, orbit, perturb, resize

__all__ = [
    "CameraTensors",
    "as_tensors",
    "centers",
    "crop",
    "from_colmap",
    "from_opencv",
    "from_opengl",
    "from_pytorch3d",
    "look_at",
    "orbit",
    "perturb",
    "project",
    "rays",
    "resize",
    "select",
    "stack",
    "to",
    "to_colmap",
    "to_opencv",
    "to_opengl",
    "to_pytorch3d",
    "unproject_depth",
]
