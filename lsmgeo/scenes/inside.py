"""Which points lie inside a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lsmgeo._checks import check_geometry
from lsmgeo.errors import ShapeError
from lsmgeo.grids import VoxelGrid
from lsmgeo.scenes.tables import Placed, Scene, Tables, check_scenes, layout

__all__ = ["occupancy", "voxels"]

# Points of one scene that are tested together: their local coordinates fit into the caches.
POINTS_AT_ONCE = 1 << 15
# Boxes around solids are widened by this, for rounding.
MARGIN = 1e-9


@torch.no_grad()
def occupancy(scenes: Sequence[Scene], points: Tensor) -> Tensor:
    """Whether points lie inside scenes: in a solid and in none of its cuts.

    Convention:
        A primitive contains its surface, also when it is subtracted. Arithmetic is float64.

    Args:
        scenes: S scenes.
        points: (S, ..., 3) world; or (..., 3), the same for all scenes, where the first axis is 1 or S is 1.

    Returns:
        (S, ...) bool.

    Raises:
        OptionError: not a sequence of `Scene`.
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


def voxels(scenes: Sequence[Scene], grid: VoxelGrid | int | tuple[int, int, int] = 32) -> Tensor:
    """Whether the centres of a grid's voxels lie inside scenes.

    Args:
        scenes: S scenes.
        grid: a `lsmgeo.VoxelGrid` without a batch, or n or (D, H, W) voxels over [-0.5, 0.5]^3.

    Returns:
        (S, D, H, W) bool.

    Raises:
        OptionError: not a sequence of `Scene`.
        ShapeError: a grid with one pose per scene.

    Example:
        >>> from lsmgeo import scenes
        >>> scenes.voxels([scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])], 4).sum()
        tensor(32)
    """
    scenes = check_scenes("voxels", scenes)
    grid = grid if isinstance(grid, VoxelGrid) else VoxelGrid(grid)
    if grid.world_from_grid is not None:
        centers = grid.centers()
        if centers.dim() != 4:
            raise ShapeError(f"voxels: grid must be one for all scenes; got centres {tuple(centers.shape)}")
        return occupancy(scenes, centers[None])
    depth, height, width = grid.shape  # type: ignore[misc]
    matrix, counts = grid.world_from_lattice, (width, height, depth)
    axes = [matrix[i, i] * torch.arange(count, dtype=torch.float64) + matrix[i, 3] for i, count in enumerate(counts)]
    return torch.stack([_occupied_lattice(scene, axes) for scene in scenes])


def _occupied(scene: Scene, points: Tensor) -> Tensor:
    """Whether points (N, 3) lie in a scene."""
    tables, (placed,) = layout([scene])
    tables = tables.to(points.device, torch.float64)
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for first in range(0, len(points), POINTS_AT_ONCE):
        block = points[first : first + POINTS_AT_ONCE].T.double()  # (3, K)

        def local(row: int, block: Tensor = block) -> Tensor:
            offset = block - tables.center[row, :, None]
            return (tables.linear[row, :, :, None] * offset).sum(1)

        for solid in placed:
            inside[first : first + POINTS_AT_ONCE] |= _inside_solid(tables, solid, local)
    return inside


def _occupied_lattice(scene: Scene, axes: list[Tensor]) -> Tensor:
    """Occupancy (D, H, W) of a lattice along the world's axes, (W,), (H,) and (D,).

    A solid is tested within its bounding box; local coordinates are a sum of one term per axis.
    """
    tables, (placed,) = layout([scene])
    inside = torch.zeros([len(axis) for axis in reversed(axes)], dtype=torch.bool)
    for solid, part in zip(placed, scene.solids, strict=True):
        x, y, z = (
            slice(int((axis < lower - MARGIN).sum()), int((axis <= upper + MARGIN).sum()))
            for axis, lower, upper in zip(axes, *part.bounds(), strict=True)
        )
        some = [axis[window] for axis, window in zip(axes, (x, y, z), strict=True)]

        def local(row: int, some: list[Tensor] = some) -> Tensor:
            along = [
                tables.linear[row, :, axis, None] * (values - tables.center[row, axis])  # (3, W), (3, H), (3, D)
                for axis, values in enumerate(some)
            ]
            return along[0][:, None, None, :] + along[1][:, None, :, None] + along[2][:, :, None, None]

        inside[z, y, x] |= _inside_solid(tables, solid, local)
    return inside


def _inside_solid(tables: Tables, solid: Placed, local: Callable[[int], Tensor]) -> Tensor:
    """Whether points lie in a solid and in none of its cuts; ``local`` gives their coordinates (3, ...) for a row."""
    inside = _contains(tables, solid.row, local(solid.row))
    for _, cut in solid.cuts:
        inside &= ~_contains(tables, cut, local(cut))
    return inside


def _contains(tables: Tables, row: int, local: Tensor) -> Tensor:
    """Whether local points (3, ...) lie in a primitive, by the functions whose zeros are its faces (see `Tables`)."""
    shape = (3,) + (1,) * (local.dim() - 1)
    within = ((local <= tables.high[row].view(shape)) & (local >= tables.low[row].view(shape))).all(0)
    if bool(tables.round[row].any()):
        radial = (tables.round[row].view(shape) * local.square()).sum(0)
        radius = tables.radius[row] + tables.slope[row] * local[1]
        within &= radial <= radius.square()
    return within
