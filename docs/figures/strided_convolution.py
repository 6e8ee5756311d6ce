"""Where the cells of a map of stride 2 are centred: pooling, and a centred 3-tap convolution."""

import matplotlib.pyplot as plt

width, stride = 8, 2
figure, axes = plt.subplots(figsize=(6.8, 2.6), layout="constrained")
for u in range(width):
    axes.add_patch(plt.Rectangle((u - 0.5, 0), 1, 0.8, facecolor="tab:blue", alpha=0.3, edgecolor="tab:blue"))
    axes.text(u, 0.4, str(u), ha="center", va="center")
rows = (
    (1.5, (stride - 1) / 2, 0.95, "tab:orange", "pooling, resizing:\nas the rule has it"),
    (2.5, 0.0, 1.5, "tab:green", "3-tap convolution,\npadding 1: shift first"),
)
for y, first, reach, color, label in rows:
    for i in range(width // stride):
        center = first + i * stride
        axes.plot([center - reach, center + reach], [y, y], color=color, lw=5, alpha=0.3, solid_capstyle="butt")
        axes.plot([center, center], [0.8, y], color=color, lw=1, ls=":")
        axes.plot(center, y, "o", color=color)
        axes.text(center, y + 0.2, f"cell {i}", ha="center", color=color, fontsize=9)
    axes.text(width + 0.1, y, label, va="center", color=color)
axes.text(width + 0.1, 0.4, "pixels", va="center", color="tab:blue")
axes.set_xlim(-1.2, width + 3.2)
axes.set_ylim(-0.2, 3.2)
axes.axis("off")
