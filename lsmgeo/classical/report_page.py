"""One HTML page of a reconstruction that loads nothing: facts, the model to turn, and every view's pictures."""

from __future__ import annotations

import base64
import io
from importlib.resources import files
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from lsmgeo.classical.report_model import Model, make_viewer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from PIL import Image

__all__ = ["ReportPicture", "ReportView", "make_page"]

# Pictures are no larger than that, in pixels of the longer side and in bytes; together no more than that.
LONGEST_SIDE, SHORTEST_SIDE = 480, 160
MOST_BYTES, MOST_BYTES_OF_ALL = 150_000, 12_000_000
STOPS = 12


class ReportPicture(NamedTuple):
    """A picture of a view.

    Attributes:
        caption: what it shows.
        pixels: (h, w, 3) uint8 of a photograph; (h, w) float of depth in world units, 0 where there is none; (h, w)
            float from 0 to 1 of confidence.
        kind: decides the colours: depth is red where it is near and blue where it is far.
        limits: of depth, what is drawn in the deepest red and blue.
    """

    caption: str
    pixels: np.ndarray
    kind: Literal["photograph", "depth", "confidence"]
    limits: tuple[float, float] | None = None


class ReportView(NamedTuple):
    """A view: its number and name, its pictures side by side, and numbers with their names."""

    number: int
    name: str
    pictures: Sequence[ReportPicture]
    numbers: Sequence[tuple[str, str]]


def make_page(
    title: str,
    *,
    facts: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
    views: Sequence[ReportView] = (),
    model: Model | None = None,
) -> str:
    """Make the page; all text is escaped, and the page forbids itself to load anything.

    Args:
        title: of the page.
        facts: names and values, one a line.
        notes: warnings above them.
        views: shown one below the other; their pictures are reduced to 480 pixels and 150 kB at most, and to less
            where many views would make more than about 12 MB.
        model: to be turned; None where there is nothing to be seen.

    Returns:
        HTML.

    Example:
        >>> page = make_page("<script>", facts=[("photographs", "16")])
        >>> "<title>&lt;script&gt;</title>" in page
        True
    """
    from jinja2 import Environment
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    count = sum(len(view.pictures) for view in views)
    most = min(MOST_BYTES, MOST_BYTES_OF_ALL // max(1, count))
    template = files("lsmgeo.classical").joinpath("report_page.html").read_text("utf-8")
    page = Environment(autoescape=True, trim_blocks=True).from_string(template)
    return page.render(
        title=title,
        facts=facts,
        notes=notes,
        hint="Depth is red where it is near and blue where it is far; grey where none was kept. Here pictures are "
        f"reduced to at most {LONGEST_SIDE} pixels and {most / 1000:.0f} kB.",
        gradient=", ".join(to_hex(colormaps["turbo_r"](stop)) for stop in np.linspace(0, 1, STOPS)),
        viewer=None if model is None else make_viewer(model),
        views=[
            {
                "number": view.number,
                "name": view.name,
                "numbers": view.numbers,
                "pictures": [_shown(picture, most) for picture in view.pictures],
            }
            for view in views
        ],
    )


def _shown(picture: ReportPicture, most: int) -> dict[str, object]:
    """What the template needs of a picture."""
    height, width = picture.pixels.shape[:2]
    limits = None
    if picture.kind == "depth" and picture.limits is not None:
        limits = tuple(f"{value:.4g}" for value in picture.limits)
    elif picture.kind == "confidence":
        limits = ("0", "1")
    source = _encoded(picture, most)
    return {
        "caption": picture.caption,
        "kind": picture.kind,
        "source": source,
        "limits": limits,
        "size": (height, width),
    }


def _encoded(picture: ReportPicture, most: int) -> str:
    """A data URI of a reduced picture."""
    from PIL import Image

    side = LONGEST_SIDE
    while True:
        buffer = io.BytesIO()
        height, width = picture.pixels.shape[:2]
        scale = min(1.0, side / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        if picture.kind == "photograph":
            reduced = Image.fromarray(picture.pixels).resize(size, Image.Resampling.BOX, reducing_gap=2.0)
            reduced.save(buffer, "JPEG", quality=80)
            mime = "jpeg"
        else:
            # Nearest: between two depths lies none.
            rows, columns = (
                (np.arange(n) * 2 + 1) * m // (2 * n) for n, m in zip(size[::-1], (height, width), strict=True)
            )
            _of_palette(picture, picture.pixels[rows[:, None], columns]).save(buffer, "PNG", transparency=0)
            mime = "png"
        if len(buffer.getvalue()) <= most or side <= SHORTEST_SIDE:
            return f"data:image/{mime};base64,{base64.b64encode(buffer.getvalue()).decode()}"
        side = round(0.8 * side)


def _of_palette(picture: ReportPicture, values: np.ndarray) -> Image.Image:
    """Values as one of 255 colours; 0 is transparent, where there is no depth."""
    from matplotlib import colormaps
    from PIL import Image

    is_depth = picture.kind == "depth"
    low, high = picture.limits if is_depth and picture.limits is not None else (0.0, 1.0)
    scaled = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    index = np.where(values > 0 if is_depth else True, 1 + np.round(254 * scaled), 0).astype(np.uint8)
    colours = colormaps["turbo_r" if is_depth else "gray"](np.linspace(0, 1, 255))[:, :3]
    drawn = Image.fromarray(index).convert("P")
    drawn.putpalette([0, 0, 0, *np.round(255 * colours).astype(int).ravel().tolist()])
    return drawn
