"""Volumes as other systems make them: loops over views, written from their papers' formulas, and kornia's warps.

The loops hold one view's volume at a time and add it to running sums, which is how these systems save memory. Backward
through them keeps every view's volume all the same. kornia has no operator for a frustum; a user stacks the planes of
`DepthWarper` (a constant depth a plane) or of `homography_warp` (the homography that the plane induces). None but the
running mean tell what is visible.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.depth import DepthWarper
from kornia.geometry.transform import homography_warp
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from benchmarks.problems import IMAGE, LeftOut, Run, Scene
from benchmarks.rivals import NEAR, feature_intrinsics


def running_mean(scene: Scene) -> Run:
    """Atlas (Murez et al., 2020): every voxel takes the nearest pixel, views are summed and divided by their count."""
    problem = scene.problem
    if (problem.operator, problem.mode, problem.statistic) != ("unproject", "nearest", "mean"):
        raise LeftOut("means of nearest pixels only")
    K = feature_intrinsics(scene.cameras.intrinsics, (IMAGE, IMAGE), (problem.size,) * 2)
    P = K @ scene.cameras.cam_from_world[..., :3, :]

    def run(features: Tensor) -> tuple[Tensor, Tensor]:
        B, V, C, h, w = features.shape
        centers = scene.grid.centers().to(P).reshape(-1, 3)
        points = pad(centers, (0, 1), value=1.0).T  # (4, N)
        total = features.new_zeros(B, C, points.shape[1])
        seen = []
        for v in range(V):
            x, y, depth = (P[:, v] @ points).unbind(1)  # (B, N)
            x, y = (x / depth).round().long(), (y / depth).round().long()
            valid = (x >= 0) & (y >= 0) & (x < w) & (y < h) & (depth > 0)
            volume = torch.zeros_like(total)
            for b in range(B):
                volume[b, :, valid[b]] = features[b, v][:, y[b, valid[b]], x[b, valid[b]]]
            total = total + volume
            seen.append(valid)
        visible = torch.stack(seen, 1)
        mean = total / visible.sum(1).clamp(min=1)[:, None]
        return mean.unflatten(-1, scene.grid.shape), visible.unflatten(-1, scene.grid.shape)

    return run


def frustum(scene: Scene, *statistics: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """K and E of the views, at feature size, and of the frustum, which has the first view's pose."""
    problem = scene.problem
    if problem.operator != "frustum" or problem.mode != "smooth" or problem.statistic not in statistics:
        raise LeftOut(f"frusta only, {' or '.join(name or 'the volume of each view' for name in statistics)}")
    K = feature_intrinsics(scene.cameras.intrinsics, (IMAGE, IMAGE), (problem.size,) * 2)
    E = scene.cameras.cam_from_world
    K0 = K[:, :1].clone()
    K0[..., :2, 2] -= scene.window.start
    return K, E, K0.expand_as(K), E[:, :1].expand_as(E)


def warper(scene: Scene, statistic: str) -> tuple[Callable[[Tensor, int], Tensor], Callable[[Tensor], Tensor]]:
    """What warps one view's features to the planes (B, C, P, h, w), and what cuts the frustum from the first view's."""
    K, E, K0, E0 = frustum(scene, statistic)
    depths, side = scene.depths, scene.problem.frustum_size

    def warp(features: Tensor, view: int) -> Tensor:
        h, w = features.shape[-2:]
        rows = torch.arange(side, dtype=K.dtype, device=K.device)
        v, u = torch.meshgrid(rows, rows, indexing="ij")
        pixels = torch.stack((u, v, torch.ones_like(u))).reshape(3, -1)
        relative = E[:, view] @ torch.linalg.inv(E0[:, view])
        rays = K[:, view] @ relative[:, :3, :3] @ torch.linalg.inv(K0[:, view]) @ pixels  # (B, 3, h w)
        offset = K[:, view] @ relative[:, :3, 3:]
        x = rays[:, :, None] * depths[:, None] + offset[..., None]  # (B, 3, P, h w)
        depth = x[:, 2]
        pixel = x[:, :2] / torch.where(depth > NEAR, depth, 1.0)[:, None]
        coordinates = torch.stack(((2.0 * pixel[:, 0] + 1.0) / w - 1.0, (2.0 * pixel[:, 1] + 1.0) / h - 1.0), -1)
        values = grid_sample(features[:, view], coordinates, align_corners=False)
        return values.unflatten(-1, (side, side))

    return warp, lambda features: features[:, 0, :, scene.window, scene.window][:, :, None]


