"""Figures of an examination: the cameras, epipolar lines, differences of depth, and voxels over silhouettes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo.diagnosis.camera_drawing import Content, draw_cameras, surface_of
from lsmgeo.diagnosis.depth_consistency import best_neighbour_errors, surface_points, warp_view
from lsmgeo.diagnosis.evidence import DepthMaps, Features, StereoPair, VoxelModel, pair_medians
from lsmgeo.diagnosis.feature_matching import downsized
from lsmgeo.diagnosis.residuals import sampson_distances
from lsmgeo.diagnosis.silhouette_consistency import draw_cells
from lsmgeo.diagnosis.two_view_geometry import evenly, fundamental, homogeneous
from lsmgeo.drawing import as_pixels, as_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lsmgeo.data import PosedImages
    from lsmgeo.diagnosis.check_images import Examination

__all__ = ["draw_examination"]

DPI = 90
MOST_POINTS, MOST_MATCHES = 4000, 12
LONGEST_SIDE = 900


def draw_examination(scene: PosedImages, examination: Examination, title: str) -> dict[str, tuple[str, bytes]]:
    """Draw the evidence of an examination.

    Returns:
        For each figure its description, the name of its file, and a PNG.

    Raises:
        DataError: an image is missing or damaged.
    """
    figures = {"cameras": ("cameras.png", _cameras(scene, examination, title))}
    for item in examination.evidence:
        if isinstance(item, Features):
            figures["matches and epipolar lines"] = ("matches.png", _matches(scene, examination, item, title))
        elif isinstance(item, DepthMaps):
            figures["depth of a view in another"] = ("depth.png", _depth(scene, examination, item, title))
        elif isinstance(item, StereoPair):
            figures["pair warped by depth"] = ("warp.png", _warp(examination, item, title))
        elif isinstance(item, VoxelModel) and item.masks is not None:
            figures["voxels in the silhouettes"] = ("outlines.png", _silhouettes(scene, examination, item, title))
    return figures


def _colours(count: int) -> np.ndarray:
    from matplotlib import colormaps

    return np.asarray(colormaps["turbo"](np.linspace(0.05, 0.95, count))[:, :3])


def _cameras(scene: PosedImages, examination: Examination, title: str) -> bytes:
    """Cameras from above and from the side."""
    cameras = examination.hypothesis.cameras
    sizes = np.array([scene.size(view) for view in range(len(scene))])
    figure = new_figure(14, 7.8, title, dpi=DPI)
    draw_cameras(figure, cameras, _content(scene, examination), sizes, _colours(len(scene)))
    return as_png(figure)


def _content(scene: PosedImages, examination: Examination) -> Content:
    """The content of the scene: sparse points, voxels, or points of depth maps."""
    if scene.points is not None and len(scene.points.positions):
        chosen = evenly(len(scene.points.positions), MOST_POINTS)
        return Content(scene.points.positions[chosen], scene.points.colours[chosen] / 255.0)
    if scene.voxels is not None:
        return surface_of(scene.voxels)
    points = np.zeros((0, 3))
    for item in examination.evidence:
        if isinstance(item, (DepthMaps, StereoPair)):
            each = [surface_points(item.surfaces, examination.hypothesis, view) for view in item.surfaces.views]
            points = np.concatenate(each)
    return Content(points[:: max(1, len(points) // MOST_POINTS)])


def _load_image(scene: PosedImages, view: int) -> tuple[np.ndarray, float]:
    """An image for drawing (h, w, 3) uint8, downsized, and its pixels per pixel drawn."""
    image = as_pixels(scene.load(view))
    return downsized(image, LONGEST_SIDE), max(1.0, max(image.shape) / LONGEST_SIDE)


def _show(axes: Axes, image: np.ndarray, scale: float, **options: object) -> None:
    """Draw a downsized image in the pixels of the original."""
    height, width = image.shape[:2]
    extent = (-0.5, width * scale - 0.5, height * scale - 0.5, -0.5)
    axes.imshow(image, extent=extent, **options)  # type: ignore[arg-type]
    axes.set_xticks([])
    axes.set_yticks([])


def _matches(scene: PosedImages, examination: Examination, features: Features, title: str) -> bytes:
    """Matches and epipolar lines of the pair whose error is closest to the median of all pairs."""
    cameras, matches = examination.hypothesis.cameras, features.matches
    medians = pair_medians(np.abs(sampson_distances(matches, cameras)), matches)
    A = fundamental(cameras, matches.first, matches.second)
    lined = np.abs(A).max((1, 2)) > 0
    ranked = np.argsort(np.abs(medians - np.median(medians[lined] if lined.any() else medians)), kind="stable")
    pair = next((int(index) for index in ranked if lined[index]), int(ranked[0]))
    views = int(matches.first[pair]), int(matches.second[pair])
    chosen = np.flatnonzero(matches.pair == pair)
    pixels = matches.pixels[chosen[evenly(len(chosen), MOST_MATCHES)]]
    F = A[pair]
    figure = new_figure(14, 14 * 0.5 * max(h / w for h, w in map(scene.size, views)) + 1.1, title, dpi=DPI)
    for side, (axes, view) in enumerate(zip(figure.subplots(1, 2), views, strict=True)):
        _show(axes, *_load_image(scene, view))
        height, width = scene.size(view)
        other = homogeneous(pixels[:, 1 - side])
        for (x, y), line, colour in zip(
            pixels[:, side], other @ (F if side == 0 else F.T), _colours(len(pixels)), strict=True
        ):
            if np.abs(line[:2]).max() > 0:
                with np.errstate(divide="ignore"):  # vertical lines
                    slope = -line[0] / line[1]
                axes.axline(-line[2] * line[:2] / (line[:2] @ line[:2]), slope=slope, color=colour, linewidth=1.0)
            axes.plot(x, y, "o", color=colour, markersize=6, markeredgecolor="white", markeredgewidth=0.8)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_title(f"{view}: {scene.names[view]}", fontsize=10)
    figure.supxlabel(
        f"{len(pixels)} of the pair's {len(chosen)} matches, each on the epipolar line of its match if the cameras "
        f"are right; median distance {medians[pair]:.3g} px",
        fontsize=9,
    )
    return as_png(figure)


def _dots(axes: Axes, pixels: np.ndarray, values: np.ndarray, label: str, **options: Any) -> None:
    """Values at pixels as colours, with a colour bar."""
    dots = axes.scatter(pixels[:, 0], pixels[:, 1], c=values, s=7, linewidths=0, **options)
    axes.figure.colorbar(dots, ax=axes, label=label, shrink=0.85)


def _depth(scene: PosedImages, examination: Examination, item: DepthMaps, title: str) -> bytes:
    """The depth of a typical view, and its difference from the depth of its best neighbour."""
    found = best_neighbour_errors(item.surfaces, examination.hypothesis)
    figure = new_figure(14, 5.2, title, dpi=DPI)
    left, right = figure.subplots(1, 2)
    if found:
        medians = {view: float(np.median(np.abs(errors))) for view, (_, _, errors) in found.items()}
        view = min(found, key=lambda view: abs(medians[view] - float(np.median(list(medians.values())))))
        other, known, errors = found[view]
        image, scale = _load_image(scene, view)
        pixels, depth = item.surfaces.pixels[view][known], item.surfaces.depths[view][known]
        for axes in (left, right):
            _show(axes, image, scale, alpha=0.5)
        low, high = np.percentile(depth, (5, 95))
        # Near is red and far is blue, as in all figures of depth.
        _dots(left, pixels, depth, "depth [world units]", cmap="turbo_r", vmin=low, vmax=max(high, low + 1e-9))
        highest = max(4.0, 2 * 100 * medians[view])
        _dots(right, pixels, 100 * np.abs(errors), "difference [%]", cmap="turbo", vmin=0, vmax=highest)
        left.set_title(f"depth of view {view} ({scene.names[view]})", fontsize=10)
        right.set_title(f"against that of view {other}: median {100 * medians[view]:.3g} %", fontsize=10)
    else:
        left.set_title("no view's depth projects into another view")
        for axes in (left, right):
            axes.axis("off")
    return as_png(figure)


def _warp(examination: Examination, item: StereoPair, title: str) -> bytes:
    """The difference of the pair, with one image warped by depth and without."""
    view = item.surfaces.views[0]
    figure = new_figure(14, 5.2, title, dpi=DPI)
    left, right = figure.subplots(1, 2)
    height, width = item.images[view].shape
    pixels, moved, unmoved = warp_view(item.surfaces, examination.hypothesis, item.images, view)
    for axes, values, words in ((left, unmoved, "not warped"), (right, moved, "warped by depth")):
        _show(axes, item.images[view], 1.0, cmap="gray", alpha=0.5)
        _dots(axes, pixels, values, "grey levels", cmap="turbo", vmin=0, vmax=60)
        median = f"{np.median(values):.3g}" if len(values) else "none"
        axes.set_title(f"difference of the two images, {words}: median {median}", fontsize=10)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
    return as_png(figure)


def _silhouettes(scene: PosedImages, examination: Examination, item: VoxelModel, title: str) -> bytes:
    """Images with the silhouettes of mask and projected voxels, up to eight views."""
    assert item.masks is not None
    rows = evenly(len(item.masks.views), 8).tolist()
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure = new_figure(3.4 * columns, 3.6 * lines + 0.8, title, dpi=DPI)
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in grid:
        axes.axis("off")
    for axes, row in zip(grid, rows, strict=False):
        view, mask, step = (values[row] for values in item.masks)
        _show(axes, *_load_image(scene, view))
        drawn = draw_cells(item.cells, examination.hypothesis.cameras, view, mask.shape, step)
        x, y = np.arange(mask.shape[1]) * step, np.arange(mask.shape[0]) * step
        for borders, colour in ((mask, "tab:green"), (drawn, "tab:red")):
            if borders.any() and not borders.all():
                axes.contour(x, y, borders.astype(float), levels=[0.5], colors=[colour], linewidths=1.2)
        axes.set_title(f"{view}: {scene.names[view]}", fontsize=9)
    figure.supxlabel("green: the silhouette in the image; red: the projected voxels", fontsize=9)
    return as_png(figure)
