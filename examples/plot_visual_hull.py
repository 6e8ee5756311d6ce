"""
What can silhouettes never show?
================================

A silhouette excludes the space outside it. The space that no view excludes is the visual hull
:cite:p:`laurentini1994visual`. It shrinks with every view, but never to the object: a hollow that no silhouette
shows stays filled.
"""

# %%
# A cup on a foot, hollow from above. Cameras surround it, between 10 degrees below and 30 above, and each has a
# silhouette. The exact voxels of the cup, and of the same cup without the hollow, are known.

import matplotlib.pyplot as plt
import numpy as np
import torch

from lsmgeo import VoxelGrid, cameras, data, metrics, scenes
from lsmgeo.classical import extract_mesh, signed_distance, visual_hull

clay = scenes.Material((0.8, 0.55, 0.4))
body = scenes.cone((0, 0.38, 0), (0, -0.2, 0), 0.34, 0.24, clay)
foot = scenes.cylinder((0, -0.38, 0), (0, -0.15, 0), 0.12, clay)
hollow = scenes.cone((0, 0.39, 0), (0, -0.14, 0), 0.30, 0.20)
cup, full = scenes.Scene([body.minus(hollow), foot]), scenes.Scene([body, foot])

count = 24
azimuths = torch.arange(count) * 137.5 % 360  # any first few of these are well distributed
views = cameras.orbit(azimuths, torch.linspace(0, 1, count) * 40 - 10, 2.0, focal_length=280.0, height=160, width=160)
lights = scenes.Lights(torch.tensor([[0.3, 0.9, 0.3]]), torch.full((1, 3), 0.6), torch.full((3,), 0.3))
masks = scenes.render([cup], views.at(None), lights).mask[0]

grid = VoxelGrid(64)
solid, filled = (scenes.voxels([scene], grid)[0] for scene in (cup, full))

# %%
# Carving by the first few views, by strict intersection: a voxel stays if it is in all silhouettes, that is, if the
# least of its signed distances to the outlines of the silhouettes is above 0. A field of distances gives a smooth
# surface.

distances = torch.stack([signed_distance(mask) for mask in masks])
numbers = (1, 2, 3, 4, 6, 8, 12, 24)
hulls = {}
print("views  IoU with the cup  IoU with the cup filled  hollow filled")
for number in numbers:
    first = views.at(slice(number))
    hull = hulls[number] = visual_hull(distances[:number], first, grid, rule="all", threshold=0.0)
    scores = [float(metrics.voxel_iou(hull.occupancy, truth)) for truth in (solid, filled)]
    inside = float(hull.occupancy[filled & ~solid].float().mean())
    print(f"{number:5}  {scores[0]:16.3f}  {scores[1]:23.3f}  {100 * inside:11.1f} %")

# %%
# The slice through the cup's axis shows it: everything outside is carved away, the hollow stays filled. Only colours,
# as in a plane sweep, could carve it.

figure, axes = plt.subplots(2, 4, figsize=(11.5, 5.8), layout="constrained")
eye = cameras.orbit(torch.tensor([40.0]), 35.0, 2.0, focal_length=420.0, height=240, width=240)
rendering = scenes.render([cup], eye.at(None), lights, shadows=True)
axes[0, 0].imshow(rendering.images[0, 0].permute(1, 2, 0))
axes[0, 0].set_title("the cup")
axes[1, 0].imshow(masks[7], cmap="gray_r")
axes[1, 0].set_title("one of its silhouettes")
for column, number in enumerate((2, 4, 24), 1):
    surface = extract_mesh(hulls[number].support, grid, level=0.0)
    colours = np.full((len(surface.faces), 3), clay.colour, np.float32)
    shown = data.render_mesh(data.Mesh(surface.vertices.astype(np.float64), surface.faces, colours), eye, lights)
    axes[0, column].imshow(shown.images[0].permute(1, 2, 0))
    axes[0, column].set_title(f"hull of {number} views")
    middle = grid.shape[0] // 2
    axes[1, column].imshow(hulls[number].occupancy[middle], cmap="Blues", vmax=2, origin="lower")
    axes[1, column].contour(solid[middle], levels=[0.5], colors="tab:red")
    axes[1, column].set_title("its slice; the cup in red")
for axis in axes.flat:
    axis.set_axis_off()
plt.show()
