"""A drawing of cameras and of what they saw, from above and from the side, in coordinates that can be read off."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.findings import counted
from lsmgeo.diagnosis.two_view_geometry import homogeneous

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from lsmgeo.data import Voxels
    from lsmgeo.diagnosis.two_view_geometry import Geometry

__all__ = ["Content", "draw_cameras", "surface_of"]

# Up may be so far from an axis of the world, in degrees, for the world's own axes to be drawn.
LARGEST_TILT = 20.0
# Frusta are this long, as a part of the way to the nearest other camera and of the whole; optical axes of them.
FRUSTUM, FRUSTUM_OF_ALL, SHORTEST, AXIS = 0.6, 0.12, 0.045, 1.8
# Where optical axes meet: how different they must be, and how near to a point, as a part of the way there.
LEAST_TURNED, NEAREST = 0.01, 0.2
# Of numbers beside cameras, in points: their size, and places that are tried, as distances and turns from the back.
LETTERS, DISTANCES, TURNS = 7, (8, 13, 19), (0, 35, -35, 70, -70)
LIGHT = np.array([-0.4, 0.6, 0.7])  # to the right, up, and out of the paper


class Content(NamedTuple):
    """What cameras saw: points (N, 3), their colours (N, 3) or one, and of voxels their normals (N, 3) and side."""

    points: np.ndarray
    colours: np.ndarray | str = "0.45"
    normals: np.ndarray | None = None
    cell: float = 0.0


class _View(NamedTuple):
    """Rows: right, up on the paper, and out of it; where the origin of the axes is, and what they are called."""

    system: np.ndarray
    origin: np.ndarray
    names: tuple[str, str]

    def placed(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self.origin) @ self.system.T)


def surface_of(voxels: Voxels) -> Content:
    """The occupied voxels that have an empty neighbour, and the directions in which they are empty."""
    from scipy.ndimage import binary_erosion

    T = voxels.world_from_lattice
    occupied = np.pad(voxels.occupancy.numpy().transpose(2, 1, 0).astype(np.float32), 1)
    outwards = -np.stack(list(np.gradient(occupied)), -1)
    index = np.argwhere((occupied > 0) & ~binary_erosion(occupied))
    normals = outwards[tuple(index.T)] @ np.linalg.inv(T[:3, :3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Content((index - 1) @ T[:3, :3].T + T[:3, 3], "0.45", normals, voxels.voxel_size)


def draw_cameras(figure: Figure, cameras: Geometry, content: Content, sizes: np.ndarray, colours: np.ndarray) -> None:
    """Draw cameras from above and from the side.

    Args:
        figure: to draw in.
        cameras: of which.
        content: what they saw.
        sizes: (V, 2) height and width of the photographs.
        colours: (V, 3) of the cameras.
    """
    above, aside, told = _views(cameras)
    words = f"thick: the upper side of the picture; dotted: the optical axis; {told}"
    figure.supxlabel(words, fontsize=9)
    panels = list(zip(figure.subplots(1, 2), (above, aside), ("from above", "from the side"), strict=True))
    length, meeting = _frustum_length(cameras.centers, content.points), _common_point(cameras)
    for axes, view, name in panels:
        axes.set_title(f"{counted(len(cameras.K), 'cameras')} {name}")
        places = _draw_frusta(axes, cameras, view, sizes, colours, length)
        seen = view.placed(content.points)[:, :2]
        if len(seen):
            places = np.concatenate([places, np.percentile(seen, (0, 100) if content.cell else (2, 98), axis=0)])
        if meeting is not None:
            places = np.concatenate([places, view.placed(meeting)[None, :2]])
        low, high = places.min(0), places.max(0)
        margin = 0.1 * float((high - low).max()) + 1e-12
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
        _name_axes(axes, view)
        _mark(axes, meeting, view)
    # Sizes of voxels and places of numbers are told on paper, whose scale is known when all is laid out.
    figure.draw_without_rendering()
    for axes, view, _ in panels:
        _draw_content(axes, content, view)
        _number(axes, cameras, view)


def _views(cameras: Geometry) -> tuple[_View, _View, str]:
    up = _up(cameras)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) >= np.cos(np.radians(LARGEST_TILT)):
        up = np.sign(up[axis]) * np.eye(3)[axis]
        right, origin = np.eye(3)[1 if axis == 0 else 0], np.zeros(3)
        told = "coordinates of the world"
    else:
        right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        right, origin = right / np.linalg.norm(right), cameras.centers.mean(0)
        told = "turned so that up is up; origin at the middle of the cameras; lengths of the world"
    back = np.cross(up, right)
    world = not origin.any() and bool(np.isin(np.abs(up), (0, 1)).all())

    def name(direction: np.ndarray, turned: str) -> str:
        return f"{'xyz'[np.argmax(np.abs(direction))]} (world)" if world else turned

    across, deep, high = name(right, "across"), name(back, "away"), name(up, "up")
    above = _View(np.stack([right, back, up]), origin, (across, deep))
    return above, _View(np.stack([right, up, -back]), origin, (across, high)), told


def _up(cameras: Geometry) -> np.ndarray:
    """The normal of the ring that cameras make around something, or else the mean of their own up."""
    up = -cameras.R[:, 1].mean(0)
    if np.linalg.norm(up) < 0.2:
        up = -cameras.R[0, 1]
    centers = cameras.centers
    _, spread, axes = np.linalg.svd(centers - centers.mean(0), full_matrices=False)
    if len(centers) > 3 and spread[2] < 0.3 * spread[1] and spread[1] > 0.3 * spread[0]:
        up = axes[2] * (np.sign(axes[2] @ up) or 1.0)
    return np.asarray(up / np.linalg.norm(up))


def _name_axes(axes: Axes, view: _View) -> None:
    """Names, and numbers of the world also where its axis runs to the left or down."""
    axes.set_xlabel(view.names[0], fontsize=8)
    axes.set_ylabel(view.names[1], fontsize=8)
    for axis, direction, name in zip((axes.xaxis, axes.yaxis), view.system[:2], view.names, strict=True):
        if name.endswith("(world)") and direction.sum() < 0:
            axis.set_major_formatter(lambda value, _: f"{0 - round(value, 12):g}".replace("-", "\N{MINUS SIGN}"))


def _draw_frusta(
    axes: Axes, cameras: Geometry, view: _View, sizes: np.ndarray, colours: np.ndarray, length: float
) -> np.ndarray:
    """Draw pyramids; all their points on the paper, (N, 2)."""
    from matplotlib.collections import LineCollection

    placed = view.placed(cameras.centers)
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


def _mark(axes: Axes, meeting: np.ndarray | None, view: _View) -> None:
    """The world's origin, and the point where the optical axes meet, where they are in the drawing."""
    marks = [("+", 9, "origin of the world", np.zeros(3))]
    marks += [] if meeting is None else [("o", 4, "where the optical axes meet", meeting)]
    for sign, size, name, point in marks:
        x, y, _ = view.placed(point)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        if left < x < right and low < y < high:
            axes.plot(x, y, sign, color="black", markersize=size, label=name, linestyle="none", zorder=5)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="best", framealpha=0.8)


