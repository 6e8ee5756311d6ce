"""Depth consistency: the depth of one view is reprojected into others, or warps one image of a pair to the other."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.two_view_geometry import Hypothesis, evenly, homogeneous, project

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages

__all__ = [
    "Surfaces", "best_neighbour_errors", "load_surfaces", "relative_errors", "surface_points", "thinned", "warp_errors",
    "warp_view",
]  # fmt: skip

# Pixels of a view that are reprojected into others, and pixels of a map that are kept.
SAMPLES = 3000
MAX_MAP = 1 << 20
# The neighbours considered: those that see at least this share of what the best one sees. Among them the one with the
# smallest error counts, because around an object a surface projects into every view but is hidden in half of them.
LEAST_OF_BEST = 0.7
LEAST_OVERLAP = 0.02


class Surfaces(NamedTuple):
    """Depth of V views, subsampled to every ``step``-th row and column."""

    maps: tuple[np.ndarray | None, ...]  # each view's (h, w) float64 depth, None for a view without
    steps: tuple[int, ...]  # the distance between kept rows and columns
    pixels: tuple[np.ndarray, ...]  # each view's (N, 2) x, y of the pixels that are reprojected
    depths: tuple[np.ndarray, ...]  # (N,), their depth

    @property
    def views(self) -> list[int]:
        """The views whose pixels are reprojected."""
        return [view for view, values in enumerate(self.depths) if len(values)]

    @property
    def targets(self) -> list[int]:
        """The views into which they are reprojected."""
        return [view for view, values in enumerate(self.maps) if values is not None]


def load_surfaces(scene: PosedImages, views: np.ndarray) -> Surfaces:
    """Read the depth of some views.

    Raises:
        DataError: a file is missing, damaged or not of its camera's size.
    """
    maps: list[np.ndarray | None] = [None] * len(scene)
    steps, pixels, depths = [1] * len(scene), [np.zeros((0, 2))] * len(scene), [np.zeros(0)] * len(scene)
    for view in views.tolist():
        loaded = scene.load_depth(view)
        if loaded is None:
            continue
        depth = loaded.numpy().astype(np.float64)
        rows, columns = np.nonzero(depth > 0)
        chosen = evenly(len(rows), SAMPLES)
        rows, columns = rows[chosen], columns[chosen]
        pixels[view] = np.stack([columns, rows], 1).astype(np.float64)
        depths[view] = depth[rows, columns]
        steps[view] = int(np.ceil(np.sqrt(depth.size / MAX_MAP)))
        maps[view] = depth[:: steps[view], :: steps[view]].copy()
    return Surfaces(tuple(maps), tuple(steps), tuple(pixels), tuple(depths))


def thinned(surfaces: Surfaces, most: int, most_views: int) -> Surfaces:
    """The same with fewer reprojected pixels: at most ``most`` of each of ``most_views`` views, evenly chosen."""
    kept = {surfaces.views[index] for index in evenly(len(surfaces.views), most_views)}
    rows = [evenly(len(depth), most if view in kept else 0) for view, depth in enumerate(surfaces.depths)]
    pixels, depths = (
        tuple(values[chosen] for values, chosen in zip(each, rows, strict=True))
        for each in (surfaces.pixels, surfaces.depths)
    )
    return surfaces._replace(pixels=pixels, depths=depths)


def surface_points(surfaces: Surfaces, hypothesis: Hypothesis, view: int) -> np.ndarray:
    """World points of a view's chosen pixels, (N, 3)."""
    K, R, t = (value[view] for value in hypothesis.depth_cameras)
    pixels = surfaces.pixels[view]
    rays = homogeneous(pixels) @ np.linalg.inv(K).T
    z = surfaces.depths[view] * hypothesis.depth_scale
    if hypothesis.along_ray:
        z = z / np.linalg.norm(rays, axis=1)
    return np.asarray((rays * z[:, None] - t) @ np.linalg.inv(R).T)


