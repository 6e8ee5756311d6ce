"""Both operators in one module, and arguments for it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lsmgeo import (
    CameraTensors,
    FrustumGrid,
    PlaneSweepProject,
    Unproject,
    VoxelGrid,
    cameras,
    depth_planes,
    functional,
)

GRID = VoxelGrid((3, 4, 5), lower=(-0.5, -0.4, -0.3), upper=(0.4, 0.5, 0.6))
UNPROJECTIONS: dict[str, dict[str, Any]] = {
    "augmented": {"augment": ("depth", "direction")},
    "reduced": {"reduce": ("mean", "variance", "max"), "augment": "depth", "padding_mode": "border"},
    "nearest": {"mode": "nearest", "padding_mode": "border"},
}


class ThereAndBack(nn.Module):
    """Features to volumes, averaged over views, and swept back."""

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.unproject = Unproject(GRID, **options)
        self.project = PlaneSweepProject(GRID, depth_planes(1.5, 2.5, 6), size=(7, 9), augment="depth")

    def forward(
        self, features: Tensor, intrinsics: Tensor, cam_from_world: Tensor, height: Tensor, width: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        views = CameraTensors(intrinsics, cam_from_world, height, width)
        volume, visible = self.unproject(features, views)
        fused = volume if self.unproject.reduce is not None else volume.mean(1)
        maps, swept = self.project(fused, views)
        return volume, visible, maps, swept


def read_at_points(volume: Tensor, points: Tensor, K: Tensor, E: Tensor, depths: Tensor, pose: Tensor) -> Tensor:
    """A volume (B, C, D, H, W) at points (B, N, 3), on voxels and on a frustum, (2, B, C, N)."""
    voxels = VoxelGrid(tuple(volume.shape[2:]), world_from_grid=pose)
    frustum = FrustumGrid(CameraTensors(K, E, 24, 32), depths, tuple(volume.shape[3:]))
    return torch.stack([functional.sample_volume(volume, grid, points).values for grid in (voxels, frustum)])


def points_arguments(scenes: int) -> tuple[Tensor, ...]:
    """Arguments of `read_at_points`."""
    generator = torch.Generator().manual_seed(7)
    seen = views(scenes, 1)
    volume = torch.rand(scenes, 2, 4, 5, 6, generator=generator)
    points = 0.8 * torch.rand(scenes, 11, 3, generator=generator) - 0.4
    depths = torch.linspace(1.4, 2.4, 4) + 0.1 * torch.rand(scenes, 1, generator=generator)
    return volume, points, seen.intrinsics[:, 0], seen.cam_from_world[:, 0], depths, torch.eye(4).repeat(scenes, 1, 1)


def views(scenes: int, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> CameraTensors:
    """Cameras around the grid with skew, (scenes, count)."""
    generator = torch.Generator().manual_seed(seed)
    azimuth, elevation = (torch.rand(scenes, count, generator=generator, dtype=dtype) for _ in range(2))
    made = cameras.orbit(360.0 * azimuth, 40.0 * elevation - 10.0, 2.0, focal_length=50.0, height=24, width=32)
    intrinsics = made.intrinsics.clone()
    intrinsics[..., 0, 1] = 1.5
    intrinsics[..., 1, 1] = 60.0
    return CameraTensors(intrinsics, made.cam_from_world.clone(), made.height.clone(), made.width.clone())


def arguments(scenes: int, count: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Features (scenes, count, 2, 12, 16) and camera tensors."""
    features = torch.rand(scenes, count, 2, 12, 16, generator=torch.Generator().manual_seed(seed + 100))
    return (features, *views(scenes, count, seed))


def assert_same(actual: Any, expected: Any, tolerance: float = 1e-5) -> None:
    """Equal up to rounding, and not trivially: some sites seen, some not, values not 0."""
    for mine, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=tolerance, atol=tolerance)
    volume, visible, maps, swept = expected
    assert volume.abs().sum() > 0
    assert maps.abs().sum() > 0
    assert visible.any()
    assert swept.any()
    assert not swept.all()