def _common_point(cameras: Geometry) -> np.ndarray | None:
    """The point nearest to all optical axes, if it is near to them and before most cameras."""
    directions = np.linalg.inv(cameras.R)[:, :, 2]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < LEAST_TURNED:
        return None
    point = np.linalg.solve(total, np.einsum("vij,vj->i", across, cameras.centers) / len(across))
    to = point - cameras.centers
    aside = np.linalg.norm(np.einsum("vij,vj->vi", across, to), axis=1)
    along = (to * directions).sum(1)
    return np.asarray(point) if np.median(aside) < NEAREST * np.median(along) else None


def _draw_content(axes: Axes, content: Content, view: _View) -> None:
    seen = view.placed(content.points)
    order = np.argsort(seen[:, 2], kind="stable")
    if not len(order):
        return
    if content.normals is None:
        shown = content.colours if isinstance(content.colours, str) else content.colours[order]
        axes.scatter(seen[order, 0], seen[order, 1], c=shown, s=3, linewidths=0, zorder=0.5)
        return
    # Of voxels before each other only the foremost is seen.
    bins = np.round(seen[:, :2] / (0.5 * content.cell)).astype(int)
    order = order[::-1][np.unique(bins[order[::-1]], axis=0, return_index=True)[1]]
    order = order[np.argsort(seen[order, 2], kind="stable")]
    near = (seen[order, 2] - seen[:, 2].min()) / max(float(np.ptp(seen[:, 2])), 1e-12)
    lit = np.maximum(content.normals[order] @ view.system.T @ (LIGHT / np.linalg.norm(LIGHT)), 0)
    grey = np.clip(0.3 + 0.35 * lit + 0.3 * near, 0, 1)
    side = _points_per_unit(axes) * content.cell * (1.1 if "(world)" in view.names[0] else 1.4)
    shades = grey[:, None] * np.array([0.92, 0.97, 1.0])
    axes.scatter(seen[order, 0], seen[order, 1], c=shades, s=side**2, marker="s", linewidths=0, zorder=0.5)


def _points_per_unit(axes: Axes) -> float:
    (left, _), (right, _) = axes.transData.transform([(0, 0), (1, 0)])
    return float((right - left) * 72 / axes.figure.dpi)


def _number(axes: Axes, cameras: Geometry, view: _View) -> None:
    """Numbers behind the cameras; one that finds no place free of others is left out."""
    from matplotlib.patheffects import withStroke

    placed = view.placed(cameras.centers)[:, :2]
    points = placed * _points_per_unit(axes)
    back = -(np.linalg.inv(cameras.R)[:, :, 2] @ view.system.T)[:, :2]
    outline = [withStroke(linewidth=2, foreground="white")]
    written: list[tuple[np.ndarray, float]] = []
    for camera, direction in enumerate(back):
        length = np.linalg.norm(direction)
        straight = direction / length if length > 0.05 else np.array([0.0, 1.0])
        width = 0.62 * LETTERS * len(str(camera))
        for distance, turn in ((distance, turn) for distance in DISTANCES for turn in TURNS):
            c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
            offset = distance * np.array([c * straight[0] - s * straight[1], s * straight[0] + c * straight[1]])
            place = points[camera] + offset
            apart = [np.abs(place - other) / [(width + wide) / 2 + 1, LETTERS] for other, wide in written]
            if all(gap.max() > 1 for gap in apart):
                axes.annotate(
                    str(camera),
                    placed[camera],
                    (float(offset[0]), float(offset[1])),
                    textcoords="offset points",
                    fontsize=LETTERS,
                    ha="center",
                    va="center",
                    path_effects=outline,
                    zorder=6,
                )
                written.append((place, width))
                break


def _frustum_length(centers: np.ndarray, content: np.ndarray) -> float:
    """So long that neighbours hardly overlap and all are seen."""
    everything = np.concatenate([centers, content])
    low, high = np.percentile(everything, (2, 98), axis=0)
    whole = float(np.linalg.norm(high - low))
    if len(centers) < 2:
        return max(FRUSTUM_OF_ALL * whole, 1e-9) if whole > 0 else 1.0
    near = float(np.median(np.sort(np.linalg.norm(centers[:, None] - centers, axis=2), axis=1)[:, 1]))
    return float(np.clip(FRUSTUM * near, SHORTEST * whole, FRUSTUM_OF_ALL * whole)) or 1.0
