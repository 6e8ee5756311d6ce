"""Bird's-eye views, volumes and features at points in a few lines each.

``docs/recipes_volumes.rst`` shows them, and tests hold them to the formulas. Everywhere: features (B, V, C, h, w),
cameras (B, V), and grids whose z axis is up.
"""

import torch
from torch import Tensor

from lsmgeo import FrustumGrid, Unproject, VoxelGrid
from lsmgeo.cameras import CameraTensors, project, rays, resize
from lsmgeo.functional import sample_views, sample_volume, splat, unproject_points
from lsmgeo.rays import composite


def scaled(cameras: CameraTensors, x: float | Tensor, y: float | Tensor, size: tuple[int, int]) -> CameraTensors:
    """Cameras of a map of `size` (h, w) whose pixel (x u, y v) is the image's (u, v), as many originals do."""
    K = cameras.intrinsics
    scale = torch.stack(torch.broadcast_tensors(*(torch.as_tensor(side).to(K) for side in (x, y, 1.0))), -1)
    return CameraTensors(scale[..., None] * K, cameras.cam_from_world, *size)


def lift_splat(features: Tensor, logits: Tensor, cameras: CameraTensors, grid: VoxelGrid, depths: Tensor) -> Tensor:
    """Lift-Splat: features times depth probabilities, the softmax of logits (B, V, P, h, w), summed in each voxel."""
    volume = splat(features, cameras, grid, depths, weights=logits.softmax(2), mode="nearest")
    return volume.transpose(1, 2).flatten(1, 2)  # (B, D C, H, W), height in the channels


def lift_splat_as_published(
    features: Tensor, logits: Tensor, cameras: CameraTensors, grid: VoxelGrid, depths: Tensor
) -> Tensor:
    """Lift-Splat as its own code computes it: the corners of map and image coincide, and indices truncate toward 0."""
    h, w = features.shape[-2:]
    views = scaled(cameras, (w - 1) / (cameras.width - 1), (h - 1) / (cameras.height - 1), (h, w))
    lower = [low - (high - low) / n for low, high, n in zip(grid.lower, grid.upper, grid.shape[::-1], strict=True)]
    wider = VoxelGrid([n + 1 for n in grid.shape], lower, grid.upper, grid.world_from_grid)
    volume = splat(features, views, wider, depths, weights=logits.softmax(2), mode="nearest")
    for axis in (2, 3, 4):  # the first cell takes the samples of the one below it
        below, first, others = volume.tensor_split([1, 2], axis)
        volume = torch.cat((below + first, others), axis)
    return volume.transpose(1, 2).flatten(1, 2)


def bevformer_attention(
    features: Tensor, cameras: CameraTensors, grid: VoxelGrid, offsets: Tensor, weights: Tensor
) -> Tensor:
    """BEVFormer's cross-attention, one head: (B, C, H, W).

    Around each of N = D H W projected points, S samples at `offsets` (B, N, S, 2), in pixels of the feature map, with
    `weights` (B, N, S).
    """
    views = resize(cameras, *features.shape[-2:])
    points = grid.centers().to(features).flatten(-4, -2).expand(len(features), -1, 3)
    pixels, depth, visible = project(views, points)
    pixels = pixels[..., None, :] + offsets[:, None]  # (B, V, N, S, 2)
    depth = depth[..., None].expand(pixels.shape[:-1])
    values, _ = sample_views(features, pixels.flatten(2, 3), depth.flatten(2), depth.flatten(2) > 0)
    values = (values.unflatten(-1, depth.shape[2:]) * weights[:, None, None]).sum(-1)  # (B, V, C, N)
    pillars = values.unflatten(-1, grid.shape).sum(3)  # (B, V, C, H, W)
    hit = visible.unflatten(-1, grid.shape).any(2)[:, :, None]
    return (pillars * hit).sum(1) / hit.sum(1).clamp_min(1)


def simple_bev(features: Tensor, cameras: CameraTensors, grid: VoxelGrid) -> Tensor:
    """Simple-BEV: the mean over the views that see a voxel, height in the channels: (B, C D, H, W)."""
    return Unproject(grid, reduce="mean", padding_mode="border")(features, cameras).volume.flatten(1, 2)


