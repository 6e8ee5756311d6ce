"""
What does one image say about a volume?
=======================================

Only this: everything along the ray of a pixel may have the colour of that pixel. `Unproject` expresses this with a
grid: every voxel is projected into the image, and takes the colour there.

The image shows a painted sphere, whose colour is known in closed form. So there is an exact answer at the surface: a
point of the sphere that the camera sees must receive the colour of the paint at that point.
"""

# %%
# One camera at distance 2, an image of 120 x 160 pixels, and a grid of 96^3 voxels about the sphere.
# ``augment="depth"`` appends the depth of each voxel in that camera as a further channel.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere, paint

from lsmgeo import Unproject, VoxelGrid, cameras, functional

views = cameras.orbit(torch.tensor([[90.0]]), 0.0, 2.0, focal_length=250.0, height=120, width=160)
rendering = look_at_sphere(views, radius=0.4)

grid = VoxelGrid(96)
volume, visible = Unproject(grid, augment="depth")(rendering.image, views)
print("volume", tuple(volume.shape), "visible", tuple(visible.shape))

# %%
# The number: the unprojected colours of visible points of the sphere, compared with their paint. The difference is the
# error of bilinear interpolation. Points at grazing rays are left out, where a pixel mixes sphere and background.

origins = cameras.centers(views)
normals = torch.nn.functional.normalize(torch.randn(1, 20_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
points = 0.4 * normals
to_camera = torch.nn.functional.normalize(origins - points, dim=-1)
points = points[(to_camera * normals).sum(-1) > 0.3][None]

colors = functional.unproject_points(rendering.image, views, points).volume[0, 0].T
expected = paint(points[0])
error = (colors - expected).abs().mean()
print(f"mean colour error at {points.shape[1]} surface points: {error:.4f} (exact: 0, colours lie in [0, 1])")

# %%
# The image, and the horizontal slice of the volume through the sphere's centre, from above. The colours extend along
# the rays of the camera through the whole volume; the true surface is the circle. One view cannot determine where on a
# ray the surface is. That takes a second one: :doc:`/auto_examples/plot_two_views_agreeing`.

figure, axes = plt.subplots(1, 3, figsize=(11, 3.7), layout="constrained")
axes[0].imshow(rendering.image[0, 0].movedim(0, -1))
axes[0].set(title="the image", xticks=[], yticks=[])
middle = volume[0, 0, :, :, 48]  # (C, z, x) at y = 0
in_image = visible[0, 0, :, 48]
box = {"origin": "lower", "extent": (-0.5, 0.5, -0.5, 0.5)}
axes[1].imshow(torch.where(in_image, volume[0, 0, :3, :, 48], 1.0).movedim(0, -1), **box)
axes[1].set_title("colour of each voxel, seen from above", pad=26)
shown = axes[2].imshow(torch.where(in_image, volume[0, 0, 3, :, 48], torch.nan), cmap="viridis", **box)
axes[2].set_title('its depth (augment="depth")', pad=26)
figure.colorbar(shown, ax=axes[2], label="depth")
for axis in axes[1:]:
    axis.add_patch(plt.Circle((0, 0), 0.4, fill=False, color="black", lw=2))
    axis.set(xlabel="x", ylabel="z")
    axis.annotate("to the camera", (0, 0.57), (0.04, 0.525), annotation_clip=False)
    axis.annotate("", (0, 0.6), (0, 0.5), annotation_clip=False, arrowprops={"arrowstyle": "->"})
plt.show()
