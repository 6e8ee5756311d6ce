"""Conversion between kornia's camera classes and the four fields of `lsmgeo.cameras.CameraTensors`."""

from __future__ import annotations

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

__all__ = ["PinholeCamera", "from_fields", "to_fields"]


def to_fields(camera: PinholeCamera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Intrinsics, extrinsics, heights and widths of a ``PinholeCamera`` or of its subclass ``PinholeCamerasList``.

    The matrices are (N, 4, 4) or (B, V, 4, 4) as kornia stores them, the sizes (N,) or (B,).
    """
    return camera.intrinsics, camera.extrinsics, camera.height, camera.width


def from_fields(intrinsics: Tensor, cam_from_world: Tensor, height: Tensor, width: Tensor) -> PinholeCamera:
    """One ``PinholeCamera`` of K (..., 3, 3), extrinsics (..., 4, 4) and sizes (...), leading axes flattened."""
    corner = intrinsics.new_tensor([0.0, 0.0, 0.0, 1.0])
    intrinsics = torch.cat((intrinsics, torch.zeros_like(intrinsics[..., :1])), -1)
    intrinsics = torch.cat((intrinsics, corner.expand(*intrinsics.shape[:-2], 1, 4)), -2)
    matrices = (intrinsics.reshape(-1, 4, 4), cam_from_world.reshape(-1, 4, 4))
    return PinholeCamera(*matrices, height.reshape(-1), width.reshape(-1))
