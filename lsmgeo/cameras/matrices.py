"""Matrices of cameras in float64, from which the operators' matrices are composed."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._linalg import basis_row, inverse_3x3, multiply, transform
from lsmgeo.cameras.tensors import CameraTensors, image_sizes

__all__ = ["CameraMatrices", "camera_matrices", "is_unskewed", "pinhole_matrix", "resize_matrix"]


class CameraMatrices(NamedTuple):
    """Cameras in float64 for images of one size: K (..., 3, 3), R (..., 3, 3), t (..., 3), camera centre C (..., 3)."""

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor
    center: Tensor

    def projection(self) -> Tensor:
        """P = K [R|t], (..., 3, 4): pixel from world."""
        return multiply(self.intrinsics, torch.cat((self.rotation, self.translation[..., None]), -1))

    def homogeneous_pixels(self, points: Tensor) -> Tensor:
        """``depth (u, v, 1) = K (R X + t)`` of points (..., N, 3) in float64, (..., N, 3)."""
        P = self.projection()[..., None, :, :]
        x, y, z = points[..., None].unbind(-2)  # (..., N, 1)
        return P[..., 0] * x + P[..., 1] * y + P[..., 2] * z + P[..., 3]

    def windows(self, corners: Tensor, size: tuple[int, int], near: float = 1e-6) -> Tensor:
        """First and last + 1 row and column (..., 4) of the pixels that can show boxes with corners (..., N, 3).

        With a margin of one pixel for rounding; all pixels for a box that is not in front of the near plane.
        """
        x, y, depth = self.homogeneous_pixels(corners).unbind(-1)
        in_front, sides = (depth > near).all(-1), []
        for pixel, count in ((y, size[0]), (x, size[1])):
            pixel = pixel / depth.clamp_min(near)
            first, last = (pixel.amin(-1).floor() - 1).clamp(0, count), (pixel.amax(-1).ceil() + 2).clamp(0, count)
            sides += [torch.where(in_front, first, 0), torch.where(in_front, last, count)]
        return torch.stack(sides, -1).long()

    def world_from_pixel(self) -> Tensor:
        """R^T K^-1, (..., 3, 3): applied to (u, v, 1), the step along a pixel's ray that advances camera z by 1."""
        return multiply(self.rotation.transpose(-1, -2), inverse_3x3(self.intrinsics))

    def pixel_steps(self, height: int, width: int) -> Tensor:
        """``R^T K^-1 (u, v, 1)`` of all pixels, (..., height, width, 3)."""
        M = self.world_from_pixel()[..., None, None, :, :]
        u, v = (torch.arange(n, dtype=M.dtype, device=M.device)[:, None] for n in (width, height))
        return M[..., 0] * u + M[..., 1] * v[:, None] + (M[..., 2] + 0.0)  # + 0.0: no negative zeros

    def world_from_frustum(self) -> Tensor:
        """T, (..., 4, 4), with ``X ~ T (u, v, 1/depth, 1)``; column three is the camera centre."""
        rays = self.world_from_pixel()
        rows = torch.cat((rays[..., :2], self.center[..., None], rays[..., 2:]), -1)
        return torch.cat((rows, basis_row(rows, 4, 2)), -2)


def pinhole_matrix(fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor) -> Tensor:
    """K, (..., 3, 3), without skew, of focal lengths and principal points (...) of one shape."""
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), -1).unflatten(-1, (3, 3))


def is_unskewed(K: Tensor) -> Tensor:
    """Whether each K (..., 3, 3) is diagonal but for the principal point, (...) bool."""
    shear = torch.maximum(K[..., 0, 1].abs(), K[..., 1, 0].abs())
    return shear <= 1e-6 * torch.minimum(K[..., 0, 0].abs(), K[..., 1, 1].abs())


def resize_matrix(
    height: Tensor, width: Tensor, new_height: int | Tensor, new_width: int | Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """S, (..., 3, 3), with ``K' = S K``: fx' = fx w/W, cx' = (cx + 0.5) w/W - 0.5, skew' = skew w/W, same in y.

    This is the rule for integer pixel centres and images that tile the same area. kornia's ``PinholeCamera.scale`` has
    cx' = s cx instead, which contradicts kornia's own pixel grid (kornia issue 4263).
    """
    scale_x = new_width / width.to(dtype)
    scale_y = new_height / height.to(dtype)
    return pinhole_matrix(scale_x, scale_y, 0.5 * scale_x - 0.5, 0.5 * scale_y - 0.5)


def camera_matrices(
    cameras: CameraTensors, size: tuple[int, int] | None = None, view_mask: Tensor | None = None
) -> CameraMatrices:
    """Convert cameras to float64, and K to another image size.

    Args:
        cameras: from `as_tensors`, leading shape (...).
        size: (height, width) of the images to be sampled; None for the cameras' own.
        view_mask: (...) bool; cameras where it is False are not read and get no gradient: they become the identity.

    Returns:
        `CameraMatrices`. The last rows of K and of the extrinsics are not read.
    """
    intrinsics, cam_from_world = cameras.intrinsics, cameras.cam_from_world
    height, width = image_sizes(cameras)
    if view_mask is not None:
        used = view_mask[..., None, None]
        identity = torch.eye(4, dtype=intrinsics.dtype, device=intrinsics.device)
        intrinsics = torch.where(used, intrinsics, identity[:3, :3])
        cam_from_world = torch.where(used, cam_from_world, identity)
        height, width = (torch.where(view_mask, side, torch.ones_like(side)) for side in (height, width))
    K = intrinsics[..., :2, :].double()
    K = torch.cat((K, basis_row(K, 3, 2)), -2)
    if size is not None:
        K = multiply(resize_matrix(height, width, *size), K)
    R = cam_from_world[..., :3, :3].double()
    t = cam_from_world[..., :3, 3].double()
    return CameraMatrices(K, R, t, -transform(R.transpose(-1, -2), t))
