"""Drawings of the built models: a box for every stage with its channels and size, arrows from its inputs."""

from __future__ import annotations

from collections.abc import Iterator
from math import log2

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, Polygon
from network_tracing import Stage, traced

# Parts of a model: name, colour and row in the drawing.
PARTS = {
    "images": ("images", "0.75", 0),
    "image_encoder": ("image encoder, each image by itself", "#8fb8de", 0),
    "encoder": ("image encoder, each image by itself", "#8fb8de", 0),
    "vector": ("image encoder, each image by itself", "#8fb8de", 0),
    "cameras": ("cameras", "0.75", 1),
    "rotation": ("pose, each camera by itself", "#c9b38c", 1),
    "unproject": ("unprojection", "#f2a65a", 0),
    "fusion": ("fusion", "#8cc084", 1),
    "recurrence": ("fusion", "#8cc084", 1),
    "grid_network": ("grid network", "#b79ad1", 1),
    "decoder": ("grid network", "#b79ad1", 1),
    "sweep": ("plane sweep", "#f2a65a", 2),
    "rays": ("along rays", "#e08e8e", 2),
    "rise": ("up to the image", "#d9a5c7", 2),
}
LAST = ("result", "#e6d05c")
ROW, STEP = 3.0, 1.45


def voxel_lsm() -> None:
    """V-LSM of the paper's preset."""
    draw("voxel-lsm")


def depth_lsm() -> None:
    """D-LSM of the paper's preset."""
    draw("depth-lsm")


def r2n2() -> None:
    """3D-R2N2 with pose, of the paper's preset."""
    draw("r2n2-pose")


def draw(name: str, preset: str = "paper") -> Axes:
    """Draw a model.

    Args:
        name: of `lsmgeo.models.create`.
        preset: likewise.
    """
    stages = [stage for stage in traced(name, preset) if stage.what != "norm"]
    dropped = {stage.name: stage.sources[0] for stage in traced(name, preset) if stage.what == "norm"}
    places = place(stages)
    wide = max(x for x, _ in places.values()) + STEP
    rows = max(row_of(stages, stage) for stage in stages) + 1
    _, axes = plt.subplots(figsize=(0.6 * wide, 0.6 * ROW * rows), layout="constrained")
    for stage in stages:
        box(axes, stage, places[stage.name], color_of(stages, stage))
    letters = iter("abcdefgh")
    marks: dict[str, str] = {}
    for stage in stages:
        sources = [dropped.get(source, source) for source in stage.sources]
        for source in sources:
            link(axes, places[source], places[stage.name], stage, marks, source, letters)
    titles(axes, stages, places)
    axes.set(xlim=(-STEP / 2, wide - STEP / 2), ylim=(-ROW * (rows - 1) - 1.55, 1.7), aspect="equal")
    axes.axis("off")
    return axes


def row_of(stages: list[Stage], stage: Stage) -> int:
    """The row of a stage; last stages stay in the row of those before them."""
    part = stage.part
    if part in PARTS:
        return PARTS[part][2]
    return row_of(stages, stages[stages.index(stage) - 1])


def color_of(stages: list[Stage], stage: Stage) -> str:
    return PARTS[stage.part][1] if stage.part in PARTS else LAST[1]


def place(stages: list[Stage]) -> dict[str, tuple[float, float]]:
    """The centre of every stage: rows from left to right."""
    counts: dict[int, int] = {}
    places = {}
    for stage in stages:
        row = row_of(stages, stage)
        places[stage.name] = (STEP * counts.get(row, 0), -ROW * row)
        counts[row] = counts.get(row, 0) + 1
    return places


