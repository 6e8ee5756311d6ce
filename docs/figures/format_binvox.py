"""One grid of voxels, placed as its header says and placed on its own middle."""

import matplotlib.pyplot as plt
import numpy as np
from format_drawing import INK, OTHER, SAME, SHADE, panel

SIDE, SCALE, TRANSLATE = 12, 1.0, (0.15, -0.1)
chair = np.zeros((SIDE, SIDE), bool)  # (y up, x): a chair from its side
chair[0:5, [3, 4, 8, 9]] = True
chair[4:6, 3:10] = True
chair[5:12, 3:5] = True

figure = plt.figure(figsize=(7.2, 3.5))
placements = (
    ("as the header says", TRANSLATE, SAME, "translate + scale (i + 1/2) / n"),
    ("about the middle", (-SCALE / 2, -SCALE / 2), OTHER, "scale ((i + 1/2) / n - 1/2)"),
)
for number, (title, corner, colour, equation) in enumerate(placements):
    axes = panel(figure, 0.1 + 3.6 * number, 0.08, 1.7, (-0.65, 1.28, -0.72, 1.1), title)
    axes.title.set(color=colour, fontsize=11, fontweight="bold")
    step = SCALE / SIDE
    for row, column in np.argwhere(chair):
        left, bottom = corner[0] + column * step, corner[1] + row * step
        axes.add_patch(plt.Rectangle((left, bottom), step, step, fc=SHADE, ec="white", lw=0.5))
    axes.add_patch(plt.Rectangle(corner, SCALE, SCALE, fc="none", ec=colour, lw=1.6))
    axes.axhline(0, color=INK, lw=0.8)
    axes.axvline(0, color=INK, lw=0.8)
    axes.plot(0, 0, "o", color=INK, ms=4)
    axes.text(1.27, 0.02, "x", fontsize=9, color=INK, ha="right", va="bottom")
    axes.text(0.02, 1.09, "y", fontsize=9, color=INK, ha="left", va="top")
    axes.text(0.3, -0.7, equation, fontsize=10, color=colour, ha="center", bbox={"color": "white", "pad": 2})
    if not number:
        axes.plot(*corner, "s", color=OTHER, ms=6)
        axes.annotate(
            "translate",
            corner,
            (-0.6, -0.35),
            fontsize=9,
            color=OTHER,
            arrowprops={"arrowstyle": "-", "color": OTHER, "lw": 0.8},
        )
