"""What a competent user writes by hand: projection, near test, visibility and `grid_sample`, nothing else.

No checks of arguments, points and pixels laid out as `grid_sample` wants them. One size of image, no mask, nothing
appended. A site in the camera centre gives NaN to gradients of cameras; the work timed asks for those of features and
volumes alone. Geometry is float32; half precision is sampled in float32, as its coordinates would lose whole pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from benchmarks.problems import IMAGE, LeftOut, Run, Scene

NEAR = 1e-6
MODES = {"smooth": "bilinear", "nearest": "nearest"}  # `grid_sample` says bilinear in three dimensions too


def feature_intrinsics(K: Tensor, image: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """K of images resized to `size`, integer pixel centres."""
    sy, sx = size[0] / image[0], size[1] / image[1]
    scale = K.new_tensor([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    return scale @ K


def unproject(
    features: Tensor, K: Tensor, E: Tensor, centers: Tensor, image: tuple[int, int], mode: str = "smooth"
) -> tuple[Tensor, Tensor]:
    """Features (B, V, C, h, w) at sites (D, H, W, 3) or (B, D, H, W, 3): volume (B, V, C, D, H, W) and visibility."""
    B, V, C, h, w = features.shape
    sites = centers.shape[-4:-1]
    points = centers.reshape(*centers.shape[:-4], 1, -1, 3)
    P = feature_intrinsics(K, image, (h, w)) @ E[..., :3, :]  # (B, V, 3, 4)
    x = torch.matmul(points, P[..., :3].transpose(-1, -2)) + P[..., None, :, 3]  # (B, V, N, 3)
    depth = x[..., 2]
    front = depth > NEAR
    pixels = x[..., :2] / torch.where(front, depth, 1.0)[..., None]
    size = pixels.new_tensor([w, h])
    visible = front & ((pixels >= -0.5) & (pixels < size - 0.5)).all(-1)
    coordinates = ((2.0 * pixels + 1.0) / size - 1.0).flatten(0, 1)[:, None]
    values = grid_sample(features.flatten(0, 1).float(), coordinates, mode=MODES[mode], align_corners=False)
    values = torch.where(front[:, :, None], values.reshape(B, V, C, -1), 0.0).to(features.dtype)
    return values.reshape(B, V, C, *sites), visible.reshape(B, V, *sites)


def view_mean(volume: Tensor, visible: Tensor) -> Tensor:
    """Mean over the views that see a site."""
    seen = visible[:, :, None]
    return (volume * seen).sum(1) / seen.sum(1).clamp(min=1)


def view_variance(volume: Tensor, visible: Tensor) -> Tensor:
    """Mean of squares about the mean, over the views that see a site."""
    seen = visible[:, :, None]
    deviation = (volume - view_mean(volume, visible)[:, None]) * seen
    return deviation.square().sum(1) / seen.sum(1).clamp(min=1)


STATISTICS = {"mean": view_mean, "variance": view_variance}


def plane_sweep_project(
    volume: Tensor, K: Tensor, E: Tensor, depths: Tensor, image: tuple[int, int], size: tuple[int, int], mode: str
) -> tuple[Tensor, Tensor]:
    """A volume (B, C, D, H, W) over the cube of side 1 along the rays of (B, V) cameras.

    Returns:
        Maps (B, V, C, P, h, w) and visibility.
    """
    B, V = K.shape[:2]
    sites = (len(depths), *size)
    front = (depths > NEAR)[:, None]
    center, rays = pixel_rays(K, E, image, size)
    points = center[:, :, None, None] + depths[:, None, None] * rays[:, :, None]  # (B, V, P, h w, 3)
    coordinates = 2.0 * points  # cell edges at -1 and 1, as grid_sample has them
    visible = front & ((coordinates >= -1.0) & (coordinates < 1.0)).all(-1)
    source = volume.float()[:, None].expand(B, V, *volume.shape[1:]).flatten(0, 1)
    values = grid_sample(source, coordinates.reshape(B * V, *sites, 3), mode=MODES[mode], align_corners=False)
    values = torch.where(front[..., None], values.reshape(B, V, -1, *sites), 0.0).to(volume.dtype)
    return values, visible.reshape(B, V, *sites)


def pixel_rays(K: Tensor, E: Tensor, image: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Camera centres (..., 3), and directions (..., h w, 3) of pixels' rays, of camera z = 1."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=K.dtype, device=K.device) for n in size), indexing="ij")
    pixels = torch.stack((u, v, torch.ones_like(u)), -1).reshape(-1, 3)
    to_world = E[..., :3, :3].transpose(-1, -2) @ torch.linalg.inv(feature_intrinsics(K, image, size))
    return camera_centers(E), pixels @ to_world.transpose(-1, -2)


def camera_centers(E: Tensor) -> Tensor:
    return -(E[..., :3, :3].transpose(-1, -2) @ E[..., :3, 3:])[..., 0]


def contender(scene: Scene) -> Run:
    """The hand-written form of a problem."""
    problem = scene.problem
    K, E = scene.cameras.intrinsics, scene.cameras.cam_from_world
    image, size = (IMAGE, IMAGE), (problem.size, problem.size)
    if problem.operator == "reduce" or problem.statistic not in ("", *STATISTICS):
        raise LeftOut("not written")

    def lifted(features: Tensor) -> tuple[Tensor, Tensor]:
        volume, visible = unproject(features, K, E, scene.grid.centers().to(K), image, problem.mode)
        return STATISTICS[problem.statistic](volume, visible) if problem.statistic else volume, visible

    def swept(volume: Tensor) -> tuple[Tensor, Tensor]:
        maps, visible = plane_sweep_project(volume, K, E, scene.depths, image, size, problem.mode)
        return maps.flatten(2, 3) if problem.flatten else maps, visible

    return swept if problem.operator == "sweep" else lifted
