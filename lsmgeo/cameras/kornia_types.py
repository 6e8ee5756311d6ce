"""Conversion between kornia's camera classes and the four fields of `lsmgeo.cameras.CameraTensors`."""

from __future__ import annotations

from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import pad

from lsmgeo._linalg import homogeneous_row

__all__ = ["PinholeCamera", "from_fields", "to_fields"]


def to_fields(camera: PinholeCamera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Intrinsics, extrinsics, heights and widths of a ``PinholeCamera`` or of its subclass ``PinholeCamerasList``.

    The matrices are (N, 4, 4) or (B, V, 4, 4) as kornia stores them, the sizes (N,) or (B,).
    """
    return camera.intrinsics, camera.extrinsics, camera.height, camera.width


def from_fields(intrinsics: Tensor, cam_from_world: Tensor, height: Tensor, width: Tensor) -> PinholeCamera:
    """One ``PinholeCamera`` of K (..., 3, 3), extrinsics (..., 4, 4) and sizes (...), leading axes flattened."""
    intrinsics = homogeneous_row(pad(intrinsics, (0, 1)))  # (..., 4, 4)
    matrices = (intrinsics.reshape(-1, 4, 4), cam_from_world.reshape(-1, 4, 4))
    return PinholeCamera(*matrices, height.reshape(-1), width.reshape(-1))
