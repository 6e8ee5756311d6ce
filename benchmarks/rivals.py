"""What a competent user writes by hand: projection, near test, visibility and `grid_sample`, nothing else.

No checks of arguments, everything in the features' dtype, points and pixels laid out as `grid_sample` wants them. One
size of image, no mask, nothing appended. A site in the camera centre gives NaN to gradients of cameras; the work timed
asks for those of features and volumes alone.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

NEAR = 1e-6


def feature_intrinsics(K: Tensor, image: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """K of images resized to `size`, integer pixel centres."""
    sy, sx = size[0] / image[0], size[1] / image[1]
    scale = K.new_tensor([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    return scale @ K


def unproject(features: Tensor, K: Tensor, E: Tensor, centers: Tensor, image: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Features (B, V, C, h, w) at voxel centres (D, H, W, 3): volume (B, V, C, D, H, W) and visibility."""
    B, V, C, h, w = features.shape
    sites = centers.shape[:3]
    P = feature_intrinsics(K, image, (h, w)) @ E[..., :3, :]  # (B, V, 3, 4)
    x = torch.matmul(centers.reshape(-1, 3), P[..., :3].transpose(-1, -2)) + P[..., None, :, 3]  # (B, V, N, 3)
    depth = x[..., 2]
    front = depth > NEAR
    pixels = x[..., :2] / torch.where(front, depth, 1.0)[..., None]
    size = pixels.new_tensor([w, h])
    visible = front & ((pixels >= -0.5) & (pixels < size - 0.5)).all(-1)
    coordinates = (2.0 * pixels + 1.0) / size - 1.0
    values = grid_sample(features.flatten(0, 1), coordinates.flatten(0, 1)[:, None], align_corners=False)
    values = torch.where(front[:, :, None], values.reshape(B, V, C, -1), 0.0)
    return values.reshape(B, V, C, *sites), visible.reshape(B, V, *sites)


def plane_sweep_project(
    volume: Tensor,
    K: Tensor,
    E: Tensor,
    depths: Tensor,
    image: tuple[int, int],
    size: tuple[int, int],
    lower: float,
    upper: float,
) -> tuple[Tensor, Tensor]:
    """A volume (B, C, D, H, W) over a cube along the rays of (B, V) cameras: maps (B, V, C, P, h, w) and visibility."""
    B, V = K.shape[:2]
    h, w = size
    v, u = torch.meshgrid(torch.arange(h, dtype=K.dtype), torch.arange(w, dtype=K.dtype), indexing="ij")
    pixels = torch.stack((u, v, torch.ones_like(u)), -1).reshape(-1, 3)
    rotation, translation = E[..., :3, :3], E[..., :3, 3]
    to_world = rotation.transpose(-1, -2) @ torch.linalg.inv(feature_intrinsics(K, image, size))
    rays = pixels @ to_world.transpose(-1, -2)  # (B, V, h w, 3)
    center = -(rotation.transpose(-1, -2) @ translation[..., None])[..., 0]
    points = center[:, :, None, None] + depths[:, None, None] * rays[:, :, None]  # (B, V, P, h w, 3)
    coordinates = (points - lower) * (2.0 / (upper - lower)) - 1.0  # cell edges at -1 and 1, as grid_sample has them
    front = (depths > NEAR)[:, None]
    visible = front & ((coordinates >= -1.0) & (coordinates < 1.0)).all(-1)
    source = volume[:, None].expand(B, V, *volume.shape[1:]).flatten(0, 1)
    values = grid_sample(source, coordinates.reshape(B * V, len(depths), h, w, 3), align_corners=False)
    values = values.reshape(B, V, -1, len(depths), h, w)
    return torch.where(front[..., None], values, 0.0), visible.reshape(B, V, len(depths), h, w)
