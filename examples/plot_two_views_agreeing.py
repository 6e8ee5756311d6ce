"""
Where do two views agree?
=========================

A point on the surface has the same colour in all views; at a point in front of it or behind it, each view sees a
different part of the surface. So the variance between views is small at the surface: the idea of multi-view stereo.

Two cameras, 30 degrees apart, look at a painted sphere of radius 0.4. The exact answer is 0.4.
"""

# %%
# Both views are unprojected and reduced in one pass: ``reduce="variance"`` never holds the volumes of the views. With
# ``padding_mode="border"`` colours do not fade at the edge of an image.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere

from lsmgeo import Unproject, VoxelGrid, cameras, functional

views = cameras.orbit(torch.tensor([[75.0, 105.0]]), 0.0, 2.0, focal_length=280.0, height=128, width=160)
rendering = look_at_sphere(views, radius=0.4)

unproject = Unproject(VoxelGrid(128), reduce="variance", padding_mode="border")
variance, visible = unproject(rendering.image, views)
print("variance", tuple(variance.shape))

# %%
# The number: along a thousand directions from the sphere's centre that both cameras see, the radius at which the two
# views agree best.

generator = torch.Generator().manual_seed(0)
directions = torch.tensor([0.0, 0.0, 1.0]) + 0.35 * torch.randn(1000, 3, generator=generator)
directions = torch.nn.functional.normalize(directions, dim=-1)
radii = torch.linspace(0.3, 0.5, 201)
points = (radii[:, None] * directions[:, None]).reshape(1, -1, 3)
cost = functional.unproject_points(rendering.image, views, points, reduce="variance", padding_mode="border").volume
cost = cost.sum(1).reshape(1000, 201)
best = radii[cost.argmin(1)]
print(f"radius of best agreement: median {best.median():.4f} (exact: 0.4000)")

# %%
# On the left, the horizontal slice through the centre, from above: dark where the views agree. The dark arc is the part
# of the sphere that both cameras see. Beside the sphere both see background and agree too: agreement does not imply a
# surface. On the right, the disagreement along the thousand directions.

figure, axes = plt.subplots(1, 2, figsize=(10.5, 4.4), layout="constrained")
deviation = variance[0, :, :, 64].sum(0).sqrt()  # (z, x) at y = 0
shown = axes[0].imshow(deviation, origin="lower", extent=(-0.5, 0.5, -0.5, 0.5), cmap="magma", vmax=0.5)
figure.colorbar(shown, ax=axes[0], label="standard deviation between the two views")
axes[0].add_patch(plt.Circle((0, 0), 0.4, fill=False, color="white", ls=":", lw=1.5))
centers = cameras.centers(views)
for x, _, z in centers[0].tolist():
    axes[0].annotate(
        "", (0.25 * x, 0.25 * z), (0.2 * x, 0.2 * z), arrowprops={"arrowstyle": "->", "color": "cyan", "lw": 2}
    )
axes[0].set(title="slice from above; dotted: the sphere, cyan: to the cameras", xlabel="x", ylabel="z")
axes[1].plot(
    radii, cost.sqrt().quantile(0.25, dim=0), color="tab:purple", lw=1, ls="--", label="a quarter of them below"
)
axes[1].plot(radii, cost.sqrt().median(dim=0).values, color="tab:purple", label="median of 1000 directions")
axes[1].axvline(0.4, color="black", ls=":", label="the sphere")
axes[1].set(xlabel="distance from the centre", ylabel="standard deviation", ylim=(0, None))
axes[1].legend()
plt.show()
