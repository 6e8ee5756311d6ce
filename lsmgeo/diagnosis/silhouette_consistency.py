"""Cut-out photographs under cameras: whether a solid fills its outlines, and whether these can be of one object."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.two_view_geometry import Geometry, evenly, homogeneous, project

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages, Voxels

__all__ = [
    "Cells", "Masks", "draw_cells", "epipolar_tangency", "intersection_over_union", "load_masks", "near_cells",
    "occupied_cells", "outline", "overlap", "within_a_cell",
]  # fmt: skip

# An epipole so near to the outline, seen from the outline's middle, makes planes through the baseline that turn a lot
# from pixel to pixel.
LEAST_CLEARANCE = 1.3
# Cells that are projected, at most; and pixels of the longer side of a mask that they are compared with.
MAX_CELLS = 1 << 15
LONGEST_SIDE = 256
MARGIN = 2  # empty cells on each side
HALF_DIAGONAL = 0.75**0.5  # of a cube of side 1


class Cells(NamedTuple):
    """Occupied cells: their centres (N, 3) in the world, and the length of a cell's side."""

    centers: np.ndarray
    cell: float


class Masks(NamedTuple):
    """Masks (h, w) of some views, thinned to every ``step``-th row and column."""

    views: tuple[int, ...]
    masks: tuple[np.ndarray, ...]
    steps: tuple[int, ...]


def occupied_cells(voxels: Voxels) -> Cells:
    """The occupied cells; of very many, evenly chosen ones."""
    T = voxels.world_from_lattice
    index = np.argwhere(voxels.occupancy.numpy())[:, ::-1]
    index = index[evenly(len(index), MAX_CELLS)]
    centers = index @ T[:3, :3].T + T[:3, 3]
    return Cells(centers, voxels.voxel_size)


def load_masks(scene: PosedImages, views: np.ndarray) -> Masks:
    """Read the outlines of some views.

    Raises:
        DataError: a file is missing, damaged or not of its camera's size.
    """
    masks, steps = [], []
    for view in views.tolist():
        mask = scene.load_mask(view)
        assert mask is not None
        steps.append(int(np.ceil(max(mask.shape) / LONGEST_SIDE)))
        masks.append(mask.numpy()[:: steps[-1], :: steps[-1]].copy())
    return Masks(tuple(views.tolist()), tuple(masks), tuple(steps))


def draw_cells(solid: Cells, geometry: Geometry, camera: int, shape: tuple[int, int], step: int) -> np.ndarray:
    """Where a camera sees the cells, (h, w) bool: each one as a square of about its size."""
    import cv2

    drawn = np.zeros(shape, np.uint8)
    columns, rows, side = _placed(solid, geometry, camera, shape, step)
    drawn[rows, columns] = 1
    return np.asarray(cv2.dilate(drawn, np.ones((side, side), np.uint8)), bool)


def intersection_over_union(drawn: np.ndarray, mask: np.ndarray) -> float:
    """How much of two silhouettes is in both."""
    return float((drawn & mask).sum() / max(1, (drawn | mask).sum()))


def _placed(
    solid: Cells, geometry: Geometry, camera: int, shape: tuple[int, ...], step: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """The columns and rows of the cells that fall into a picture, and a cell's side in its pixels."""
    height, width = shape
    pixels, depth = project(geometry, camera, solid.centers)
    with np.errstate(invalid="ignore"):
        places = np.round(pixels / step)
        inside = (places >= 0).all(1) & (places < [width, height]).all(1) & (depth > 0)
    columns, rows = places[inside].astype(int).T
    if not inside.any():
        return columns, rows, 1
    focal = np.sqrt(abs(geometry.K[camera, 0, 0] * geometry.K[camera, 1, 1])) / step
    side = int(np.clip(np.ceil(focal * solid.cell / np.median(depth[inside])), 1, max(shape)))
    return columns, rows, side


def overlap(silhouettes: Masks, solid: Cells, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """For each view the fraction of cells that reach into its outline, and intersection over union with the solid.

    Convention:
        A cell reaches as far as its corners: cells that the surface only grazes count as occupied.
    """
    import cv2

    recalls, unions = [], []
    for view, mask, step in zip(*silhouettes, strict=True):
        columns, rows, side = _placed(solid, geometry, view, mask.shape, step)
        reach = 2 * int(np.ceil(HALF_DIAGONAL * side)) + 1
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8))
        recalls.append((wide[rows, columns] > 0).sum() / len(solid.centers))
        unions.append(intersection_over_union(draw_cells(solid, geometry, view, mask.shape, step), mask))
    return np.array(recalls), np.array(unions)


