"""The self-contained HTML page of a reconstruction: facts, an interactive model, and the images of every view."""

from __future__ import annotations

import base64
import io
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo.drawing import as_pixels
from lsmgeo.reconstruct.result_figures import depth_limits
from lsmgeo.reconstruct.viewer import make_viewer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.reconstruct.write_results import Results, ViewResult

__all__ = ["make_page"]

# The largest images, in pixels of the longer side and in bytes; the most bytes of all images.
LONGEST_SIDE, SHORTEST_SIDE = 480, 160
MOST_BYTES, MOST_BYTES_OF_ALL = 150_000, 12_000_000
IMAGES, STOPS = 3, 12


def make_page(results: Results, names: Sequence[str], cameras: CameraTensors) -> str:
    """Make the page. All text is escaped, and the security policy of the page forbids it to load anything.

    Args:
        results: their facts and views are shown; images are reduced to at most 480 pixels and 150 kB, and further if
            those of all views would exceed about 12 MB.
        names: of all images.
        cameras: leading shape (V,), of all images, drawn around the model.

    Returns:
        HTML, without a model if there are neither points nor faces.
    """
    from jinja2 import Environment
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    most = min(MOST_BYTES, MOST_BYTES_OF_ALL // max(1, IMAGES * len(results.views)))
    template = files("lsmgeo.reconstruct").joinpath("page.html").read_text("utf-8")
    has_model = len(results.points) or (results.mesh is not None and len(results.mesh.faces))
    return (
        Environment(autoescape=True, trim_blocks=True)
        .from_string(template)
        .render(
            title=results.title,
            facts=results.facts,
            notes=results.notes,
            hint="Depth is red where it is near and blue where it is far; grey where none was kept. Images are reduced "
            f"to at most {LONGEST_SIDE} pixels and {most / 1000:.0f} kB.",
            gradient=", ".join(to_hex(colormaps["turbo_r"](stop)) for stop in np.linspace(0, 1, STOPS)),
            viewer=make_viewer(results, cameras) if has_model else None,
            views=[
                {"number": one.view, "name": names[one.view], "numbers": one.numbers, "images": _images(one, most)}
                for one in results.views
            ],
        )
    )


def _images(one: ViewResult, most: int) -> list[dict[str, Any]]:
    """The image, the depth and the confidence of a view, for the template."""
    from PIL import Image

    low, high = depth_limits(one.depth)
    depth = np.where(one.depth > 0, (one.depth - low) / max(high - low, 1e-12), np.nan)
    drawn = [
        ("image", "image", None, Image.fromarray(as_pixels(one.image))),
        ("depth [world units]", "depth", (f"{low:.4g}", f"{high:.4g}"), _of_palette(depth, "turbo_r")),
        (one.confidence_name, "confidence", ("0", "1"), _of_palette(one.confidence.numpy(), "gray")),
    ]
    size = tuple(one.depth.shape)
    return [
        {"caption": caption, "kind": kind, "limits": limits, "size": size, "source": _encoded(image, most)}
        for caption, kind, limits, image in drawn
    ]


def _encoded(image: Any, most: int) -> str:
    """The data URI of an image that is reduced until it has at most so many bytes."""
    from PIL import Image

    # A mean of two depths is not a depth of the scene.
    kind, how = ("JPEG", Image.Resampling.BOX) if image.mode == "RGB" else ("PNG", Image.Resampling.NEAREST)
    side = LONGEST_SIDE
    while True:
        buffer, reduced = io.BytesIO(), image.copy()
        reduced.thumbnail((side, side), how)
        reduced.save(buffer, kind, quality=80, transparency=0)
        if buffer.tell() <= most or side <= SHORTEST_SIDE:
            return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"
        side = round(0.8 * side)


def _of_palette(values: np.ndarray, colours: str) -> Any:
    """An image of values from 0 to 1 in one of 255 colours, transparent where they are NaN."""
    from matplotlib import colormaps
    from PIL import Image

    index = np.where(np.isnan(values), 0, 1 + np.round(254 * np.clip(np.nan_to_num(values), 0, 1)))
    palette = np.round(255 * colormaps[colours](np.linspace(0, 1, 255))[:, :3]).astype(int)
    drawn = Image.fromarray(index.astype(np.uint8)).convert("P")
    drawn.putpalette([0, 0, 0, *palette.ravel().tolist()])
    return drawn
