"""The figures of reports, as PNG: curves, and sheets of images."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

from lsmgeo.drawing import Pixels, as_png, new_figure, tile
from lsmgeo.evaluation.report import Cell

__all__ = ["Curve", "draw_curves", "sheet"]

DPI = 110
# Margins of a sheet in pixels: between images, left of the names, and above the images.
GAP, NAMES, TOP = 4, 16, 46
COLOURS = ("#1f5fa8", "#c8553d", "#3f8f5a", "#8b5fbf", "#d29a1a", "#4aa3b5", "#7a7a7a", "#b04a8a")


class Curve(NamedTuple):
    """One line of a diagram."""

    name: str
    places: Sequence[float]
    cells: Sequence[Cell]
    is_elsewhere: bool = False  # the paper's, on other data


def draw_curves(
    curves: Sequence[Curve],
    *,
    title: str,
    data: str,
    across: str,
    up: str,
    bars: str = "two standard errors",
) -> bytes:
    """Draw curves with error bars of two standard errors; those of other data are thin and dashed.

    Args:
        curves: the curves; one of other data has the colour of the curve of the same name.
        title: the title.
        data: the data that was measured on, below the title.
        across: the label of the x axis, with units.
        up: the label of the y axis, with units.
        bars: the meaning of the error bars, if there are any.
    """
    figure = new_figure(7.0, 4.2, dpi=DPI)
    axes = figure.add_subplot()
    own = [curve.name for curve in curves if not curve.is_elsewhere]
    colour = {name: COLOURS[place % len(COLOURS)] for place, name in enumerate(own)}
    for curve in curves:
        values = [cell.value for cell in curve.cells]
        if curve.is_elsewhere:
            shade = colour.get(curve.name, "0.6")
            axes.plot(
                curve.places, values, "--", color=shade, lw=1.0, alpha=0.7, label=f"{curve.name} (paper, ShapeNet)"
            )
            continue
        reach = [0.0 if isnan(cell.error) else 2 * cell.error for cell in curve.cells]
        axes.errorbar(
            curve.places, values, reach, marker="o", ms=4, lw=1.6, capsize=2, color=colour[curve.name], label=curve.name
        )
    has_bars = any(cell.error > 0 for curve in curves for cell in curve.cells)
    axes.set_title(f"{title}\n{data}" + f"; bars: {bars}" * has_bars, fontsize=9, loc="left")
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.set_xticks(sorted({place for curve in curves for place in curve.places}))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return as_png(figure)


def sheet(
    rows: Sequence[Sequence[Pixels | None]],
    names: Sequence[str],
    columns: Sequence[str],
    *,
    title: str,
) -> bytes:
    """Draw images of one size in rows and columns with their names.

    Args:
        rows: rows of images; None leaves a cell empty.
        names: of the rows.
        columns: names of the columns.
        title: the title.
    """
    pixels = tile(rows, gap=GAP)
    side = next(image for row in rows for image in row if image is not None).shape[0]
    margin = NAMES + 7 * max(len(name) for name in names)  # pixels; a letter is about 7 wide
    width, height = margin + pixels.shape[1] + GAP, TOP + pixels.shape[0] + GAP
    figure = new_figure(width / 100, height / 100, layout="none")
    figure.text(margin / width, 1 - 14 / height, title, fontsize=10, va="center")
    for place, name in enumerate(names):
        middle = TOP + place * (side + GAP) + side / 2
        figure.text((margin - 8) / width, 1 - middle / height, name, fontsize=8, ha="right", va="center")
    for place, name in enumerate(columns):
        middle = margin + place * (side + GAP) + side / 2
        figure.text(middle / width, 1 - (TOP - 10) / height, name, fontsize=8, ha="center", va="center")
    # At its own resolution, from the lower left corner.
    figure.figimage(pixels, margin, GAP, origin="upper")
    return as_png(figure)
