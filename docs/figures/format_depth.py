"""Depth is the camera's z, and not the way along the ray: both drawn for one pixel."""

import matplotlib.pyplot as plt
import numpy as np
from format_drawing import INK, OTHER, SAME, SHADE, arrow, panel

figure = plt.figure(figsize=(7.2, 2.8))
axes = panel(figure, 0.05, 0.05, 0.86, (-0.6, 7.6, -0.75, 2.35))
z, height = 4.6, 1.7
axes.fill([0, 5.6, 5.6], [0, 2.35, -0.35], color=SHADE, alpha=0.1, lw=0)
axes.plot([0, 7.5], [0, 0], color=INK, lw=0.9)
axes.text(7.5, 0.03, "the camera's z axis", fontsize=8.5, color=INK, ha="right", va="bottom")
axes.plot([1.0, 1.0], [-0.25, 0.62], color=SHADE, lw=2.2)
axes.text(1.0, -0.32, "image", fontsize=8.5, color=SHADE, ha="center", va="top")
axes.plot([z + 0.35, z + 0.35 - 0.6], [height - 0.8, height + 0.55], color=INK, lw=2.4, solid_capstyle="round")
axes.text(z + 0.4, height - 0.72, "surface", fontsize=8.5, color=INK, va="center")
axes.plot(0, 0, "o", color=INK, ms=6, zorder=6)
axes.text(-0.08, 0.1, "centre", fontsize=8.5, color=INK, ha="right", va="bottom")
arrow(axes, np.zeros(2), np.array([z, height]), OTHER)
turned = np.degrees(np.arctan2(height, z))
axes.text(2.55, 1.1, "distance along the ray", color=OTHER, fontsize=9.5, rotation=turned, ha="center", va="bottom")
axes.plot([z, z], [0, height], color=SAME, lw=0.9, ls="--")
arrow(axes, np.array([0, -0.5]), np.array([z, -0.5]), SAME, 2.2)
axes.plot([0, 0], [-0.6, 0], color=SAME, lw=0.9, ls="--")
axes.plot([z, z], [-0.6, 0], color=SAME, lw=0.9, ls="--")
axes.text(2.9, -0.45, "depth z: what all readers give", color=SAME, fontsize=9.5, ha="center", va="bottom")
axes.text(
    4.9,
    1.55,
    r"distance $= z\,\sqrt{1 + (\frac{u - c_x}{f_x})^2 + (\frac{v - c_y}{f_y})^2}$",
    color=INK,
    fontsize=9,
    ha="left",
    va="center",
)
