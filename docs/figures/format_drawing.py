"""What the drawings of file formats share: a camera with its axes, the way a matrix goes, and the first pixels."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, SHADE, SAME, OTHER = "#33383d", "#5b8db8", "#2f6f9f", "#c0392b"
AXIS_COLOURS = {"x": "#c0392b", "y": "#2e8b57", "z": "#2f5fa8"}
# Directions in the camera's own frame as this library has it: x right, y down, z forward.
DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}
OURS = ("right", "down", "forward")


def flatten(points: np.ndarray) -> np.ndarray:
    """Points (..., 3), x right, y down, z forward, on paper: forward goes to the upper right, as seen from behind."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack((x + 0.85 * z, -y + 0.4 * z), -1)


def panel(figure: Figure, left: float, bottom: float, scale: float, limits: tuple[float, ...], title: str = "") -> Axes:
    """A frameless area to draw in; ``left``, ``bottom`` and one unit (``scale``) are in inches.

    Args:
        figure: where it goes.
        left: inches from the figure's left.
        bottom: inches from its bottom.
        scale: inches of one unit.
        limits: least and largest x, and the y at the bottom and at the top.
        title: above it.
    """
    first, last, low, high = limits
    width, height = figure.get_size_inches()
    size = (scale * abs(last - first) / width, scale * abs(high - low) / height)
    axes = figure.add_axes((left / width, bottom / height, *size))
    axes.set(xlim=(first, last), ylim=(low, high))
    axes.axis("off")
    if title:
        axes.set_title(title, fontsize=9.5, color=INK)
    return axes


