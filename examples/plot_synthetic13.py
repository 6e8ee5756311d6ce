"""
How different are the shapes of a synthetic set?
================================================

A network learns little from synthetic shapes if all shapes of a category are nearly the same. Synthetic-13 generates
thirteen categories from parameters: a few discrete choices (legs or a pedestal, slats or a solid back) and many
continuous ones. Every shape is an analytic scene, so its images, depth and occupancy are exact.
"""

# %%
# A shape is a function of a seed and an index; its name, choices and numbers are part of the result.

import matplotlib.pyplot as plt
import numpy as np
import torch

from lsmgeo import cameras, scenes
from lsmgeo.scenes import synthetic13

shape = synthetic13.shape(seed=0, index=17)
print(shape.name, shape.structure)
print({name: round(value, 3) for name, value in list(shape.parameters.items())[:4]})

# %%
# The number: the intersection over union of the 32^3 occupancies of two shapes of one category, averaged over pairs and
# categories. 1 would mean that all shapes are equal. Cars are the most similar, as in reality.

found = {category: synthetic13.measure(category, count=12).iou for category in synthetic13.CATEGORIES}
overlap = float(np.mean(list(found.values())))
print(f"mean IoU of two shapes of a category: {overlap:.2f}, of cars {found['car']:.2f}")

# %%
# Six shapes of each category, one category per column, one viewpoint per row.

COUNT, SIZE = 6, 112
rows = []
for row in range(COUNT):
    shown = [synthetic13.shape(0, 13 * row + column) for column in range(13)]
    azimuth = torch.tensor([40.0, -35.0, 60.0, 25.0, -50.0, 35.0], dtype=torch.float64)[row].expand(1, 1)
    view = cameras.orbit(azimuth, 18.0, 2.0, focal_length=1.875 * SIZE, height=SIZE, width=SIZE)
    images = [scenes.render([item.scene], view, item.lights).images[0, 0] for item in shown]
    rows.append(torch.cat(images, -1))
sheet = torch.cat(rows, -2).permute(1, 2, 0)

figure, axes = plt.subplots(figsize=(13, 6.3), layout="constrained")
axes.imshow(sheet)
axes.set_xticks((np.arange(13) + 0.5) * SIZE, synthetic13.CATEGORIES, rotation=30)
axes.set_yticks([])
axes.spines[:].set_visible(False)
axes.tick_params(length=0)
plt.show()
