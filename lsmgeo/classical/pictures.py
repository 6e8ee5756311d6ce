"""Pictures of a reconstruction, for people."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lsmgeo.classical.reconstruct import Reconstruction

__all__ = ["coloured_depth", "depth_as_png16", "png", "summary"]


def png(image: np.ndarray) -> bytes:
    """Encode (h, w), (h, w, 3) or (h, w, 4) uint8, or (h, w) uint16, as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def depth_as_png16(depth: torch.Tensor, unit: float) -> bytes:
    """Depth (h, w) as a 16-bit PNG in steps of ``unit``; 0 where there is none.

    Raises:
        OptionError: the largest depth does not fit 16 bits.
    """
    steps = (depth.double() / unit).round()
    if float(steps.max()) > 65535:
        raise OptionError(f"unit must be at least {float(depth.max()) / 65535:.3g} for these depths; got {unit:.3g}")
    return png(steps.numpy().astype(np.uint16))


def coloured_depth(depth: torch.Tensor, mask: torch.Tensor) -> np.ndarray:
    """Depth as colours, near is red, far is blue, transparent outside the mask: (h, w, 4) uint8."""
    from matplotlib import colormaps

    low, high = _limits(depth, mask)
    scaled = 1 - ((depth - low) / max(high - low, 1e-12)).clamp(0, 1).numpy()
    colours = (colormaps["turbo"](scaled) * 255).astype(np.uint8)
    colours[..., 3] = np.where(mask.numpy(), 255, 0)
    return colours


def summary(result: Reconstruction, title: str) -> bytes:
    """One PNG with the reference, its depth, the confidence and the points seen from aside."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = result.mask.shape
    figure = Figure(figsize=(13, 13 * height / width + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    (reference, depth), (confidence, cloud) = figure.subplots(2, 2)
    reference.imshow(result.image.permute(1, 2, 0).numpy())
    reference.set_title("reference photograph")
    low, high = _limits(result.depth_map.depth, result.mask)
    shown = np.where(result.mask, result.depth_map.depth, np.nan)
    picture = depth.imshow(shown, cmap="turbo_r", vmin=low, vmax=high)
    depth.set_title(f"depth of the {100 * float(result.mask.float().mean()):.0f} % of the pixels kept")
    depth.set_facecolor("0.85")
    figure.colorbar(picture, ax=depth, label="camera z [world units]", shrink=0.8)
    picture = confidence.imshow(result.depth_map.confidence, cmap="gray", vmin=0, vmax=1)
    confidence.set_title("confidence")
    figure.colorbar(picture, ax=confidence, label="0 nothing known, 1 certain", shrink=0.8)
    _draw_cloud(cloud, result)
    for axes in (reference, depth, confidence, cloud):
        axes.set_xticks([])
        axes.set_yticks([])
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def _limits(depth: torch.Tensor, mask: torch.Tensor) -> tuple[float, float]:
    values = depth[mask].numpy()
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, (1, 99))
    return float(low), float(high)


def _draw_cloud(axes: Axes, result: Reconstruction, degrees: float = 25.0) -> None:
    """The points as a camera sees them that went round their middle by some degrees, far ones first."""
    axes.set_title(f"the {len(result.points)} points, seen from {degrees:.0f} degrees to the side")
    axes.set_facecolor("white")
    if len(result.points) == 0:
        return
    R = result.camera.cam_from_world[:3, :3].double().numpy()
    points = (result.points - np.median(result.points, axis=0)) @ R.T
    angle = np.radians(degrees)
    x = np.cos(angle) * points[:, 0] + np.sin(angle) * points[:, 2]
    z = -np.sin(angle) * points[:, 0] + np.cos(angle) * points[:, 2]
    order = np.argsort(-z)
    axes.scatter(x[order], points[order, 1], c=result.colours[order] / 255.0, s=4.0, marker="s", linewidths=0)
    spans = [np.percentile(values, (0.5, 99.5)) for values in (x, points[:, 1])]
    margin = 0.05 * max(high - low for low, high in spans) + 1e-9
    axes.set_xlim(spans[0][0] - margin, spans[0][1] + margin)
    axes.set_ylim(spans[1][1] + margin, spans[1][0] - margin)  # y points down
    axes.set_aspect("equal")
