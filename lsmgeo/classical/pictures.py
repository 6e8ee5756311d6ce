"""Pictures of a reconstruction, for people."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo.data.images import encode_png
from lsmgeo.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.classical.outputs import Looked

__all__ = ["coloured_depth", "depth_as_png16", "depth_limits", "summary"]

# Of the summary, in inches: its width, what lies between its panels, below them and above.
WIDTH, GAP, BELOW, ABOVE = 11.0, 0.25, 0.75, 0.75
DPI = 100
# Degrees by which the points are seen from aside.
ASIDE = 25.0
MOST_DRAWN = 150_000


def depth_as_png16(depth: torch.Tensor, unit: float) -> bytes:
    """Depth (h, w) as a 16-bit PNG in steps of ``unit``; 0 where there is none.

    Raises:
        OptionError: the largest depth does not fit 16 bits.
    """
    steps = (depth.double() / unit).round()
    if float(steps.max()) > 65535:
        raise OptionError(f"unit must be at least {float(depth.max()) / 65535:.3g} for these depths; got {unit:.3g}")
    return encode_png(steps.numpy().astype(np.uint16))


def coloured_depth(depth: torch.Tensor, mask: torch.Tensor) -> np.ndarray:
    """Depth as colours, near is red, far is blue, transparent outside the mask: (h, w, 4) uint8."""
    from matplotlib import colormaps

    low, high = depth_limits(depth, mask)
    scaled = 1 - ((depth - low) / max(high - low, 1e-12)).clamp(0, 1).numpy()
    colours = (colormaps["turbo"](scaled) * 255).astype(np.uint8)
    colours[..., 3] = np.where(mask.numpy(), 255, 0)
    return colours


def depth_limits(depth: torch.Tensor, mask: torch.Tensor) -> tuple[float, float]:
    """The depths that are drawn in the deepest red and blue: of 98 % of the pixels of a mask."""
    values = depth[mask].numpy()
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, (1, 99))
    return float(low), float(high)


def summary(one: Looked, points: np.ndarray, colours: np.ndarray, title: str) -> bytes:
    """One PNG with a view's photograph, its depth, what is certain of it, and the points seen from aside.

    Args:
        one: the view.
        points: (N, 3) of the model.
        colours: (N, 3) uint8.
        title: to write above.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Panels have the shape of the photograph and the figure is made to measure: nothing is left empty between them.
    rows, columns = one.depth.shape
    wide = (WIDTH - 3 * GAP) / 2
    high = wide * rows / columns
    if high > wide * 1.2:
        wide, high = wide * 1.2 * wide / high, wide * 1.2
    width, height = 2 * wide + 3 * GAP, 2 * (high + BELOW) + ABOVE
    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)
    figure.suptitle(title, y=1 - 0.18 / height, va="top", wrap=True)

    def panel(row: int, column: int, name: str) -> Axes:
        left, low = GAP + column * (wide + GAP), (1 - row) * (high + BELOW) + BELOW
        axes = figure.add_axes((left / width, low / height, wide / width, high / height))
        axes.set_title(name, fontsize=10, pad=4)
        axes.set_xticks([])
        axes.set_yticks([])
        return axes

    def legend(axes: Axes, picture: ScalarMappable, words: str) -> None:
        box = axes.get_position()
        bar = figure.add_axes((box.x0, box.y0 - 0.2 / height, box.width, 0.12 / height))
        figure.colorbar(picture, cax=bar, orientation="horizontal")
        bar.tick_params(labelsize=8, length=2, pad=1)
        bar.set_xlabel(words, fontsize=8, labelpad=1)

    reference = panel(0, 0, "photograph")
    reference.imshow(one.image.permute(1, 2, 0).numpy())
    known = one.depth > 0
    low, high_depth = depth_limits(one.depth, known)
    depth = panel(0, 1, f"depth of {100 * float(known.float().mean()):.0f} % of the pixels")
    depth.set_facecolor("0.9")
    shown = np.where(known, one.depth, np.nan)
    legend(depth, depth.imshow(shown, cmap="turbo_r", vmin=low, vmax=high_depth), "camera z [world units]")
    certain = panel(1, 0, one.meaning)
    picture = certain.imshow(one.certain.numpy(), cmap="gray", vmin=0, vmax=1)
    legend(certain, picture, "0 nothing known, 1 certain" if one.meaning == "confidence" else "1 on the object")
    cloud = panel(1, 1, f"the model, seen from {ASIDE:.0f} degrees to the side")
    _draw_cloud(cloud, one.camera, points, colours, wide / high)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw_cloud(axes: Axes, camera: CameraTensors, points: np.ndarray, colours: np.ndarray, shape: float) -> None:
    """The points as a camera sees them that went round their middle by some degrees, far ones first."""
    if len(points) == 0:
        return
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_DRAWN]
    R = camera.cam_from_world[:3, :3].double().numpy()
    moved = (points[chosen] - np.median(points, axis=0)) @ R.T
    angle = np.radians(ASIDE)
    x = np.cos(angle) * moved[:, 0] + np.sin(angle) * moved[:, 2]
    z = -np.sin(angle) * moved[:, 0] + np.cos(angle) * moved[:, 2]
    order = np.argsort(-z)
    axes.scatter(x[order], moved[order, 1], c=colours[chosen][order] / 255.0, s=3.0, marker="s", linewidths=0)
    (left, right), (top, bottom) = (np.percentile(values, (1, 99)) for values in (x, moved[:, 1]))
    # As wide and as high as shows all, in the panel's own shape.
    half = 0.55 * max(bottom - top, (right - left) / shape) + 1e-9
    axes.set_xlim((left + right) / 2 - shape * half, (left + right) / 2 + shape * half)
    axes.set_ylim((top + bottom) / 2 + half, (top + bottom) / 2 - half)  # y points down
