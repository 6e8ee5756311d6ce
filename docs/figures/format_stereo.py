"""A rectified pair from above: two cameras of one orientation, and how disparity becomes depth."""

import matplotlib.pyplot as plt
import numpy as np
from format_drawing import INK, OTHER, SAME, SHADE, arrow, draw_axis, panel

figure = plt.figure(figsize=(7.2, 3.6))
axes = panel(figure, 0.05, 0.05, 0.8, (-2.6, 6.2, -0.85, 3.5))
baseline, plane, point = 2.4, 0.9, np.array([1.5, 3.1])
for x, name, mark in ((0.0, "left camera (im0)", "x"), (baseline, "right camera (im1)", "x - d")):
    axes.plot([x - 0.75, x + 0.75], [plane, plane], color=SHADE, lw=2.4)
    axes.plot([x, x], [0, plane + 0.12], color=INK, lw=0.8, ls=":")
    axes.plot([x, point[0]], [0, point[1]], color=OTHER, lw=1.2)
    axes.plot(x, 0, "o", color=INK, ms=6, zorder=6)
    axes.text(x, -0.52, name, fontsize=9, color=INK, ha="center", va="top")
    seen = x + (point[0] - x) * plane / point[1]
    axes.plot(seen, plane, "o", color=OTHER, ms=5, zorder=6)
    beside = 0.1 if x == 0 else -0.1
    axes.text(seen + beside, plane + 0.1, mark, fontsize=9, color=OTHER, ha="left" if x == 0 else "right", va="bottom")
axes.plot(*point, "o", color=INK, ms=6)
axes.text(point[0] + 0.12, point[1], "a point of the scene", fontsize=9, color=INK, va="center")
arrow(axes, np.array([0, -0.3]), np.array([baseline, -0.3]), SAME)
axes.text(baseline / 2, -0.26, "baseline B", fontsize=9, color=SAME, ha="center", va="bottom")
arrow(axes, np.array([-1.1, 0]), np.array([-1.1, point[1]]), SAME)
axes.text(-1.2, 1.6, "depth Z", fontsize=9, color=SAME, ha="right", va="center")
axes.plot([-1.25, 0], [0, 0], color=SAME, lw=0.8, ls="--")
axes.plot([-1.25, point[0]], [point[1], point[1]], color=SAME, lw=0.8, ls="--")
corner = np.array([-2.3, 0.0])
draw_axis(axes, corner, np.add(corner, (0.65, 0)), "x")
draw_axis(axes, corner, np.add(corner, (0, 0.65)), "z")
axes.text(3.6, 2.3, r"$Z = \frac{f\,B}{d + \mathrm{doffs}}$", fontsize=15, color=INK, va="center")
axes.text(3.6, 1.65, r"$\mathrm{doffs} = c_{x1} - c_{x0}$", fontsize=11, color=INK, va="center")
