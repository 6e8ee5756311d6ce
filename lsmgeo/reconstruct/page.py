"""One HTML page of a reconstruction that loads nothing: facts, the model to turn, and every view's pictures."""

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
    from lsmgeo.reconstruct.write_results import Looked, Results

__all__ = ["make_page"]

# Pictures are no larger than that, in pixels of the longer side and in bytes; together no more than that.
LONGEST_SIDE, SHORTEST_SIDE = 480, 160
MOST_BYTES, MOST_BYTES_OF_ALL = 150_000, 12_000_000
PICTURES, STOPS = 3, 12


def make_page(results: Results, names: Sequence[str], cameras: CameraTensors) -> str:
    """Make the page; all text is escaped, and the page forbids itself to load anything.

    Args:
        results: shown from its facts to its views, one below the other; their pictures are reduced to 480 pixels and
            150 kB at most, and to less where many views would make more than about 12 MB.
        names: of all photographs.
        cameras: leading shape (V,), of all photographs, drawn about the model.

    Returns:
        HTML, without a model where there are neither points nor faces.
    """
    from jinja2 import Environment
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    most = min(MOST_BYTES, MOST_BYTES_OF_ALL // max(1, PICTURES * len(results.views)))
    template = files("lsmgeo.reconstruct").joinpath("page.html").read_text("utf-8")
    has_model = len(results.points) or (results.mesh is not None and len(results.mesh.faces))
    return (
        Environment(autoescape=True, trim_blocks=True)
        .from_string(template)
        .render(
            title=results.title,
            facts=results.facts,
            notes=results.notes,
            hint="Depth is red where it is near and blue where it is far; grey where none was kept. Here pictures are "
            f"reduced to at most {LONGEST_SIDE} pixels and {most / 1000:.0f} kB.",
            gradient=", ".join(to_hex(colormaps["turbo_r"](stop)) for stop in np.linspace(0, 1, STOPS)),
            viewer=make_viewer(results, cameras) if has_model else None,
            views=[
                {"number": one.view, "name": names[one.view], "numbers": one.numbers, "pictures": _pictures(one, most)}
                for one in results.views
            ],
        )
    )


def _pictures(one: Looked, most: int) -> list[dict[str, Any]]:
    """What the template needs of a view's photograph, depth and certainty."""
    from PIL import Image

    low, high = depth_limits(one.depth)
    depth = np.where(one.depth > 0, (one.depth - low) / max(high - low, 1e-12), np.nan)
    drawn = [
        ("photograph", "photograph", None, Image.fromarray(as_pixels(one.image))),
        ("depth [world units]", "depth", (f"{low:.4g}", f"{high:.4g}"), _of_palette(depth, "turbo_r")),
        (one.meaning, "confidence", ("0", "1"), _of_palette(one.certain.numpy(), "gray")),
    ]
    size = tuple(one.depth.shape)
    return [
        {"caption": caption, "kind": kind, "limits": limits, "size": size, "source": _encoded(image, most)}
        for caption, kind, limits, image in drawn
    ]


def _encoded(image: Any, most: int) -> str:
    """A data URI of a picture that is reduced until it has no more bytes than that."""
    from PIL import Image

    # Between two depths lies none.
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
