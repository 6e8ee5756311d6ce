"""Where a rendering of 3D-R2N2 was taken from: azimuth, elevation and distance about an upright y axis."""

import matplotlib.pyplot as plt
import numpy as np
from format_drawing import INK, OTHER, SAME, SHADE, arrow, draw_axis, panel, write


def on_paper(points: np.ndarray) -> np.ndarray:
    """The object's frame (x to the right, y up, z towards the lower left) on paper."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack((x - 0.45 * z, y - 0.5 * z), -1)


def position(azimuth: np.ndarray | float, elevation: np.ndarray | float) -> np.ndarray:
    """Points at distance 1."""
    a, e = np.broadcast_arrays(np.asarray(azimuth, float), np.asarray(elevation, float))
    return np.stack((np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)), -1)


figure = plt.figure(figsize=(7.2, 3.4))
axes = panel(figure, 0.1, 0.1, 1.28, (-1.3, 4.2, -0.95, 1.55))
azimuth, elevation, distance = np.radians(42.0), np.radians(33.0), 1.75
origin = np.zeros(2)
for tip, letter in (((1.35, 0, 0), "x"), ((0, 1.2, 0), "y"), ((0, 0, 1.35), "z")):
    draw_axis(axes, origin, on_paper(np.array(tip)), letter, width=1.3)
corners = 0.24 * np.array([[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1], [-1, -1, -1]], float)
raised = np.add(corners, (0, 0.48, 0))
for outline in (corners, raised, *np.stack((corners, raised), 1)):
    axes.plot(*on_paper(outline).T, color=SHADE, lw=1)

camera = distance * position(azimuth, elevation)
foot = camera * (1, 0, 1)
arrow(axes, on_paper(camera), on_paper(0.3 * camera), SAME, 1.6)
for end in (origin, on_paper(camera)):
    axes.plot(*np.stack((end, on_paper(foot))).T, color=INK, lw=0.9, ls="--")
axes.plot(*on_paper(camera), "o", color=INK, ms=8, zorder=6)
write(axes, on_paper(camera), "camera centre C,\nlooking at the origin", by=(0.1, 0.05), va="bottom")
axes.plot(*on_paper(0.75 * position(np.linspace(0, azimuth, 30), 0.0)).T, color=OTHER, lw=1.6)
write(axes, on_paper(0.75 * position(0.35 * azimuth, 0.0)), "azimuth a", OTHER, by=(0.05, -0.1))
axes.plot(*on_paper(1.1 * position(azimuth, np.linspace(0, elevation, 30))).T, color=OTHER, lw=1.6)
write(axes, on_paper(1.1 * position(azimuth, 0.75 * elevation)), "elevation e", OTHER, by=(0.1, -0.05))
axes.text(2.0, 0.3, r"$C = d\,(\cos e \cos a,\; \sin e,\; \cos e \sin a)$", fontsize=10.5, color=INK)
axes.text(2.0, 0.0, r"$d = 1.75 \times$ the fourth number of the line", fontsize=9.5, color=INK)
