"""A drawing of cameras and scene content from above and from the side, with coordinates."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lsmgeo.diagnosis.findings import counted
from lsmgeo.diagnosis.two_view_geometry import homogeneous

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from lsmgeo.data import Voxels
    from lsmgeo.diagnosis.two_view_geometry import Geometry

__all__ = ["Content", "draw_cameras", "surface_of"]

# Largest angle, degrees, between up and an axis of the world for which the axes of the world are used.
LARGEST_TILT = 20.0
# Length of frusta relative to the nearest other camera and to the whole scene; of optical axes relative to frusta.
FRUSTUM, FRUSTUM_OF_ALL, SHORTEST, AXIS = 0.6, 0.12, 0.045, 1.8
# For a common point: the least spread of the optical axes, and their distance from it relative to its depth.
LEAST_SPREAD, NEAREST = 0.01, 0.2
# Numbers beside cameras: size and distances in points, and angles from the camera's back, degrees.
FONT_SIZE, DISTANCES, ANGLES = 7, (8, 13, 19), (0, 35, -35, 70, -70)
LIGHT = np.array([-0.4, 0.6, 0.7])  # right, up, towards the viewer


class Content(NamedTuple):
    """Scene content: points (N, 3), one colour or (N, 3); of voxels also their normals (N, 3) and size."""

    points: np.ndarray
    colours: np.ndarray | str = "0.45"
    normals: np.ndarray | None = None
    cell: float = 0.0


class _View(NamedTuple):
    """Axes of the drawing: rows right, up, towards the viewer; their origin, and the names of the first two."""

    system: np.ndarray
    origin: np.ndarray
    names: tuple[str, str]

    def project(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self.origin) @ self.system.T)


def surface_of(voxels: Voxels) -> Content:
    """The occupied voxels that have an empty neighbour, with outward normals."""
    from scipy.ndimage import binary_erosion

    T = voxels.world_from_lattice
    occupied = np.pad(voxels.occupancy.numpy().transpose(2, 1, 0).astype(np.float32), 1)
    outwards = -np.stack(list(np.gradient(occupied)), -1)
    index = np.argwhere((occupied > 0) & ~binary_erosion(occupied))
    normals = outwards[tuple(index.T)] @ np.linalg.inv(T[:3, :3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Content((index - 1) @ T[:3, :3].T + T[:3, 3], "0.45", normals, voxels.voxel_size)


def draw_cameras(figure: Figure, cameras: Geometry, content: Content, sizes: np.ndarray, colours: np.ndarray) -> None:
    """Draw cameras from above and from the side; sizes (V, 2) are height and width, colours (V, 3) of the cameras."""
    above, side, coordinates = _views(cameras)
    words = f"thick: the upper side of the image; dotted: the optical axis; {coordinates}"
    figure.supxlabel(words, fontsize=9)
    panels = list(zip(figure.subplots(1, 2), (above, side), ("from above", "from the side"), strict=True))
    length, common = _frustum_length(cameras.centers, content.points), _common_point(cameras)
    for axes, view, name in panels:
        axes.set_title(f"{counted(len(cameras.K), 'cameras')} {name}")
        places = _draw_frusta(axes, cameras, view, sizes, colours, length)
        shown = view.project(content.points)[:, :2]
        if len(shown):
            places = np.concatenate([places, np.percentile(shown, (0, 100) if content.cell else (2, 98), axis=0)])
        if common is not None:
            places = np.concatenate([places, view.project(common)[None, :2]])
        low, high = places.min(0), places.max(0)
        margin = 0.1 * float((high - low).max()) + 1e-12
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
        _name_axes(axes, view)
        _mark_points(axes, common, view)
    # Sizes of voxels and places of numbers are in points, so they need the final layout.
    figure.draw_without_rendering()
    for axes, view, _ in panels:
        _draw_content(axes, content, view)
        _number_cameras(axes, cameras, view)


def _views(cameras: Geometry) -> tuple[_View, _View, str]:
    up = _up(cameras)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) >= np.cos(np.radians(LARGEST_TILT)):
        up = np.sign(up[axis]) * np.eye(3)[axis]
        right, origin = np.eye(3)[1 if axis == 0 else 0], np.zeros(3)
        coordinates = "coordinates of the world"
    else:
        right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        right, origin = right / np.linalg.norm(right), cameras.centers.mean(0)
        coordinates = "rotated so that up is up; origin at the mean of the cameras; lengths of the world"
    back = np.cross(up, right)
    world = not origin.any() and bool(np.isin(np.abs(up), (0, 1)).all())

    def name(direction: np.ndarray, other: str) -> str:
        return f"{'xyz'[np.argmax(np.abs(direction))]} (world)" if world else other

    across, deep, high = name(right, "across"), name(back, "away"), name(up, "up")
    above = _View(np.stack([right, back, up]), origin, (across, deep))
    return above, _View(np.stack([right, up, -back]), origin, (across, high)), coordinates


def _up(cameras: Geometry) -> np.ndarray:
    """The normal of the ring of cameras around an object, or else the mean of their own up directions."""
    up = -cameras.R[:, 1].mean(0)
    if np.linalg.norm(up) < 0.2:
        up = -cameras.R[0, 1]
    centers = cameras.centers
    _, spread, axes = np.linalg.svd(centers - centers.mean(0), full_matrices=False)
    if len(centers) > 3 and spread[2] < 0.3 * spread[1] and spread[1] > 0.3 * spread[0]:
        up = axes[2] * (np.sign(axes[2] @ up) or 1.0)
    return np.asarray(up / np.linalg.norm(up))


def _name_axes(axes: Axes, view: _View) -> None:
    """Label the axes; numbers are those of the world even if its axis points left or down."""
    axes.set_xlabel(view.names[0], fontsize=8)
    axes.set_ylabel(view.names[1], fontsize=8)
    for axis, direction, name in zip((axes.xaxis, axes.yaxis), view.system[:2], view.names, strict=True):
        if name.endswith("(world)") and direction.sum() < 0:
            axis.set_major_formatter(lambda value, _: f"{0 - round(value, 12):g}".replace("-", "\N{MINUS SIGN}"))


def _draw_frusta(
    axes: Axes, cameras: Geometry, view: _View, sizes: np.ndarray, colours: np.ndarray, length: float
) -> np.ndarray:
    """Draw the frusta, and return all their points in the drawing, (N, 2)."""
    from matplotlib.collections import LineCollection

    placed = view.project(cameras.centers)
    places = [placed[:, :2]]
    for camera, colour in enumerate(colours):
        height, width = sizes[camera]
        pixels = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, height / 2]]) - 0.5
        rays = homogeneous(pixels) @ np.linalg.inv(cameras.K[camera]).T
        rays = rays / np.abs(rays[:4, :2]).max() * 0.5 if np.abs(rays[:4, :2]).max() > 0.5 else rays
        ends = ((rays * length) @ np.linalg.inv(cameras.R[camera]).T @ view.system.T)[:, :2]
        start = placed[camera, :2]
        corner, far = start + ends[:4], start + AXIS * ends[4]
        lines = [np.stack([start, end]) for end in corner] + [np.concatenate([corner, corner[:1]])]
        axes.add_collection(LineCollection(lines, colors=[colour], linewidths=0.9, alpha=0.8))
        axes.add_collection(LineCollection([[start, far]], colors=[colour], linewidths=0.7, linestyles="dotted"))
        axes.add_collection(LineCollection([corner[:2]], colors=[colour], linewidths=2.4))
        places += [corner, far[None]]
    return np.concatenate(places)


def _mark_points(axes: Axes, common: np.ndarray | None, view: _View) -> None:
    """Mark the origin of the world and the common point of the optical axes, if they are inside the drawing."""
    marks = [("+", 9, "origin of the world", np.zeros(3))]
    marks += [] if common is None else [("o", 4, "common point of the optical axes", common)]
    for sign, size, name, point in marks:
        x, y, _ = view.project(point)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        if left < x < right and low < y < high:
            axes.plot(x, y, sign, color="black", markersize=size, label=name, linestyle="none", zorder=5)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="best", framealpha=0.8)


def _common_point(cameras: Geometry) -> np.ndarray | None:
    """The point nearest to all optical axes, if it is close to them and in front of most cameras."""
    directions = np.linalg.inv(cameras.R)[:, :, 2]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < LEAST_SPREAD:
        return None
    point = np.linalg.solve(total, np.einsum("vij,vj->i", across, cameras.centers) / len(across))
    to = point - cameras.centers
    away = np.linalg.norm(np.einsum("vij,vj->vi", across, to), axis=1)
    along = (to * directions).sum(1)
    return np.asarray(point) if np.median(away) < NEAREST * np.median(along) else None


def _draw_content(axes: Axes, content: Content, view: _View) -> None:
    placed = view.project(content.points)
    order = np.argsort(placed[:, 2], kind="stable")
    if not len(order):
        return
    if content.normals is None:
        shown = content.colours if isinstance(content.colours, str) else content.colours[order]
        axes.scatter(placed[order, 0], placed[order, 1], c=shown, s=3, linewidths=0, zorder=0.5)
        return
    # Only the foremost of overlapping voxels is visible.
    bins = np.round(placed[:, :2] / (0.5 * content.cell)).astype(int)
    order = order[::-1][np.unique(bins[order[::-1]], axis=0, return_index=True)[1]]
    order = order[np.argsort(placed[order, 2], kind="stable")]
    near = (placed[order, 2] - placed[:, 2].min()) / max(float(np.ptp(placed[:, 2])), 1e-12)
    lit = np.maximum(content.normals[order] @ view.system.T @ (LIGHT / np.linalg.norm(LIGHT)), 0)
    grey = np.clip(0.3 + 0.35 * lit + 0.3 * near, 0, 1)
    side = _points_per_unit(axes) * content.cell * (1.1 if "(world)" in view.names[0] else 1.4)
    shades = grey[:, None] * np.array([0.92, 0.97, 1.0])
    axes.scatter(placed[order, 0], placed[order, 1], c=shades, s=side**2, marker="s", linewidths=0, zorder=0.5)


def _points_per_unit(axes: Axes) -> float:
    (left, _), (right, _) = axes.transData.transform([(0, 0), (1, 0)])
    return float((right - left) * 72 / axes.figure.dpi)


def _number_cameras(axes: Axes, cameras: Geometry, view: _View) -> None:
    """Write numbers behind the cameras; a number without a free place is left out."""
    from matplotlib.patheffects import withStroke

    placed = view.project(cameras.centers)[:, :2]
    points = placed * _points_per_unit(axes)
    back = -(np.linalg.inv(cameras.R)[:, :, 2] @ view.system.T)[:, :2]
    style: Any = {"textcoords": "offset points", "fontsize": FONT_SIZE, "ha": "center", "va": "center", "zorder": 6}
    style["path_effects"] = [withStroke(linewidth=2, foreground="white")]
    written: list[tuple[np.ndarray, float]] = []
    for camera, direction in enumerate(back):
        length = np.linalg.norm(direction)
        straight = direction / length if length > 0.05 else np.array([0.0, 1.0])
        width = 0.62 * FONT_SIZE * len(str(camera))
        for distance, angle in itertools.product(DISTANCES, ANGLES):
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            offset = distance * np.array([c * straight[0] - s * straight[1], s * straight[0] + c * straight[1]])
            place = points[camera] + offset
            apart = [np.abs(place - other) / [(width + wide) / 2 + 1, FONT_SIZE] for other, wide in written]
            if all(gap.max() > 1 for gap in apart):
                axes.annotate(str(camera), placed[camera], (float(offset[0]), float(offset[1])), **style)
                written.append((place, width))
                break


def _frustum_length(centers: np.ndarray, content: np.ndarray) -> float:
    """A length at which neighbours hardly overlap and all are visible."""
    everything = np.concatenate([centers, content])
    low, high = np.percentile(everything, (2, 98), axis=0)
    whole = float(np.linalg.norm(high - low))
    if len(centers) < 2:
        return max(FRUSTUM_OF_ALL * whole, 1e-9) if whole > 0 else 1.0
    near = float(np.median(np.sort(np.linalg.norm(centers[:, None] - centers, axis=2), axis=1)[:, 1]))
    return float(np.clip(FRUSTUM * near, SHORTEST * whole, FRUSTUM_OF_ALL * whole)) or 1.0
