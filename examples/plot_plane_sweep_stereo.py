"""
How does a plane sweep find depth?
==================================

Put a plane in front of a camera, at a hypothetical depth, and project a second camera's photo onto it. Where the depth
is right, the result looks like the first camera's photo; elsewhere it does not. `lsmgeo.classical.sweep` tries many
depths and keeps, for every pixel, the one that fits best :cite:p:`collins1996space`.
"""

# %%
# Five photos of a painted ball in front of a wall. The sweep computes the depth of the first; its exact depth is that
# of the analytic scene.

import matplotlib.pyplot as plt
import torch

from lsmgeo import cameras, metrics, scenes
from lsmgeo.classical import aggregate_views, kept, matching_costs, sweep, sweep_planes

paint = scenes.Material((0.95, 0.9, 0.75), "waves", (0.15, 0.25, 0.4), frequency=18.0, seed=4)
bricks = scenes.Material((0.9, 0.55, 0.4), "waves", (0.25, 0.2, 0.2), frequency=11.0, seed=2)
scene = scenes.Scene(
    [scenes.sphere((-0.1, 0.0, 0.1), 0.33, paint), scenes.box((0.0, 0.0, -0.7), (4.0, 4.0, 0.1), bricks)]
)
azimuth, elevation = torch.tensor([90.0, 80.0, 100.0, 90.0, 90.0]), torch.tensor([0.0, 0.0, 0.0, 10.0, -10.0])
views = cameras.orbit(azimuth, elevation, 2.0, focal_length=200.0, height=120, width=160)
lights = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))  # no shading: only the paint
rendering = scenes.render([scene], views.at(None), lights)
images, truth = rendering.images[0], rendering.depth[0, 0]

# %%
# The sweep. Planes are even in inverse depth, so that a step moves the neighbours' samples about equally everywhere.

planes = sweep_planes(views, 1.3, 3.2, 128)
found = sweep(images, views, planes)
errors = metrics.depth_errors(found.depth, truth)
relative = (found.depth - truth).abs() / truth
print(f"median relative error of all pixels: {relative.median():.5f}; within 25 %: {100 * errors.delta1:.1f} %")

# %%
# The costs along one ray: that of a pixel beside the ball, which occludes this part of the wall in the left camera.
# Every neighbour has a cost at every plane, one minus the correlation of 5 x 5 patches. At the exact depth the left
# camera disagrees; the mean of the better half of the neighbours is not affected.

row, column = 60, 115
costs, visible = matching_costs(images, views, planes)
cost, _ = aggregate_views(costs, visible)
figure, axes = plt.subplots(figsize=(9, 3.6), layout="constrained")
for name, values in zip(("right", "left", "above", "below"), costs[:, :, row, column], strict=True):
    axes.plot(planes, values, lw=0.8, alpha=0.8, label=f"camera on the {name}" if name in ("left", "right") else name)
axes.plot(planes, cost[:, row, column], color="black", lw=2, label="mean of the better half")
axes.axvline(float(truth[row, column]), color="tab:red", ls="--", label="exact depth")
axes.set(title=f"the ray of pixel ({column}, {row})", xlabel="depth of the plane", ylabel="1 - correlation")
figure.legend(fontsize=8, loc="outside right upper")
plt.show()

# %%
# The confidence combines how low the winning cost is, how much higher the next minimum is, and whether neighbouring
# pixels agree. Gross errors are all at the ball's edge, where a patch contains both depths, and have low confidence.

densities = [0.5, 0.8, 0.9, 0.95, 0.98]
curve = metrics.density_curve(relative, found.confidence, densities, statistic="bad", threshold=0.02)
print(f"off by more than 2 %: {100 * (relative > 0.02).float().mean():.1f} % of all pixels")
for density, error in zip(curve.density, curve.error, strict=True):
    print(f"of the {100 * density:.0f} % of highest confidence: {100 * error:.2f} %")

figure, axes = plt.subplots(2, 3, figsize=(11, 5.8), layout="constrained")
axes[0, 0].imshow(images[0].permute(1, 2, 0))
axes[0, 0].plot(column, row, "rx")
axes[0, 0].set_title("the photo and that pixel")
shown = axes[0, 1].imshow(truth, cmap="turbo_r", vmin=1.5, vmax=2.7)
axes[0, 1].set_title("exact depth")
axes[0, 2].imshow(found.depth, cmap="turbo_r", vmin=1.5, vmax=2.7)
axes[0, 2].set_title("estimated depth")
figure.colorbar(shown, ax=axes[0, 1:])
shown = axes[1, 0].imshow(found.confidence, cmap="gray", vmin=0, vmax=1)
axes[1, 0].set_title("confidence")
figure.colorbar(shown, ax=axes[1, 0])
shown = axes[1, 1].imshow(relative, cmap="magma", vmin=0, vmax=0.01)
axes[1, 1].set_title("relative error")
figure.colorbar(shown, ax=axes[1, 1], extend="max")
axes[1, 2].imshow(torch.where(kept(found, 0.9), found.depth, torch.nan), cmap="turbo_r", vmin=1.5, vmax=2.7)
axes[1, 2].set_title("the 90 % of highest confidence")
for axis in axes.flat:
    axis.set(xticks=[], yticks=[])
plt.show()