def _compare_depth(
    surfaces: Surfaces, hypothesis: Hypothesis, points: np.ndarray, view: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (N,) of points in a view and the measured depth there, NaN without one."""
    measured, step = surfaces.maps[view], surfaces.steps[view]
    assert measured is not None
    pixels, depth = project(hypothesis.depth_cameras, view, points)
    if hypothesis.along_ray:
        camera = points @ hypothesis.depth_cameras.R[view].T + hypothesis.depth_cameras.t[view]
        depth = np.sign(depth) * np.linalg.norm(camera, axis=1)
    with np.errstate(invalid="ignore"):
        places = np.round(pixels / step)
        height, width = measured.shape
        inside = (places >= 0).all(1) & (places[:, 0] < width) & (places[:, 1] < height) & (depth > 0)
    columns, rows = np.where(inside[:, None], places, 0).astype(int).T
    there = measured[rows, columns] * hypothesis.depth_scale
    return depth, np.where(inside & (there > 0), there, np.nan)


def relative_errors(surfaces: Surfaces, hypothesis: Hypothesis) -> np.ndarray:
    """Signed relative differences between reprojected and measured depth, (M,), see `best_neighbour_errors`.

    Occluded pixels give large differences; the median tolerates them.
    """
    return np.concatenate(
        [np.zeros(0), *(errors for _, _, errors in best_neighbour_errors(surfaces, hypothesis).values())]
    )


def best_neighbour_errors(surfaces: Surfaces, hypothesis: Hypothesis) -> dict[int, tuple[int, np.ndarray, np.ndarray]]:
    """For each view the best neighbour, which pixels have depth there (N,) bool, and their relative errors.

    Neighbours are chosen for each hypothesis anew: wrong cameras may place views anywhere.
    """
    best = {}
    for view in surfaces.views:
        points = surface_points(surfaces, hypothesis, view)
        found = []
        for other in surfaces.targets:
            if other != view:
                depth, there = _compare_depth(surfaces, hypothesis, points, other)
                known = np.isfinite(there)
                if known.mean() >= LEAST_OVERLAP:
                    found.append((other, known, (depth[known] - there[known]) / there[known]))
        if found:
            most = max(len(errors) for _, _, errors in found)
            near = [row for row in found if len(row[2]) >= LEAST_OF_BEST * most]
            best[view] = min(near, key=lambda row: float(np.median(np.abs(row[2]))))
    return best


def warp_errors(
    surfaces: Surfaces, hypothesis: Hypothesis, images: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Differences in grey levels between each of two images (H, W) and the other one, warped by depth and not warped.

    Returns:
        (M,) and (M,) absolute differences at the pixels that project into the other image.
    """
    each = [warp_view(surfaces, hypothesis, images, view)[1:] for view in surfaces.views]
    moved, unmoved = (np.concatenate([np.zeros(0), *parts]) for parts in zip(*each, strict=True))
    return moved, unmoved


def warp_view(
    surfaces: Surfaces, hypothesis: Hypothesis, images: tuple[np.ndarray, ...], view: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one of two views the pixels (M, 2) that project into the other image, and differences as in `warp_errors`."""
    import cv2

    other = 1 - view
    points = surface_points(surfaces, hypothesis, view)
    pixels, depth = project(hypothesis.cameras, other, points)
    height, width = images[other].shape
    own = surfaces.pixels[view]
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(1) & (pixels <= [width - 1, height - 1]).all(1) & (depth > 0)
    inside &= (own <= [width - 1, height - 1]).all(1)
    if not inside.any():
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    own = own[inside]
    here = images[view][own[:, 1].astype(int), own[:, 0].astype(int)].astype(np.float64)
    differences = []
    for places in (pixels[inside], own):
        maps = places.astype(np.float32)[:, None]
        there = cv2.remap(images[other].astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
        differences.append(np.abs(there[:, 0] - here))
    return own, differences[0], differences[1]
