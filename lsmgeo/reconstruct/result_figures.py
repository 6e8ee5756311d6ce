"""Figures of a reconstruction: coloured depth, and the summary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo.drawing import as_pixels, as_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.reconstruct.write_results import ViewResult

__all__ = ["coloured_depth", "depth_limits", "summary"]

# The summary in inches: its width, and its height besides the images.
WIDTH, BESIDE = 11.0, 2.3
# The angle from which the points are drawn, in degrees from the camera.
ASIDE = 25.0
MOST_DRAWN = 150_000


def coloured_depth(depth: torch.Tensor) -> np.ndarray:
    """Depth in colours, red is near, blue is far, transparent where it is unknown: (h, w, 4) uint8."""
    from matplotlib import colormaps

    low, high = depth_limits(depth)
    colours = colormaps["turbo"](1 - ((depth - low) / max(high - low, 1e-12)).clamp(0, 1).numpy(), bytes=True)
    colours[..., 3] = np.where(depth.numpy() > 0, 255, 0)
    return np.asarray(colours)


def depth_limits(depth: torch.Tensor) -> tuple[float, float]:
    """The ends of the colour scale: the 1st and 99th percentile of depth."""
    values = depth[depth > 0].numpy()
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, (1, 99))
    return float(low), float(high)


def summary(one: ViewResult, points: np.ndarray, colours: np.ndarray, title: str) -> bytes:
    """A PNG with the image of a view, its depth, its confidence, and the points (N, 3) of the model from the side."""
    shape = min(1.2, one.depth.shape[0] / one.depth.shape[1])
    figure = new_figure(WIDTH, WIDTH * shape + BESIDE)
    figure.suptitle(title, wrap=True)
    panels = figure.subplots(2, 2)
    (image, depth), (confidence, cloud) = panels
    image.imshow(as_pixels(one.image))
    low, high = depth_limits(one.depth)
    depth.set_facecolor("0.9")
    shown = depth.imshow(np.where(one.depth > 0, one.depth, np.nan), cmap="turbo_r", vmin=low, vmax=high)
    figure.colorbar(shown, ax=depth, location="bottom", aspect=60, label="camera z [world units]")
    shown = confidence.imshow(one.confidence.numpy(), cmap="gray", vmin=0, vmax=1)
    words = "0 unknown, 1 certain" if one.confidence_name == "confidence" else "1 on the object"
    figure.colorbar(shown, ax=confidence, location="bottom", aspect=60, label=words)
    _draw_cloud(cloud, one.camera, points, colours, 1 / shape)
    known = 100 * float((one.depth > 0).float().mean())
    aside = f"the model, seen from {ASIDE:.0f} degrees to the side"
    names = ("image", f"depth of {known:.0f} % of the pixels", one.confidence_name, aside)
    for axes, name in zip(panels.flat, names, strict=True):
        axes.set_title(name, fontsize=10)
        axes.set_anchor("N")
        axes.set_xticks([])
        axes.set_yticks([])
    return as_png(figure)


def _draw_cloud(axes: Axes, camera: CameraTensors, points: np.ndarray, colours: np.ndarray, shape: float) -> None:
    """The points from a camera that is rotated about their centre by `ASIDE` degrees, far ones first."""
    if len(points) == 0:
        return
    from scipy.spatial.transform import Rotation

    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_DRAWN]
    R = camera.cam_from_world[:3, :3].double().numpy()
    moved = (points[chosen] - np.median(points, axis=0)) @ R.T
    x, y, z = Rotation.from_euler("y", ASIDE, degrees=True).apply(moved).T
    order = np.argsort(-z)
    axes.scatter(x[order], y[order], c=colours[chosen][order] / 255.0, s=3.0, marker="s", linewidths=0)
    (left, right), (top, bottom) = (np.percentile(values, (1, 99)) for values in (x, y))
    # Limits that show all points, in the shape of the image.
    half = 0.55 * max(bottom - top, (right - left) / shape) + 1e-9
    axes.set_xlim((left + right) / 2 - shape * half, (left + right) / 2 + shape * half)
    axes.set_ylim((top + bottom) / 2 + half, (top + bottom) / 2 - half)  # y points down
    axes.set_aspect("equal")
