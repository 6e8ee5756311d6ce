"""Cut-out photographs under cameras: whether the solid projects into its outlines and fills them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.geometry import Geometry, project

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages, Voxels

__all__ = [
    "Silhouettes",
    "Solid",
    "draw_solid",
    "load_silhouettes",
    "near_cells",
    "occupied_centers",
    "overlap",
    "within_a_cell",
]

# Cells that are projected, at most; and pixels of the longer side of a mask that they are compared with.
MAX_CELLS = 1 << 15
LONGEST_SIDE = 256
MARGIN = 2  # empty cells on each side
HALF_DIAGONAL = 0.75**0.5  # of a cube of side 1


class Solid(NamedTuple):
    """Occupied cells: their centres (N, 3) in the world, and the length of a cell's side."""

    centers: np.ndarray
    cell: float


class Silhouettes(NamedTuple):
    """Masks (h, w) of some views, thinned to every ``step``-th row and column."""

    views: tuple[int, ...]
    masks: tuple[np.ndarray, ...]
    steps: tuple[int, ...]


def occupied_centers(voxels: Voxels) -> Solid:
    """The occupied cells; of very many, evenly chosen ones."""
    T = voxels.grid.world_from_lattice.double().reshape(-1, 4, 4)[0].numpy()
    index = np.argwhere(voxels.occupancy.numpy())[:, ::-1]
    if len(index) > MAX_CELLS:
        index = index[np.linspace(0, len(index) - 1, MAX_CELLS).astype(int)]
    centers = index @ T[:3, :3].T + T[:3, 3]
    return Solid(centers, float(np.cbrt(abs(np.linalg.det(T[:3, :3])))))


def load_silhouettes(scene: PosedImages, views: np.ndarray) -> Silhouettes:
    """Read the outlines of some views.

    Raises:
        DataError: a file is missing, damaged or not of its camera's size.
    """
    masks, steps = [], []
    for view in views.tolist():
        mask = scene.load_mask(view)
        assert mask is not None
        step = int(np.ceil(max(mask.shape) / LONGEST_SIDE))
        masks.append(mask.numpy()[::step, ::step].copy())
        steps.append(step)
    return Silhouettes(tuple(int(view) for view in views), tuple(masks), tuple(steps))


def draw_solid(solid: Solid, geometry: Geometry, camera: int, shape: tuple[int, int], step: int) -> np.ndarray:
    """Where a camera sees the cells, (h, w) bool: each one as a square of about its size."""
    import cv2

    drawn = np.zeros(shape, np.uint8)
    _, columns, rows, side = _placed(solid, geometry, camera, shape, step)
    drawn[rows, columns] = 1
    return np.asarray(cv2.dilate(drawn, np.ones((side, side), np.uint8)), bool)


def _placed(
    solid: Solid, geometry: Geometry, camera: int, shape: tuple[int, ...], step: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Which cells fall into a picture, the columns and rows of those that do, and a cell's side in its pixels."""
    height, width = shape
    pixels, depth = project(geometry, camera, solid.centers)
    with np.errstate(invalid="ignore"):
        places = np.round(pixels / step)
        inside = (places >= 0).all(1) & (places < [width, height]).all(1) & (depth > 0)
    columns, rows = places[inside].astype(int).T
    if not inside.any():
        return inside, columns, rows, 1
    focal = np.sqrt(abs(geometry.K[camera, 0, 0] * geometry.K[camera, 1, 1])) / step
    side = int(np.clip(np.ceil(focal * solid.cell / np.median(depth[inside])), 1, max(shape)))
    return inside, columns, rows, side


def overlap(silhouettes: Silhouettes, solid: Solid, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """For each view the fraction of cells that reach into its outline, and intersection over union with the solid.

    Convention:
        A cell reaches as far as its corners: cells that the surface only grazes count as occupied.
    """
    import cv2

    recalls, unions = [], []
    for view, mask, step in zip(*silhouettes, strict=True):
        inside, columns, rows, side = _placed(solid, geometry, view, mask.shape, step)
        reach = 2 * int(np.ceil(HALF_DIAGONAL * side)) + 1
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8))
        recalls.append(float((wide[rows, columns] > 0).sum() / len(inside)))
        drawn = draw_solid(solid, geometry, view, mask.shape, step)
        unions.append(float((drawn & mask).sum() / max(1, (drawn | mask).sum())))
    return np.array(recalls), np.array(unions)


def near_cells(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    """Cells that are occupied or touch one that is, two more on each side than there are; and world_from_lattice."""
    T = voxels.grid.world_from_lattice.double().reshape(-1, 4, 4)[0].numpy()
    near = np.pad(voxels.occupancy.numpy(), MARGIN)
    for axis in range(3):
        near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
    return near, T


def within_a_cell(points: np.ndarray, near: np.ndarray, world_from_lattice: np.ndarray) -> float:
    """The fraction of points (N, 3) whose cell, or one of its 26 neighbours, is occupied; see `near_cells`."""
    T = world_from_lattice
    index = np.round((points - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T)[:, ::-1] + MARGIN
    inside = (index >= 0).all(1) & (index < np.array(near.shape)).all(1)
    places = np.where(inside[:, None], index, 0).astype(int)
    return float(np.mean(inside & near[tuple(places.T)]))
