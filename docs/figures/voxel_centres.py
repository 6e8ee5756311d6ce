"""Voxels lie between two bounds that are faces."""

import matplotlib.pyplot as plt

lower, upper, count = -0.5, 0.5, 4
spacing = (upper - lower) / count
figure, axes = plt.subplots(figsize=(6.4, 1.7), layout="constrained")
for index in range(count):
    left = lower + index * spacing
    axes.axvspan(left, left + spacing, color="tab:blue", alpha=0.12 if index % 2 else 0.28, lw=0)
    center = lower + (index + 0.5) * spacing
    axes.plot(center, 0, "o", color="tab:blue")
    axes.text(center, 0.35, f"voxel {index}", ha="center")
    axes.text(center, -0.6, f"{center:+.3f}", ha="center", color="tab:blue")
for bound, name in ((lower, "lower"), (upper, "upper")):
    axes.axvline(bound, color="black")
    axes.text(bound, 1.12, f"{name} = {bound}", ha="center")
axes.set_xlim(lower - 0.12, upper + 0.12)
axes.set_ylim(-1, 1)
axes.set_yticks([])
axes.set_xticks([])
axes.spines[:].set_visible(False)