def variance_volume(scene: Scene) -> Run:
    """MVSNet (Yao et al., 2018): running sum and sum of squares of warped features; their variance over the views.

    The first view's own features need no warp. Every view counts at every site, seen or not.
    """
    warp, cut = warper(scene, "variance")

    def run(features: Tensor) -> tuple[Tensor, None]:
        V = features.shape[1]
        total = cut(features).expand(-1, -1, len(scene.depths), -1, -1)
        squares = total**2
        for v in range(1, V):
            warped = warp(features, v)
            total = total + warped
            squares = squares + warped**2
        return squares / V - (total / V) ** 2, None

    return run


def dot_volume(scene: Scene) -> Run:
    """A correlation volume: warped features times those of the first view, averaged over channels, view by view."""
    warp, cut = warper(scene, "dot")

    def run(features: Tensor) -> tuple[Tensor, None]:
        first = cut(features)
        return torch.stack([(warp(features, v) * first).mean(1) for v in range(1, features.shape[1])], 1), None

    return run


def stacked(scene: Scene, planes: list[Tensor]) -> tuple[Tensor, None]:
    """Planes (B V, C, h, w) as a volume, or its statistic over the views."""
    problem = scene.problem
    volume = torch.stack(planes, 2).unflatten(0, (problem.B, problem.V))  # (B, V, C, P, h, w)
    return volume.var(1, correction=0) if problem.statistic else volume, None


def depth_warper(scene: Scene) -> Run:
    """`DepthWarper` at one constant depth after another."""
    K, E, K0, E0 = (matrices.flatten(0, 1) for matrices in frustum(scene, "", "variance"))
    K, K0 = (pad(matrices, (0, 1, 0, 1)) for matrices in (K, K0))  # kornia's (N, 4, 4)
    K[:, 3, 3] = K0[:, 3, 3] = 1.0
    problem = scene.problem
    side = problem.frustum_size

    def run(features: Tensor) -> tuple[Tensor, None]:
        sizes = torch.full((len(K),), float(problem.size), device=K.device)
        # One size serves both its pixel grid and its normalisation: the grid is cut to the window afterwards.
        warper = DepthWarper(PinholeCamera(K, E, sizes, sizes), problem.size, problem.size)
        warper.grid = warper.grid[:, :side, :side]
        warper.compute_projection_matrix(PinholeCamera(K0, E0, sizes, sizes))
        maps, plane = features.flatten(0, 1), features.new_ones(len(K), 1, side, side)
        return stacked(scene, [warper(plane * depth, maps) for depth in scene.depths])

    return run


def homographies(scene: Scene) -> Run:
    """`homography_warp` by the homography of one plane after another."""
    K, E, K0, E0 = (matrices.flatten(0, 1) for matrices in frustum(scene, "", "variance"))
    size = (scene.problem.frustum_size,) * 2

    def run(features: Tensor) -> tuple[Tensor, None]:
        relative = E @ torch.linalg.inv(E0)
        rotation, translation = relative[:, :3, :3], relative[:, :3, 3:]
        back = torch.linalg.inv(K0)
        normal = K.new_tensor([[0.0, 0.0, 1.0]])
        maps = features.flatten(0, 1)
        planes = []
        for depth in scene.depths:
            homography = K @ (rotation + translation @ normal / depth) @ back  # pixel of the plane to pixel of the view
            planes.append(homography_warp(maps, homography, size, normalized_coordinates=False))
        return stacked(scene, planes)

    return run