def imvoxelnet_volume(features: Tensor, cameras: CameraTensors, grid: VoxelGrid) -> tuple[Tensor, Tensor]:
    """ImVoxelNet: the nearest feature, the mean over the views that see a voxel; and whether any does, (B, D, H, W)."""
    volume, visible = Unproject(grid, mode="nearest", reduce="mean")(features, cameras)
    return volume, visible.any(1)


def atlas_update(
    mean: Tensor, count: Tensor, features: Tensor, cameras: CameraTensors, grid: VoxelGrid
) -> tuple[Tensor, Tensor]:
    """Atlas: the running mean (B, C, D, H, W) and its number of views (B, 1, D, H, W), after V more views."""
    volume, visible = Unproject(grid, mode="nearest")(features, cameras)
    seen = visible.sum(1)[:, None]
    total = count + seen
    return mean + (volume.sum(1) - seen * mean) / total.clamp_min(1), total


def neuralrecon_points(features: Tensor, cameras: CameraTensors, points: Tensor) -> tuple[Tensor, Tensor]:
    """NeuralRecon's features (B, C + 1, N) of sparse voxels at `points` (B, N, 3), and how many views see each.

    The last channel is the mean depth, standardised over the voxels that are seen.
    """
    volume, visible = unproject_points(features, cameras, points, augment="depth", reduce="mean", padding_mode="border")
    count = visible.sum(1)  # (B, N)
    depth = volume[:, -1]
    mean = depth.sum(1, keepdim=True) / (count > 0).sum(1, keepdim=True).clamp_min(1)
    depth = torch.where(count > 0, depth - mean, 0.0)
    depth = depth / (depth.norm(dim=1, keepdim=True) + 1e-5)
    return torch.cat((volume[:, :-1], depth[:, None]), 1), count


def pixelnerf_inputs(features: Tensor, cameras: CameraTensors, points: Tensor, directions: Tensor) -> Tensor:
    """PixelNeRF's inputs (B, V, C + 6, N) at points (B, N, 3) of rays with `directions` (B, N, 3).

    Of each view: its feature, and the point and the ray's direction in the frame of its camera.
    """
    latent, _ = unproject_points(features, cameras, points, padding_mode="border")
    R, t = cameras.cam_from_world[..., :3, :3], cameras.cam_from_world[..., :3, 3:]
    return torch.cat((latent, R @ points[:, None].mT + t, R @ directions[:, None].mT), 2)


def mvsnerf_inputs(volume: Tensor, images: Tensor, cameras: CameraTensors, depths: Tensor, points: Tensor) -> Tensor:
    """MVSNeRF's inputs (B, C + 4 V, N) at points (B, N, 3) of rays.

    The volume (B, C, P, h, w) of the first view's frustum, and of each view the image's colour and whether it sees the
    point.
    """
    frustum = FrustumGrid(cameras.at((slice(None), 0)), depths, size=tuple(volume.shape[-2:]))
    latent, _ = sample_volume(volume, frustum, points)
    colours, seen = unproject_points(images, cameras, points, padding_mode="border")
    return torch.cat((latent, torch.cat((colours, seen[:, :, None]), 2).flatten(1, 2)), 1)


def mpi_view(
    mpi: Tensor, reference: CameraTensors, depths: Tensor, target: CameraTensors, size: tuple[int, int]
) -> Tensor:
    """The image (B, 3, H, W) that `target` sees of multiplane images (B, 4, P, h, w), RGB and alpha, of `reference`.

    Cameras have the leading shape (B,), depths (P,).
    """
    eye, directions = rays(target, size)  # (B, 3), (B, H, W, 3)
    forward = reference.cam_from_world[:, 2]  # depth in the reference: forward . (X, 1)
    start = (forward[:, :3] * eye).sum(-1) + forward[:, 3]
    slope = (directions * forward[:, None, None, :3]).sum(-1)
    along = (depths[:, None, None] - start[:, None, None, None]) / slope[:, None]  # (B, P, H, W)
    points = eye[:, None, None, None] + along[..., None] * directions[:, None]
    frustum = FrustumGrid(reference, depths, size=tuple(mpi.shape[-2:]))
    values = sample_volume(mpi, frustum, points.flatten(1, 3)).values.unflatten(-1, along.shape[1:])
    return composite(values[:, 3], values[:, :3], depths, along > 0).values
