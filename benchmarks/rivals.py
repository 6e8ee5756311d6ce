"""What a competent user writes by hand: projection, near test, visibility and `grid_sample`; and what other systems do.

No checks of arguments, points and pixels laid out as `grid_sample` wants them. One size of image, no mask, nothing
appended. A site in the camera centre gives NaN to gradients of cameras; the work timed asks for those of features and
volumes alone. Geometry is float32; half precision is sampled in float32, as its coordinates would lose whole pixels.

Other systems loop over views, as their papers' formulas say: they hold one view's volume at a time and add it to
running sums, which is how they save memory. Backward through them keeps every view's volume all the same. kornia has no
operator for a frustum; a user stacks the planes of `DepthWarper` (a constant depth a plane) or of `homography_warp`
(the homography that the plane induces). Of these only the running mean computes visibility.
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

NEAR = 1e-6
MODES = {"smooth": "bilinear", "nearest": "nearest"}  # `grid_sample` uses this name in three dimensions too


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
    coordinates = 2.0 * points  # cell edges at -1 and 1, as in grid_sample
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


def sample_volume(volume: Tensor, points: Tensor, mode: str) -> tuple[Tensor, Tensor]:
    """A volume (B, C, D, H, W) over the cube of side 1 at points (B, N, 3): (B, C, N) and visibility."""
    coordinates = 2.0 * points  # cell edges at -1 and 1, as in grid_sample
    visible = ((coordinates >= -1.0) & (coordinates < 1.0)).all(-1)
    values = grid_sample(volume.float(), coordinates[:, :, None, None], mode=MODES[mode], align_corners=False)
    return values[..., 0, 0].to(volume.dtype), visible


def competitor(scene: Scene) -> Run:
    """The hand-written solution of a problem."""
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

    if problem.operator == "points":
        return lambda volume: sample_volume(volume, scene.points, problem.mode)
    return swept if problem.operator == "sweep" else lifted


def running_mean(scene: Scene) -> Run:
    """Atlas (Murez et al., 2020): every voxel takes the nearest pixel; the sum over views over their number."""
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
    """Functions that warp one view's features to the planes (B, C, P, h, w) and crop the frustum of the first."""
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
    # `torch.var` over views takes many times as long as sums of squares.
    return volume.square().mean(1) - volume.mean(1).square() if problem.statistic else volume, None


def depth_warper(scene: Scene) -> Run:
    """`DepthWarper` for one plane after another."""
    K, E, K0, E0 = (matrices.flatten(0, 1) for matrices in frustum(scene, "", "variance"))
    K, K0 = (pad(matrices, (0, 1, 0, 1)) for matrices in (K, K0))  # kornia's (N, 4, 4)
    K[:, 3, 3] = K0[:, 3, 3] = 1.0
    problem = scene.problem
    side = problem.frustum_size

    def run(features: Tensor) -> tuple[Tensor, None]:
        sizes = torch.full((len(K),), float(problem.size), device=K.device)
        # One size sets both its pixel grid and its normalisation: the grid is cropped to the window afterwards.
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
