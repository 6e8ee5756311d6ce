"""A stride that leaves a remainder: the map covers more than the image."""

import matplotlib.pyplot as plt

width, stride = 10, 4
cells = -(-width // stride)
figure, axes = plt.subplots(figsize=(6.8, 2.3), layout="constrained")
for u in range(stride * cells):
    inside = u < width
    axes.add_patch(
        plt.Rectangle(
            (u - 0.5, 0),
            1,
            0.8,
            facecolor="tab:blue" if inside else "none",
            alpha=0.3 if inside else 1,
            edgecolor="tab:blue" if inside else "tab:red",
            linestyle="-" if inside else "--",
        )
    )
    axes.text(u, 0.4, str(u), ha="center", va="center", color="black" if inside else "tab:red")
for i in range(cells):
    axes.add_patch(
        plt.Rectangle((i * stride - 0.5, 1.1), stride, 0.8, facecolor="tab:orange", alpha=0.4, edgecolor="black")
    )
    axes.text(i * stride + (stride - 1) / 2, 1.5, f"cell {i}", ha="center", va="center")
axes.annotate("", (-0.5, -0.35), (width - 0.5, -0.35), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
axes.text((width - 1) / 2, -0.5, f"image: width = {width}", ha="center", va="top")
axes.annotate(
    "", (-0.5, 2.2), (stride * cells - 0.5, 2.2), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0}
)
axes.text(
    stride * cells / 2 - 0.5,
    2.3,
    f"map of stride {stride}: covers {stride * cells}, and this is the camera's width to state",
    ha="center",
    va="bottom",
)
axes.set_xlim(-1, stride * cells)
axes.set_ylim(-1, 2.8)
axes.axis("off")