def arrow(axes: Axes, start: np.ndarray, end: np.ndarray, colour: str = INK, width: float = 1.8) -> None:
    """An arrow with its point at ``end``."""
    style = {"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 12}
    axes.annotate("", tuple(end), tuple(start), arrowprops=style, zorder=5)


def write(
    axes: Axes, place: np.ndarray, text: str, colour: str = INK, *, by: tuple[float, float] = (0, 0), **style
) -> None:
    """Words at a place, moved ``by`` some units."""
    axes.text(*np.add(place, by), text, color=colour, **{"fontsize": 9, **style})


def draw_axis(
    axes: Axes, start: np.ndarray, end: np.ndarray, letter: str, beyond: float = 0.12, width: float = 1.8
) -> None:
    """An axis with its letter beyond its point."""
    arrow(axes, start, end, AXIS_COLOURS[letter], width)
    way = np.subtract(end, start)
    place = end + beyond * way / np.linalg.norm(way)
    write(axes, place, letter, AXIS_COLOURS[letter], fontsize=11, fontweight="bold", ha="center", va="center", zorder=7)


def draw_camera(axes: Axes, directions: tuple[str, str, str], *, letters: str = "xyz") -> None:
    """A camera seen from behind, its image in front of it, and the axes that ``directions`` say."""
    corners = np.array([[-0.75, -0.5, 1.7], [0.75, -0.5, 1.7], [0.75, 0.5, 1.7], [-0.75, 0.5, 1.7]])
    plane = flatten(corners)
    center = flatten(np.zeros(3))
    axes.fill(*plane.T, color=SHADE, alpha=0.16, lw=0)
    axes.plot(*np.vstack((plane, plane[:1])).T, color=SHADE, lw=1.4)
    for corner in plane:
        axes.plot(*np.stack((center, corner)).T, color=SHADE, lw=0.8)
    axes.plot(*center, "o", color=INK, ms=5, zorder=6)
    # The image's own corner: rows run down the image whatever the camera's y does.
    axes.plot(*plane[0], "s", color=INK, ms=4.5, zorder=6)
    write(axes, plane[0], "pixel (0, 0)", by=(-0.05, 0.09), fontsize=7.5, va="bottom")
    for letter, name in zip(letters, directions, strict=True):
        draw_axis(axes, center, flatten(np.array(DIRECTIONS[name])), letter, 0.18)


def draw_direction(axes: Axes, label: str, *, to_camera: bool, colour: str) -> None:
    """World on the left, camera on the right, and the way that the matrix takes a point."""
    for x, name in ((0.0, "world"), (3.0, "camera")):
        axes.text(
            x,
            0,
            name,
            ha="center",
            va="center",
            fontsize=9.5,
            color=INK,
            bbox={"boxstyle": "round,pad=0.45", "fc": "white", "ec": INK, "lw": 1},
        )
    ends = np.array([[0.72, 0.0], [2.2, 0.0]])
    arrow(axes, *(ends if to_camera else ends[::-1]), colour=colour, width=2.4)
    axes.text(1.46, 0.26, label, ha="center", va="bottom", fontsize=8.5, color=colour)
    way = "world-to-camera" if to_camera else "camera-to-world"
    axes.text(1.46, -0.55, way, ha="center", va="top", fontsize=9, color=colour)


def draw_pixels(axes: Axes, center: float, colour: str) -> None:
    """The image's first pixels, with the coordinates of the first one's centre."""
    for row in range(2):
        for column in range(3):
            square = plt.Rectangle(
                (column - 0.5, row - 0.5), 1, 1, fc=SHADE, alpha=0.28 if (row + column) % 2 else 0.1, lw=0
            )
            axes.add_patch(square)
    axes.plot([-0.5, 2.5], [-0.5, -0.5], color=INK, lw=1.2)
    axes.plot([-0.5, -0.5], [-0.5, 1.5], color=INK, lw=1.2)
    axes.plot(0, 0, "o", color=colour, ms=6)
    axes.text(0.14, 0.03, f"({center:g}, {center:g})", color=colour, fontsize=9, va="center")
    axes.text(-0.5, -0.62, f"({center - 0.5:g}, {center - 0.5:g})", color=INK, fontsize=8, ha="center", va="bottom")


def draw_conventions(
    source: str,
    directions: tuple[str, str, str],
    *,
    matrix: str,
    to_camera: bool,
    center: float,
    letters: str = "xyz",
) -> Figure:
    """Two rows, the source and this library; three columns: axes of the camera, way of the matrix, first pixel.

    Args:
        source: the name of the format.
        directions: where its camera's x, y and z point.
        matrix: what the file calls its matrix.
        to_camera: whether that takes world to camera.
        center: coordinates of the first pixel's centre.
        letters: names of the three axes.
    """
    figure = plt.figure(figsize=(7.2, 4.4))
    rows = (
        (2.25, source, directions, letters, matrix, to_camera, center),
        (0.05, "lsmgeo", OURS, "xyz", "cam_from_world", True, 0.0),
    )
    for bottom, name, axis_names, axis_letters, label, forwards, first in rows:
        same = (axis_names == OURS and axis_letters == "xyz", forwards, first == 0.0)
        colours = [SAME if equal else OTHER for equal in same]
        described = ", ".join(f"{letter} {where}" for letter, where in zip(axis_letters, axis_names, strict=True))
        how = "integer" if first == 0 else "half-integer"
        left = panel(figure, 0.05, bottom, 0.66, (-1.15, 2.3, -1.3, 1.42), described)
        middle = panel(figure, 2.5, bottom, 0.57, (-0.75, 3.75, -1.45, 1.75), name)
        right = panel(figure, 5.25, bottom + 0.3, 0.52, (-0.9, 2.5, 1.6, -1.25), f"{how} pixel centres")
        draw_camera(left, axis_names, letters=axis_letters)
        draw_direction(middle, label, to_camera=forwards, colour=colours[1])
        draw_pixels(right, first, colours[2])
        for axes, colour in zip((left, middle, right), colours, strict=True):
            axes.title.set_color(colour)
        middle.title.set(color=INK, fontsize=12, fontweight="bold")
    return figure
