"""
What does the half-pixel error cost?
====================================

A network's feature map is smaller than its image, by a stride of 8, say. The intrinsics must be resized, and the usual
line is ``K[:2] = K[:2] / 8``. It keeps the centre of the first pixel in place. But what stays in place is the *border*
of the image, half a pixel further out, in both sizes.

With integer pixel centres the correct principal point is :math:`(c + 1/2)/s - 1/2`, not :math:`c/s`. For a stride
:math:`s` the two differ by exactly :math:`(s - 1)/2` pixels of the image: 3.5 at stride 8.
"""

# %%
# To measure it, take an image whose value *is* its column number. The value of a point in space is then the column that
# was sampled. The operator receives the cameras of the full image and resizes for the smaller map itself. The error is
# made by hand.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere

from lsmgeo import cameras, functional

stride, height, width = 8, 192, 256
views = cameras.orbit(torch.tensor([[90.0]]), 10.0, 2.0, focal_length=400.0, height=height, width=width)

by_hand = views.intrinsics.clone()
by_hand[..., :2, :] /= stride
wrong_views = views._replace(intrinsics=by_hand, height=height // stride, width=width // stride)

columns = torch.arange(width, dtype=torch.float32).expand(1, 1, 1, height, width)
feature_map = torch.nn.functional.avg_pool2d(columns[0], stride)[None]

points = 0.5 * torch.rand(1, 1000, 3, generator=torch.Generator().manual_seed(0)) - 0.25
expected = functional.unproject_points(columns, views, points).volume
right = functional.unproject_points(feature_map, views, points).volume - expected
wrong = functional.unproject_points(feature_map, wrong_views, points).volume - expected
print(f"pixels off: by the rule {right.abs().max():.4f} (exact: 0), by hand {wrong.mean():.4f} (exact: 3.5)")

# %%
# The same on a painted sphere. Its surface is coloured from a feature map of stride 8, with the correct and with the
# wrong camera, and compared with the true colours. Half a pixel of the *small* map is small in its own units, and large
# in those of the image. A test that projects and unprojects with the same camera cannot detect it.

rendering = look_at_sphere(views, wavelength=0.4)
small = torch.nn.functional.avg_pool2d(rendering.image[0], stride)[None]
origins, directions = cameras.rays(views)
facing = -(directions * torch.nn.functional.normalize(rendering.points, dim=-1)).sum(-1)[0, 0]
# At the silhouette, a cell of the map mixes sphere and background.
hit = rendering.depth[0, 0].isfinite() & (facing > 0.5)
surface = rendering.points[0, 0][hit][None]
truth = rendering.image[0, 0][:, hit]

figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
axes[0].imshow(rendering.image[0, 0].movedim(0, -1))
axes[0].set_title("the sphere")
for axis, chosen, title in (
    (axes[1], views, "colour error, correct camera"),
    (axes[2], wrong_views, "colour error, K[:2] / 8"),
):
    colors = functional.unproject_points(small, chosen, surface, padding_mode="border").volume[0, 0]
    error = torch.full((height, width), torch.nan)
    error[hit] = (colors - truth).abs().mean(0)
    shown = axis.imshow(error, cmap="inferno", vmin=0, vmax=0.15)
    axis.set_title(f"{title}: mean {error[hit].mean():.3f}")
figure.colorbar(shown, ax=axes[1:], label="mean absolute difference")
for axis in axes:
    axis.set(xticks=[], yticks=[], xlim=(40, 216))
plt.show()
