"""
How do cameras on a car see the street from above?
==================================================

Six cameras look around from the roof of a car. A map of the street from above needs to know where along its ray each
pixel belongs. Lifting does not know: every voxel takes what the cameras see there, so a car colours its whole ray.
Splatting puts each pixel where its depth is likely.
"""

# %%
# The scene is analytic, so images, depth and the outlines of the cars are exact. The features of a pixel are its
# colour and whether it shows a car, which a network would have to learn.

import matplotlib.pyplot as plt
import numpy as np
import torch
from street_scene import CAR, CARS, SKY, SUN, from_above, rig, street, vehicles

from lsmgeo import Splat, Unproject, VoxelGrid, depth_planes, metrics, scenes

size, cell = (128, 224), 0.25
views = rig(*size)
seen = scenes.render([street()], views, SUN, background=SKY, shadows=True)
alone = scenes.render([vehicles()], views, SUN)
shows_car = alone.mask & ((alone.depth - seen.depth).abs() < 1e-3)
features = torch.cat((seen.images, shows_car[:, :, None]), 2)  # (1, 6, 4, 128, 224)

lower, upper = (-18.0, -11.0), (18.0, 11.0)
rows, columns = (round((high - low) / cell) for low, high in zip(lower[::-1], upper[::-1], strict=True))
at_body = VoxelGrid((1, rows, columns), (*lower, 0.4), (*upper, 0.6))
truth = scenes.voxels([vehicles()], at_body)[0, 0]  # (rows, columns)

# %%
# Lifting: the mean over the views that see a voxel, and over the 1.6 m from the road to the roof of a car.

low = VoxelGrid((8, rows, columns), (*lower, 0.0), (*upper, 1.6))
volume, visible = Unproject(low, reduce="mean", padding_mode="border")(features, views)
voxels_seen = visible[0].any(0).sum(0)  # of the eight at each place
lifted = torch.where(voxels_seen > 0, volume[0].sum(1) / voxels_seen, torch.nan)  # (4, rows, columns)

# %%
# Splatting :cite:p:`philion2020lift`: each pixel is added to the cells along its ray with the probability of each
# depth, here a normal distribution about the true depth. The ones appended to the features count what a cell received.

depths = depth_planes(1.0, 25.0, 97)
splat = Splat(VoxelGrid((1, rows, columns), (*lower, -1.0), (*upper, 4.0)), depths)
counted = torch.cat((features, torch.ones_like(features[:, :, :1])), 2)


def splatted(deviation: float) -> torch.Tensor:
    """The mean of the features in each cell, (4, rows, columns), for depths known to a standard deviation in metres."""
    away = (depths[:, None, None] - seen.depth[:, :, None]) / deviation  # (1, 6, 97, 128, 224)
    weights = torch.softmax(-0.5 * away.square(), 2) * seen.mask[:, :, None]
    sums = splat(counted, views, weights=weights)[0, :, 0]
    return torch.where(sums[4] > 0.5, sums[:4] / sums[4], torch.nan)


sharp = splatted(0.25)

# %%
# The number: the cells that are more than half car, against the cars' true outlines. Lifted, the cars reach to the edge
# of the map. Splatted, they stay where they are, and what is missing is mostly what no camera sees. With a threshold
# chosen to suit it, lifting comes close: cars are where cells show car at all heights, as in a visual hull. That takes
# features that tell cars from all else; it does not help the colours.


def overlap(values: torch.Tensor, threshold: float = 0.5) -> float:
    return float(metrics.voxel_iou((values > threshold)[None], truth[None]))


scores = {"lifted": overlap(lifted[3]), "splatted": overlap(sharp[3])}
near = torch.nn.functional.max_pool2d(truth[None].float(), 3, 1, 1)[0] > 0  # a car, or a cell next to one
for name, values in zip(scores, (lifted[3], sharp[3]), strict=True):
    wrong = ((values > 0.5) & ~near).sum() / (values > 0.5).sum()
    best = max(overlap(values, step / 100) for step in range(100))
    print(f"{name}: IoU {scores[name]:.2f} (best threshold: {best:.2f}), {100 * wrong:.0f} % of the cells off the cars")
missing = truth & ~(sharp[3] > 0.5)
hidden = float(sharp[3][missing].isnan().float().mean())
print(f"of the cells that splatting misses, {100 * hidden:.0f} % are hidden from all cameras")

deviations = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0]
overlaps = [overlap(splatted(deviation)[3]) for deviation in deviations]

# %%
# At the top, what the six cameras see. Below, the street from straight above, the lifted and the splatted colours;
# white is where nothing lands. At the bottom, how much of a car each cell is, with the cars' true outlines. The curve
# shows what depth is worth: a standard deviation of 0.5 m costs little, and with one of 8 m splatting is no better than
# lifting.

plan = scenes.render([street()], from_above(352, 576, upper[0] - lower[0]), SUN, shadows=True).images
turn = np.deg2rad([heading for *_, heading in CARS])
ahead, left = np.stack((np.cos(turn), np.sin(turn)), -1), np.stack((-np.sin(turn), np.cos(turn)), -1)
corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * CAR / 2
outlines = np.array(list(CARS))[:, None, :2] + corners[:, :1] * ahead[:, None] + corners[:, 1:] * left[:, None]

figure = plt.figure(figsize=(12, 7), layout="constrained")
photos, maps = figure.subfigures(2, 1, height_ratios=(1, 3.9))
names = {2: "back left", 1: "front left", 0: "front", 5: "front right", 4: "back right", 3: "back"}
for axis, (view, name) in zip(photos.subplots(1, 6), names.items(), strict=True):
    axis.imshow(seen.images[0, view].permute(1, 2, 0))
    axis.set_title(name, fontsize="medium")
    axis.set_axis_off()
axes = maps.subplots(2, 3)
pictures = [
    ("the street; in black the car with the cameras", plan[0, 0].flip(1).permute(1, 2, 0), {}),
    ("lifted", lifted[:3].nan_to_num(1.0).permute(1, 2, 0), {}),
    ("splatted, the depth known to 0.25 m", sharp[:3].nan_to_num(1.0).permute(1, 2, 0), {}),
]
for (name, score), values in zip(scores.items(), (lifted[3], sharp[3]), strict=True):
    pictures.append((f"cars, {name}: IoU {score:.2f}", values, {"cmap": "OrRd", "vmin": 0, "vmax": 1}))
for axis, (title, image, options) in zip((*axes[0], *axes[1, 1:]), pictures, strict=True):
    axis.imshow(image, origin="lower", extent=(lower[0], upper[0], lower[1], upper[1]), **options)
    for outline in outlines if options else ():
        axis.add_patch(plt.Polygon(outline, fill=False, ec="tab:blue", lw=1.5))
    axis.add_patch(plt.Polygon(corners, fc="black", ec="white"))
    axis.set(title=title, xticks=[], yticks=[])
axes[1, 0].semilogx(deviations, overlaps, "o-", color="tab:red", label="splatted")
axes[1, 0].axhline(scores["lifted"], color="tab:gray", ls="--", label="lifted")
axes[1, 0].set_xticks(deviations, [f"{value:g}" for value in deviations])
axes[1, 0].minorticks_off()
axes[1, 0].set(xlabel="standard deviation of the depth, m", ylabel="IoU of the cars", ylim=(0, None))
axes[1, 0].set_box_aspect(rows / columns)
axes[1, 0].legend()
plt.show()
