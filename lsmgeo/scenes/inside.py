"""Which points lie inside a scene."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo._checks import check_geometry
from lsmgeo.errors import ShapeError
from lsmgeo.grids import VoxelGrid
from lsmgeo.scenes.tables import Scene, Tables, check_scenes, layout

__all__ = ["occupancy", "voxels"]

# Points of one scene that are tested together: their local coordinates fit the caches.
POINTS_AT_ONCE = 1 << 15


def occupancy(scenes: Sequence[Scene], points: Tensor) -> Tensor:
    """Whether points lie inside scenes: in a solid and in none of its cuts.

    Convention:
        A solid contains its surface, and so does what is cut out of it. Arithmetic is float64.

    Args:
        scenes: S scenes.
        points: (S, ..., 3) world; or (..., 3), the same for all scenes, where the first axis is 1 or S is 1.

    Returns:
        (S, ...) bool.

    Raises:
        OptionError: something else than `Scene`.
        ShapeError: points that are not (S, ..., 3).

    Example:
        >>> import torch
        >>> from lsmgeo import scenes
        >>> ball = scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])
        >>> scenes.occupancy([ball], torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.4, 0.4]]]))
        tensor([[ True, False]])
    """
    who = "occupancy"
    scenes = check_scenes(who, scenes)
    check_geometry(who, "points", points, "(S, ..., 3)")
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[0] not in (1, len(scenes)):
        raise ShapeError(f"{who}: points must be (S, ..., 3) with S = {len(scenes)} scenes; got {tuple(points.shape)}")
    points = points.expand(len(scenes), *points.shape[1:])
    inside = [_occupied(scene, at.reshape(-1, 3)) for scene, at in zip(scenes, points, strict=True)]
    return torch.stack(inside).view(points.shape[:-1])


def voxels(scenes: Sequence[Scene], grid: VoxelGrid | int = 32) -> Tensor:
    """Whether the centres of a grid's voxels lie inside scenes.

    Args:
        scenes: S scenes.
        grid: a `lsmgeo.VoxelGrid` without a batch, or n for n^3 voxels over [-0.5, 0.5]^3.

    Returns:
        (S, D, H, W) bool.

    Raises:
        OptionError: something else than `Scene`.
        ShapeError: a grid with one pose a scene.

    Example:
        >>> from lsmgeo import scenes
        >>> scenes.voxels([scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])], 4).sum()
        tensor(32)
    """
    grid = VoxelGrid(grid) if isinstance(grid, int) else grid
    centers = grid.centers()
    if centers.dim() != 4:
        raise ShapeError(f"voxels: grid must be one for all scenes; got centres {tuple(centers.shape)}")
    return occupancy(scenes, centers[None])


def _occupied(scene: Scene, points: Tensor) -> Tensor:
    solids, (placed,) = layout([scene])
    solids = solids.to(points.device, torch.float64)
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for first in range(0, len(points), POINTS_AT_ONCE):
        block = points[first : first + POINTS_AT_ONCE].T.double().contiguous()  # (3, K)
        for solid in placed:
            held = _holds(solids, solid.row, block)
            for _, cut in solid.cuts:
                held &= ~_holds(solids, cut, block)
            inside[first : first + POINTS_AT_ONCE] |= held
    return inside


def _holds(solids: Tables, row: int, points: Tensor) -> Tensor:
    """Whether points (3, K) lie in one solid, by the functions whose zeros are its faces (see `Tables`)."""
    linear = solids.linear[row]
    offset = points - solids.center[row, :, None]
    local = (solids.linear[row, :, :, None] * offset).sum(1)
    within = ((local <= solids.high[row, :, None]) & (local >= solids.low[row, :, None])).all(0)
    if bool(solids.round[row].any()):
        radial = (solids.round[row, :, None] * local.square()).sum(0)
        radius = solids.radius[row] + solids.slope[row] * local[1]
        within &= radial <= radius.square()
    return within
