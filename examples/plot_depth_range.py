"""
How many depth planes, and where?
=================================

A plane sweep finds depths only between ``near`` and ``far``, at a number of planes with some spacing. How do these
choices affect the error? Here the true depth is known, so each can be measured.
"""

# %%
# Three cameras side by side look at a wall with a depth from 1.5 at the left edge of the image to 9 at the right. Its
# texture is finer where it is near, so that all of it is textured.

import math

import matplotlib.pyplot as plt
import torch

from lsmgeo import cameras, metrics, scenes
from lsmgeo.classical import sweep, sweep_planes

height, width, focal_length, baseline = 64, 128, 110.0, 0.3
K = torch.tensor([[focal_length, 0.0, (width - 1) / 2], [0.0, focal_length, (height - 1) / 2], [0.0, 0.0, 1.0]])
E = torch.eye(4).repeat(3, 1, 1)
E[:, 0, 3] = torch.tensor([0.0, -baseline, baseline])
views = cameras.CameraTensors(K.repeat(3, 1, 1), E, torch.full((3,), height), torch.full((3,), width))

ends = 1 / torch.linspace(1 / 1.2, 1 / 10.0, 10)  # depths of the ends of nine pieces
slope, pieces = math.atan2(6.8, 5.5), []
for start, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
    middle, length = (start + end) / 2, (end - start) / math.sin(slope)
    paint = scenes.Material((0.95, 0.9, 0.8), "waves", (0.1, 0.2, 0.3), frequency=20 / middle, seed=len(pieces))
    piece = scenes.box((0, 0, 0), (length, 20.0, 0.01), paint).rotated(1, -math.degrees(slope))
    pieces.append(piece.moved((-0.93 + (middle - 1.5) / math.tan(slope), 0.0, middle)))
lights = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
rendering = scenes.render([scenes.Scene(pieces)], views.at(None), lights)
images, truth = rendering.images[0], rendering.depth[0, 0]
print(f"true depth from {truth.min():.2f} to {truth.max():.2f}")

# %%
# First the number of planes, measured by the fraction of pixels whose depth error exceeds 2 %. A parabola refines the
# winning plane, so errors fall until one plane step moves the neighbours' samples by about a pixel
# (``spacing="disparity"`` uses that number), and little further below half a pixel. With planes even in depth, most are
# far away, where a step moves nothing, and hardly any are in the near part of the wall.


def off_by(found: torch.Tensor, fraction: float) -> float:
    return float(metrics.bad_pixel_rate(found / truth, torch.ones_like(truth), fraction, missing="bad").rate)


numbers = (8, 16, 32, 64, 128)
curves = {
    spacing: [
        off_by(sweep(images, views, sweep_planes(views, 1.4, 9.5, number, spacing)).depth, 0.02) for number in numbers
    ]
    for spacing in ("inverse", "depth")
}
pixel_planes = len(sweep_planes(views, 1.4, 9.5, spacing="disparity"))
print("planes: " + "".join(f"{number:8}" for number in numbers))
for spacing, rates in curves.items():
    print(f"{spacing:>7}:" + "".join(f"{100 * rate:6.1f} %" for rate in rates))
print(f"a step is a pixel with {pixel_planes} planes")

# %%
# Then the range. Surfaces closer than ``near`` or beyond ``far`` get a wrong depth. A range that is too wide only
# increases the distance between planes, and more planes fix that.

ranges = {
    "as it is": (1.4, 9.5, 32),
    "near too far": (2.5, 9.5, 32),
    "far too near": (1.4, 4.0, 32),
    "ten times too wide": (0.7, 95.0, 32),
    "ten times too wide, 75 planes": (0.7, 95.0, 75),
}
maps = {}
for name, (near, far, number) in ranges.items():
    maps[name] = sweep(images, views, sweep_planes(views, near, far, number)).depth
    print(f"{name:>30}: {near:g} to {far:g}: {100 * off_by(maps[name], 0.05):.1f} % off by more than 5 %")

figure, axes = plt.subplots(2, 3, figsize=(11.5, 5.2), layout="constrained")
axes[0, 0].imshow(images[0].permute(1, 2, 0))
axes[0, 0].set_title("the middle camera's photo")
for spacing, rates in curves.items():
    label = f"even in {'inverse ' * (spacing == 'inverse')}depth"
    axes[1, 0].semilogx(numbers, [100 * rate for rate in rates], "o-", base=2, label=label)
axes[1, 0].axvline(pixel_planes, color="gray", ls=":", label="a step is a pixel")
axes[1, 0].set(xlabel="planes", ylabel="pixels off by more than 2 %, %", ylim=(0, None))
axes[1, 0].legend(fontsize=8)
for axis, (name, found) in zip(axes[:, 1:].flat, list(maps.items())[:4], strict=True):
    shown = axis.imshow(found.clamp_min(0.1).log(), cmap="turbo_r", vmin=math.log(1.4), vmax=math.log(9.0))
    axis.set_title("{}: {:g} to {:g}".format(name, *ranges[name]))
bar = figure.colorbar(shown, ax=axes[:, 1:], shrink=0.8, label="depth")
bar.set_ticks([math.log(depth) for depth in (1.5, 2, 3, 4, 6, 8)], labels=["1.5", "2", "3", "4", "6", "8"])
for axis in (axes[0, 0], *axes[:, 1:].flat):
    axis.set(xticks=[], yticks=[])
plt.show()