def near_cells(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    """Cells that are occupied or touch one that is, two more on each side than there are; and world_from_lattice."""
    from scipy.ndimage import binary_dilation

    near = binary_dilation(np.pad(voxels.occupancy.numpy(), MARGIN), np.ones((3, 3, 3), bool))
    return near, voxels.world_from_lattice


def within_a_cell(points: np.ndarray, near: np.ndarray, world_from_lattice: np.ndarray) -> float:
    """The fraction of points (N, 3) whose cell, or one of its 26 neighbours, is occupied; see `near_cells`."""
    T = world_from_lattice
    index = np.round((points - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T)[:, ::-1] + MARGIN
    inside = (index >= 0).all(1) & (index < np.array(near.shape)).all(1)
    places = np.where(inside[:, None], index, 0).astype(int)
    return float(np.mean(inside & near[tuple(places.T)]))


def outline(mask: np.ndarray) -> np.ndarray | None:
    """The convex hull of the centres of an object's pixels.

    Args:
        mask: (H, W) bool, True on the object.

    Returns:
        (N, 2) float64 x, y; None where nothing is there or the object leaves the picture, so that its outline is not
        all seen.
    """
    import cv2

    rows, columns = np.nonzero(mask)
    if len(rows) == 0 or mask[[0, -1]].any() or mask[:, [0, -1]].any():
        return None
    # Through pixels' centres: the half pixel up to the border is there in both views, and moves no plane.
    return cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32))[:, 0].astype(np.float64)


def epipolar_tangency(first: np.ndarray, second: np.ndarray, cameras: Geometry) -> np.ndarray:
    """How far the two planes through the baseline that touch the object in one view are from touching it in the other.

    A plane through both camera centres that touches the object does so in both views: its two lines are tangents of the
    outlines. (Cipolla, Astrom, Giblin, "Motion from the frontier of curved surfaces", ICCV 1995; Wong and Cipolla,
    "Structure and motion from silhouettes", ICCV 2001.)

    Args:
        first: (N, 2) outline in the first view, pixels.
        second: (M, 2) outline in the second.
        cameras: of the two views.

    Returns:
        (2,) distances in pixels, the mean over the two views; NaN where an epipole lies in or near an outline.
    """
    nowhere = np.full(2, np.nan)
    K, backward, centers = cameras.K, np.linalg.inv(cameras.R), cameras.centers
    baseline = centers[1] - centers[0]
    length = np.linalg.norm(baseline)
    if not length > 1e-9 * max(1.0, float(np.linalg.norm(centers, axis=1).max())):
        return nowhere
    axis = baseline / length
    across = []  # the part of the rays that tells the half-plane
    for points, matrix, turn in zip((first, second), K, backward, strict=True):
        ray = homogeneous(points) @ np.linalg.inv(matrix).T @ turn.T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across.append(ray - (ray @ axis)[:, None] * axis)
    middle = across[0].mean(0) / np.linalg.norm(across[0].mean(0))
    side = np.cross(axis, middle)
    ends, widths = [], []
    for part, matrix in zip(across, K, strict=True):
        angles = np.arctan2(part @ side, part @ middle)
        # Where the baseline pierces the object, or passes it closely, half-planes go all around.
        turned = np.exp(1j * angles)
        centre = np.angle(turned.mean())
        around = np.angle(turned * np.exp(-1j * centre))
        if around.max() - around.min() > np.pi / LEAST_CLEARANCE:
            return nowhere
        low, high = around.argmin(), around.argmax()
        ends.append(centre + around[[low, high]])
        focal = np.sqrt(abs(matrix[0, 0] * matrix[1, 1]))
        # What an angle about the baseline is in pixels: the nearer to the epipole, the less.
        widths.append(focal * np.linalg.norm(part[[low, high]], axis=1))
    difference = np.abs(np.angle(np.exp(1j * (ends[0] - ends[1]))))
    return np.asarray(difference * (widths[0] + widths[1]) / 2)
