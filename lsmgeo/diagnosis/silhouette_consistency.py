"""Silhouette consistency: voxels fill the silhouettes of their object, and epipolar tangents touch silhouettes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.two_view_geometry import Geometry, evenly, homogeneous, project

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages, Voxels

__all__ = [
    "Cells", "Masks", "draw_cells", "epipolar_tangency", "intersection_over_union", "load_masks", "near_cells",
    "occupied_cells", "silhouette_hull", "silhouette_overlap", "within_a_cell",
]  # fmt: skip

# With an epipole this close to the silhouette, relative to its size, the epipolar planes change too much per pixel.
LEAST_CLEARANCE = 1.3
# Most cells that are projected, and the longer side of the masks that they are compared with, px.
MAX_CELLS = 1 << 15
LONGEST_SIDE = 256
MARGIN = 2  # empty cells on each side
HALF_DIAGONAL = 0.75**0.5  # of a cube of side 1


class Cells(NamedTuple):
    """Occupied voxels: their centres (N, 3) in the world, and the side of a cell."""

    centers: np.ndarray
    side: float


class Masks(NamedTuple):
    """Masks (h, w) of some views, subsampled to every ``step``-th row and column."""

    views: tuple[int, ...]
    masks: tuple[np.ndarray, ...]
    steps: tuple[int, ...]


def occupied_cells(voxels: Voxels) -> Cells:
    """The occupied cells; an even selection of very many."""
    T = voxels.world_from_lattice
    index = np.argwhere(voxels.occupancy.numpy())[:, ::-1]
    index = index[evenly(len(index), MAX_CELLS)]
    centers = index @ T[:3, :3].T + T[:3, 3]
    return Cells(centers, voxels.voxel_size)


def load_masks(scene: PosedImages, views: np.ndarray) -> Masks:
    """Read the masks of some views.

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


def draw_cells(cells: Cells, geometry: Geometry, camera: int, shape: tuple[int, int], step: int) -> np.ndarray:
    """The projection of the cells, (h, w) bool: each one a square of about its size."""
    import cv2

    drawn = np.zeros(shape, np.uint8)
    columns, rows, side = _project_cells(cells, geometry, camera, shape, step)
    drawn[rows, columns] = 1
    return np.asarray(cv2.dilate(drawn, np.ones((side, side), np.uint8)), bool)


def intersection_over_union(drawn: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of two silhouettes."""
    return float((drawn & mask).sum() / max(1, (drawn | mask).sum()))


def _project_cells(
    cells: Cells, geometry: Geometry, camera: int, shape: tuple[int, ...], step: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Columns and rows of the cells that project into the image, and the side of a cell in pixels."""
    height, width = shape
    pixels, depth = project(geometry, camera, cells.centers)
    with np.errstate(invalid="ignore"):
        places = np.round(pixels / step)
        inside = (places >= 0).all(1) & (places < [width, height]).all(1) & (depth > 0)
    columns, rows = places[inside].astype(int).T
    if not inside.any():
        return columns, rows, 1
    focal = np.sqrt(abs(geometry.K[camera, 0, 0] * geometry.K[camera, 1, 1])) / step
    side = int(np.clip(np.ceil(focal * cells.side / np.median(depth[inside])), 1, max(shape)))
    return columns, rows, side


def silhouette_overlap(masks: Masks, cells: Cells, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """For each view the fraction of cells that overlap its silhouette, and the intersection over union of both.

    Convention:
        A cell extends to its corners: voxels that the surface only touches are occupied too.
    """
    import cv2

    recalls, unions = [], []
    for view, mask, step in zip(*masks, strict=True):
        columns, rows, side = _project_cells(cells, geometry, view, mask.shape, step)
        reach = 2 * int(np.ceil(HALF_DIAGONAL * side)) + 1
        wide = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8))
        recalls.append((wide[rows, columns] > 0).sum() / len(cells.centers))
        unions.append(intersection_over_union(draw_cells(cells, geometry, view, mask.shape, step), mask))
    return np.array(recalls), np.array(unions)


def near_cells(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    """Occupied cells and their neighbours, with a margin of two cells on each side; and world_from_lattice."""
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


def silhouette_hull(mask: np.ndarray) -> np.ndarray | None:
    """The convex hull (N, 2) float64 x, y of the pixel centres of a silhouette (H, W).

    None if the mask is empty or touches the image border.
    """
    import cv2

    rows, columns = np.nonzero(mask)
    if len(rows) == 0 or mask[[0, -1]].any() or mask[:, [0, -1]].any():
        return None
    # Pixel centres are half a pixel inside the silhouette, in both views: tangent planes do not change.
    return cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32))[:, 0].astype(np.float64)


def epipolar_tangency(first: np.ndarray, second: np.ndarray, cameras: Geometry) -> np.ndarray:
    """Distances between the epipolar tangents of two silhouettes.

    An epipolar plane that touches the object does so in both views: its epipolar lines are tangent to both
    silhouettes. (Cipolla, Astrom, Giblin, "Motion from the frontier of curved surfaces", ICCV 1995; Wong and Cipolla,
    "Structure and motion from silhouettes", ICCV 2001.)

    Args:
        first: (N, 2) silhouette in the first view, pixels.
        second: (M, 2) silhouette in the second view.
        cameras: of the two views.

    Returns:
        (2,) distances in pixels, the mean over the two views; NaN where an epipole lies in or near a silhouette.
    """
    nowhere = np.full(2, np.nan)
    K, backward, centers = cameras.K, np.linalg.inv(cameras.R), cameras.centers
    baseline = centers[1] - centers[0]
    length = np.linalg.norm(baseline)
    if not length > 1e-9 * max(1.0, float(np.linalg.norm(centers, axis=1).max())):
        return nowhere
    axis = baseline / length
    across = []  # the part of the rays that is perpendicular to the baseline
    for points, matrix, rotation in zip((first, second), K, backward, strict=True):
        ray = homogeneous(points) @ np.linalg.inv(matrix).T @ rotation.T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across.append(ray - (ray @ axis)[:, None] * axis)
    middle = across[0].mean(0) / np.linalg.norm(across[0].mean(0))
    side = np.cross(axis, middle)
    ends, widths = [], []
    for part, matrix in zip(across, K, strict=True):
        angles = np.arctan2(part @ side, part @ middle)
        # Where the baseline passes through or close to the object, the half-planes extend all around.
        phasor = np.exp(1j * angles)
        centre = np.angle(phasor.mean())
        around = np.angle(phasor * np.exp(-1j * centre))
        if around.max() - around.min() > np.pi / LEAST_CLEARANCE:
            return nowhere
        low, high = around.argmin(), around.argmax()
        ends.append(centre + around[[low, high]])
        focal = np.sqrt(abs(matrix[0, 0] * matrix[1, 1]))
        # Pixels per angle about the baseline: the closer to the epipole, the fewer.
        widths.append(focal * np.linalg.norm(part[[low, high]], axis=1))
    difference = np.abs(np.angle(np.exp(1j * (ends[0] - ends[1]))))
    return np.asarray(difference * (widths[0] + widths[1]) / 2)
