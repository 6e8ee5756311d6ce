"""The frustum volume by kornia's warps, plane by plane.

kornia has no operator for it; a user stacks the planes of `DepthWarper` (a constant depth a plane) or of
`homography_warp` (the homography that the plane induces). Neither tells what is visible.
"""

from __future__ import annotations

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.depth import DepthWarper
from kornia.geometry.transform import homography_warp
from torch import Tensor

from benchmarks.problems import IMAGE, LeftOut, Run, Scene
from benchmarks.rivals import STATISTICS, feature_intrinsics


def _four(K: Tensor, E: Tensor) -> tuple[Tensor, Tensor]:
    """K (N, 3, 3) as kornia's (N, 4, 4)."""
    wide = torch.eye(4, dtype=K.dtype, device=K.device).repeat(len(K), 1, 1)
    wide[:, :3, :3] = K
    return wide, E


def _views(scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """K and E of all views and of the frustum of each view's scene, (B V, 3, 3) and (B V, 4, 4), at feature size."""
    problem = scene.problem
    if problem.operator != "frustum":
        raise LeftOut("no frustum")
    if problem.statistic not in ("", *STATISTICS):
        raise LeftOut("not written")
    K = feature_intrinsics(scene.cameras.intrinsics, (IMAGE, IMAGE), (problem.size,) * 2)
    E = scene.cameras.cam_from_world
    frustum = K[:, :1].clone()
    frustum[..., :2, 2] -= scene.frustum_offset  # the window that is swept
    K0, E0 = frustum.expand_as(K), E[:, :1].expand_as(E)
    return K.flatten(0, 1), E.flatten(0, 1), K0.flatten(0, 1), E0.flatten(0, 1)


def _finish(scene: Scene, planes: list[Tensor]) -> tuple[Tensor, None]:
    problem = scene.problem
    volume = torch.stack(planes, 2).unflatten(0, (problem.B, problem.V))  # (B, V, C, P, h, w)
    if problem.statistic == "mean":
        return volume.mean(1), None
    if problem.statistic == "variance":
        return volume.var(1, correction=0), None
    return volume, None


def depth_warper(scene: Scene) -> Run:
    """`DepthWarper` at one constant depth after another."""
    K, E, K0, E0 = _views(scene)
    problem = scene.problem
    side, features_side = problem.frustum_size, problem.size

    def run(features: Tensor) -> tuple[Tensor, None]:
        sizes = torch.full((len(K),), float(features_side), device=K.device)
        to = PinholeCamera(*_four(K, E), sizes, sizes)
        # One size serves both its pixel grid and its normalisation: the grid is cut to the window afterwards.
        warper = DepthWarper(to, features_side, features_side)
        warper.grid = warper.grid[:, :side, :side]
        warper.compute_projection_matrix(PinholeCamera(*_four(K0, E0), sizes, sizes))
        maps, plane = features.flatten(0, 1), features.new_ones(len(K), 1, side, side)
        return _finish(scene, [warper(plane * depth, maps) for depth in scene.depths])

    return run


def homographies(scene: Scene) -> Run:
    """`homography_warp` by the homography of one plane after another."""
    K, E, K0, E0 = _views(scene)
    side = (scene.problem.frustum_size,) * 2

    def run(features: Tensor) -> tuple[Tensor, None]:
        relative = E @ torch.linalg.inv(E0)
        rotation, translation = relative[:, :3, :3], relative[:, :3, 3:]
        back = torch.linalg.inv(K0)
        normal = K.new_tensor([[0.0, 0.0, 1.0]])
        maps = features.flatten(0, 1)
        planes = []
        for depth in scene.depths:
            homography = K @ (rotation + translation @ normal / depth) @ back  # pixel of the plane to pixel of the view
            planes.append(homography_warp(maps, homography, side, normalized_coordinates=False))
        return _finish(scene, planes)

    return run
