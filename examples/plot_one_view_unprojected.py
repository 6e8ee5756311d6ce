"""
What does one picture say about a volume?
=========================================

Only this: along the ray of each pixel, everything has that pixel's colour, for all that one can know. `Unproject`
says it with a grid. Every voxel is projected into the picture, and takes the colour that it meets there.

The picture is that of a painted sphere, whose colour at each place in space is known in closed form. So there is an
exact answer where the surface is: a point of the sphere that the camera sees must receive the paint that is there.
"""

# %%
# One camera at distance 2, a picture of 120 x 160 pixels, and a grid of 96^3 voxels about the sphere.
# ``augment="depth"`` appends the depth of each voxel in that camera as a further channel.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere, paint

from lsmgeo import Unproject, VoxelGrid, cameras, functional

views = cameras.orbit(torch.tensor([[90.0]]), 0.0, 2.0, focal_length=250.0, height=120, width=160)
picture = look_at_sphere(views, radius=0.4)

grid = VoxelGrid(96)
volume, visible = Unproject(grid, augment="depth")(picture.image, views)
print("volume", tuple(volume.shape), "visible", tuple(visible.shape))

# %%
# The number: the sphere's points that the camera sees, unprojected, against their paint. What is left is the error of
# bilinear interpolation. Rays that graze the sphere are left out, because there a pixel mixes sphere and background.

origins = cameras.centers(views)
normals = torch.nn.functional.normalize(torch.randn(1, 20_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
points = 0.4 * normals
to_camera = torch.nn.functional.normalize(origins - points, dim=-1)
points = points[(to_camera * normals).sum(-1) > 0.3][None]

colors = functional.unproject_points(picture.image, views, points).volume[0, 0].T
expected = paint(points[0])
error = (colors - expected).abs().mean()
print(f"mean colour error at {points.shape[1]} surface points: {error:.4f} (exact: 0, colours lie in [0, 1])")

# %%
# The picture, and the horizontal slice of the volume through the sphere's centre, from above. The colours run
# straight from the camera through everything; the true surface is the circle. One view cannot tell that the colours
# belong there and nowhere else. That takes a second one: :doc:`/auto_examples/plot_two_views_agreeing`.

figure, axes = plt.subplots(1, 3, figsize=(11, 3.7), layout="constrained")
axes[0].imshow(picture.image[0, 0].movedim(0, -1))
axes[0].set(title="the picture", xticks=[], yticks=[])
middle = volume[0, 0, :, :, 48]  # (C, z, x) at y = 0
seen = visible[0, 0, :, 48]
box = {"origin": "lower", "extent": (-0.5, 0.5, -0.5, 0.5)}
axes[1].imshow(torch.where(seen, volume[0, 0, :3, :, 48], 1.0).movedim(0, -1), **box)
axes[1].set_title("colour of each voxel, seen from above", pad=26)
shown = axes[2].imshow(torch.where(seen, volume[0, 0, 3, :, 48], torch.nan), cmap="viridis", **box)
axes[2].set_title('its depth (augment="depth")', pad=26)
figure.colorbar(shown, ax=axes[2], label="depth")
for axis in axes[1:]:
    axis.add_patch(plt.Circle((0, 0), 0.4, fill=False, color="black", lw=2))
    axis.set(xlabel="x", ylabel="z")
    axis.annotate("to the camera", (0, 0.57), (0.04, 0.525), annotation_clip=False)
    axis.annotate("", (0, 0.6), (0, 0.5), annotation_clip=False, arrowprops={"arrowstyle": "->"})
plt.show()
