"""Loops over views as the well-known systems describe them, written from their papers' formulas.

Each holds one view's volume at a time and adds it to running sums, which is how these systems save memory. Backward
through them keeps every view's volume all the same.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from benchmarks.problems import IMAGE, LeftOut, Run, Scene
from benchmarks.rivals import NEAR, feature_intrinsics


def running_mean(scene: Scene) -> Run:
    """Atlas (Murez et al., 2020): every voxel takes the nearest pixel, views are summed and divided by their count."""
    problem = scene.problem
    if (problem.operator, problem.mode, problem.statistic) != ("unproject", "nearest", "mean"):
        raise LeftOut("means of nearest pixels only")
    size = (problem.size, problem.size)
    K = feature_intrinsics(scene.cameras.intrinsics, (IMAGE, IMAGE), size)
    P = K @ scene.cameras.cam_from_world[..., :3, :]

    def run(features: Tensor) -> tuple[Tensor, Tensor]:
        B, V, C, h, w = features.shape
        centers = scene.grid.centers().to(P).reshape(-1, 3)
        points = torch.cat((centers, torch.ones_like(centers[:, :1])), 1).T  # (4, N)
        total = features.new_zeros(B, C, points.shape[1])
        seen = []
        for v in range(V):
            camera = P[:, v] @ points  # (B, 3, N)
            depth = camera[:, 2]
            x = (camera[:, 0] / depth).round().long()
            y = (camera[:, 1] / depth).round().long()
            valid = (x >= 0) & (y >= 0) & (x < w) & (y < h) & (depth > 0)
            volume = features.new_zeros(B, C, points.shape[1])
            for b in range(B):
                volume[b, :, valid[b]] = features[b, v][:, y[b, valid[b]], x[b, valid[b]]]
            total = total + volume
            seen.append(valid)
        visible = torch.stack(seen, 1)
        mean = total / visible.sum(1).clamp(min=1)[:, None]
        sites = scene.grid.shape
        return mean.unflatten(-1, sites), visible.unflatten(-1, sites)

    return run


def _warped(features: Tensor, K: Tensor, E: Tensor, K0: Tensor, E0: Tensor, depths: Tensor, side: int) -> Tensor:
    """One view's features (B, C, h, w) at the planes of the frustum K0, E0 of (side, side) pixels: (B, C, P, h, w)."""
    B, C, h, w = features.shape
    rows = torch.arange(side, dtype=K.dtype, device=K.device)
    v, u = torch.meshgrid(rows, rows, indexing="ij")
    pixels = torch.stack((u, v, torch.ones_like(u))).reshape(3, -1)
    relative = E @ torch.linalg.inv(E0)
    rays = K @ relative[:, :3, :3] @ torch.linalg.inv(K0) @ pixels  # (B, 3, h w)
    offset = K @ relative[:, :3, 3:]
    x = rays[:, :, None] * depths[:, None] + offset[..., None]  # (B, 3, P, h w)
    depth = x[:, 2]
    pixel = x[:, :2] / torch.where(depth > NEAR, depth, 1.0)[:, None]
    coordinates = torch.stack(((2.0 * pixel[:, 0] + 1.0) / w - 1.0, (2.0 * pixel[:, 1] + 1.0) / h - 1.0), -1)
    return grid_sample(features, coordinates, align_corners=False).reshape(B, C, len(depths), side, side)


def _frustum(scene: Scene, statistic: str) -> tuple[Tensor, Tensor, Tensor, int, slice]:
    problem = scene.problem
    if (problem.operator, problem.mode, problem.statistic) != ("frustum", "smooth", statistic):
        raise LeftOut(f"{statistic} volumes of a frustum only")
    K = feature_intrinsics(scene.cameras.intrinsics, (IMAGE, IMAGE), (problem.size,) * 2)
    K0 = K[:, 0].clone()
    K0[:, :2, 2] -= scene.frustum_offset
    side = problem.frustum_size
    return K, scene.cameras.cam_from_world, K0, side, slice(scene.frustum_offset, scene.frustum_offset + side)


def variance_volume(scene: Scene) -> Run:
    """MVSNet (Yao et al., 2018): running sum and sum of squares of warped features; their variance over the views.

    The first view's own features need no warp. Every view counts at every site, seen or not.
    """
    K, E, K0, side, window = _frustum(scene, "variance")

    def run(features: Tensor) -> tuple[Tensor, None]:
        V = features.shape[1]
        first = features[:, 0, :, window, window][:, :, None].expand(-1, -1, len(scene.depths), -1, -1)
        total, squares = first, first**2
        for v in range(1, V):
            warped = _warped(features[:, v], K[:, v], E[:, v], K0, E[:, 0], scene.depths, side)
            total = total + warped
            squares = squares + warped**2
        return squares / V - (total / V) ** 2, None

    return run


def dot_volume(scene: Scene) -> Run:
    """A correlation volume: warped features times those of the first view, averaged over channels, view by view."""
    K, E, K0, side, window = _frustum(scene, "dot")

    def run(features: Tensor) -> tuple[Tensor, None]:
        first = features[:, 0, :, window, window][:, :, None]
        products = [
            (_warped(features[:, v], K[:, v], E[:, v], K0, E[:, 0], scene.depths, side) * first).mean(1)
            for v in range(1, features.shape[1])
        ]
        return torch.stack(products, 1), None

    return run
