"""Pixel centres are integers, borders lie at halves."""

import matplotlib.pyplot as plt
import numpy as np

width, height = 4, 3
figure, axes = plt.subplots(figsize=(6.4, 4.3), layout="constrained")
shade = np.add.outer(np.arange(height), np.arange(width)) % 2
axes.imshow(shade, cmap="Blues", vmin=-0.5, vmax=4, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
columns, rows = np.meshgrid(np.arange(width), np.arange(height))
axes.plot(columns.ravel(), rows.ravel(), "o", color="tab:blue", label="pixel centres, here")
axes.plot(
    columns.ravel() + 0.5,
    rows.ravel() + 0.5,
    "x",
    color="tab:red",
    markersize=5,
    clip_on=False,
    zorder=3,
    label="centres of a half-integer source, not converted",
)
for u, v in ((0, 0), (width - 1, height - 1)):
    axes.annotate(f"({u}, {v})", (u, v), textcoords="offset points", xytext=(0, 8), ha="center", color="tab:blue")
axes.set_xticks(np.arange(-0.5, width, 0.5))
axes.set_yticks(np.arange(-0.5, height, 0.5))
axes.xaxis.tick_top()
axes.xaxis.set_label_position("top")
axes.set_xlabel("u (columns)")
axes.set_ylabel("v (rows)")
axes.set_title(
    f"an image of {width} x {height} pixels covers [-0.5, {width - 0.5}) x [-0.5, {height - 0.5})", fontsize=10
)
axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=2, frameon=False)