def box(axes: Axes, stage: Stage, at: tuple[float, float], color: str) -> None:
    """A slab for a map, a cube for a grid, a bar for a vector; sides grow with the logarithm of the size."""
    x, y = at
    channels, *size = stage.shape
    thick = 0.05 + 0.04 * log2(1 + channels)
    style = {"edgecolor": "0.25", "linewidth": 0.7}
    if len(size) == 3:
        side, lean = 0.18 + 0.13 * log2(size[-1]), 0.35
    elif size:
        side, lean = 0.1 + 0.14 * log2(size[-1]), 0.0
    else:
        side, lean = 0.12 * log2(1 + channels), 0.0
    if len(size) == 3:
        left, low, slant = x - side * (1 + lean) / 2, y - side * (1 + lean) / 2, side * lean
        faces = [
            [(left, low), (left + side, low), (left + side, low + side), (left, low + side)],
            [(left, low + side), (left + side, low + side), (left + side + slant, low + side + slant),
             (left + slant, low + side + slant)],
            [(left + side, low), (left + side + slant, low + slant), (left + side + slant, low + side + slant),
             (left + side, low + side)],
        ]  # fmt: skip
    else:
        left, low, slant = x - thick / 2 - 0.12 * side, y - side / 2, 0.24 * side if size else 0.05
        front = [(left, low), (left + slant, low + slant), (left + slant, low + side), (left, low + side - slant)]
        shift = [(across + thick, up) for across, up in front]
        faces = [
            [front[3], front[2], shift[2], shift[3]],
            [front[0], shift[0], shift[3], front[3]],
            shift,
        ]
    for face, shade in zip(faces, (1.0, 0.8, 0.6), strict=True):
        axes.add_patch(Polygon(face, facecolor=color, alpha=shade, **style))
    where = f"{channels} \N{MULTIPLICATION SIGN} {size[-1]}{'³' if len(size) == 3 else '²'}" if size else f"{channels}"
    axes.text(x, y - 0.92, where, ha="center", va="top", fontsize=8)
    if stage.parameters:
        axes.text(x, y - 1.2, f"{stage.parameters:,}", ha="center", va="top", fontsize=6.5, color="0.4")


def link(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    stage: Stage,
    marks: dict[str, str],
    source: str,
    letters: Iterator[str],
) -> None:
    """An arrow to the neighbour, an arc over others of the row, and a letter at both ends from row to row."""
    (x0, y0), (x1, y1) = start, end
    style = {"arrowstyle": "-|>", "mutation_scale": 9, "color": "0.3", "linewidth": 0.9}
    if y0 == y1 and x1 - x0 < 1.5 * STEP:
        axes.add_patch(FancyArrowPatch((x0 + 0.52, y0 + 0.0), (x1 - 0.5, y1), **style))
    elif y0 == y1:
        bend = f"arc3,rad={-0.9 / (1.6 + (x1 - x0) / STEP):.3f}"
        axes.add_patch(FancyArrowPatch((x0, y0 + 0.62), (x1, y1 + 0.62), connectionstyle=bend, linestyle="--", **style))
    else:
        is_new = source not in marks
        letter = marks.setdefault(source, "" if not is_new else next(letters))
        around = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "0.3", "linewidth": 0.8}
        if is_new:
            axes.text(x0 + 0.55, y0 - 0.6, letter, fontsize=8, ha="center", va="center", bbox=around)
        at = (x1 - 0.62, y1 + 0.5 * (len(stage.sources) > 1))
        axes.text(*at, letter, fontsize=8, ha="center", va="center", bbox=around)


def titles(axes: Axes, stages: list[Stage], places: dict[str, tuple[float, float]]) -> None:
    """The name of every part above its boxes."""
    spans: dict[tuple[str, int], list[float]] = {}
    for stage in stages:
        title = PARTS[stage.part][0] if stage.part in PARTS else LAST[0]
        if stage.part not in PARTS and stage.name == "out" and stage is not stages[-1]:
            title = "last layer"
        spans.setdefault((title, row_of(stages, stage)), []).append(places[stage.name][0])
    for (title, row), across in spans.items():
        low, high = min(across) - 0.6, max(across) + 0.6
        y = -ROW * row + 1.3
        axes.plot((low, high), (y - 0.12, y - 0.12), color="0.6", linewidth=0.8)
        axes.text((low + high) / 2, y - 0.05, title, ha="center", va="bottom", fontsize=8)
