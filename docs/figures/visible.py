"""Which sites a camera sees, drawn from above."""

import matplotlib.pyplot as plt
import numpy as np

focal_length, width, near = 6.0, 9, 0.4
z, x = np.meshgrid(np.linspace(-0.9, 2.7, 13), np.linspace(-1.5, 1.5, 11))
with np.errstate(divide="ignore", invalid="ignore"):
    u = focal_length * x / z + (width - 1) / 2
visible = (z > near) & (u >= -0.5) & (u < width - 0.5)

figure, axes = plt.subplots(figsize=(6.8, 4.0), layout="constrained")
depth = 2.9
slope = width / 2 / focal_length
axes.fill(
    [near, depth, depth, near],
    [slope * near, slope * depth, -slope * depth, -slope * near],
    color="tab:blue",
    alpha=0.12,
)
axes.plot([0, depth], [0, slope * depth], color="tab:blue", lw=1)
axes.plot([0, depth], [0, -slope * depth], color="tab:blue", lw=1)
axes.axvline(near, color="tab:red", lw=1, ls="--")
axes.text(near + 0.03, -1.72, "depth = near", color="tab:red")
axes.plot(z[visible], -x[visible], "o", color="tab:blue", label="visible")
axes.plot(
    z[~visible], x[~visible], "o", mfc="none", color="gray", label="not visible: outside the image, too near or behind"
)
axes.plot(0, 0, ">", color="black", markersize=13)
axes.text(0, -0.12, "camera", ha="center", va="top", bbox={"color": "white", "pad": 1})
axes.text(2.95, 1.55, "u = -0.5", color="tab:blue")
axes.text(2.95, -1.62, "u = w - 0.5", color="tab:blue")
axes.annotate("", (-0.55, -1.78), (-1.0, -1.78), arrowprops={"arrowstyle": "->"})
axes.text(-0.5, -1.78, "z (depth)", ha="left", va="center")
axes.set_aspect("equal")
axes.set_xlim(-1.1, 3.7)
axes.set_ylim(-1.95, 1.85)
axes.axis("off")
axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)
