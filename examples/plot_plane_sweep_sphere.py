"""
What is the depth of a solid in a camera?
=========================================

`PlaneSweepProject` intersects the rays of a camera with planes of constant depth and samples a volume there. Along each
ray, the camera sees the first point at which the volume becomes solid. Here the volume is a ball, so the exact depth of
each pixel is known.
"""

# %%
# The volume is the occupancy of 64^3 voxels: 1 inside, 0 outside, with a ramp of two voxels between, 1/2 on the
# surface. The sweep has 96 planes between depth 1.4 and 2.2, for maps of 90 x 120 pixels. The cameras' own images are
# four times as wide and high; the intrinsics are not changed by hand.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere

from lsmgeo import PlaneSweepProject, VoxelGrid, cameras, depth_planes, rays

radius, size = 0.4, (90, 120)
grid = VoxelGrid(64)
views = cameras.orbit(torch.tensor([[60.0, 100.0]]), 20.0, 2.0, focal_length=800.0, height=360, width=480)
solid = (0.5 + (radius - grid.centers().norm(dim=-1)) * 32).clamp(0, 1)[None, None]  # (B, C, D, H, W)

depths = depth_planes(1.4, 2.2, 96)
project = PlaneSweepProject(grid, depths, size=size, flatten=False)
maps, visible = project(solid, views)
print("maps", tuple(maps.shape), "visible", tuple(visible.shape))

# %%
# Front to back: the first plane with a value above 1/2, and between it and the previous plane, the point where the
# linear ramp is 1/2. Grazing rays may stay below 1/2 between voxels; only rays that enter the ball at an angle of at
# least about 15 degrees to its surface are compared.

values = maps[:, :, 0]  # (B, V, P, h, w)
after = (values > 0.5).int().argmax(2, keepdim=True).clamp_min(1)  # first plane inside
outside, inside = values.gather(2, after - 1), values.gather(2, after)
step = (0.5 - outside) / torch.where(inside > outside, inside - outside, 1.0)
depth = (depths[after - 1] + step * (depths[after] - depths[after - 1]))[:, :, 0]

exact = look_at_sphere(cameras.resize(views, *size), radius=radius)
_, directions = cameras.rays(views, size)
entering = -(directions * torch.nn.functional.normalize(exact.points, dim=-1)).sum(-1)
surface = exact.depth.isfinite() & (entering > 0.25)
error = torch.where(surface, (depth - exact.depth).abs(), torch.nan)
spacing = float(depths[1] - depths[0])
print(f"planes are {spacing:.5f} apart")
print(f"depth error: median {error.nanmedian():.5f}, largest {error[surface].max():.5f} (exact: 0)")

# %%
# The values of the sweep along one row of pixels, with planes upwards. The exact depth of the row is on the edge of the
# solid. Beside it, the measured depth and its error.

figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.5), layout="constrained")
axes[0].imshow(
    values[0, 0, :, 45], origin="lower", aspect="auto", cmap="Blues", extent=(-0.5, 119.5, depths[0], depths[-1])
)
axes[0].plot(exact.depth[0, 0, 45], color="tab:red", ls="--", label="exact depth of the first hit")
axes[0].set(title="the sweep, row 45", xlabel="pixel", ylabel="depth")
axes[0].legend(loc="lower left")
shown = axes[1].imshow(torch.where(surface, depth, torch.nan)[0, 0], cmap="viridis")
axes[1].set(title="measured depth", xticks=[], yticks=[])
figure.colorbar(shown, ax=axes[1])
shown = axes[2].imshow(error[0, 0] / spacing, cmap="magma", vmin=0)
axes[2].set(title="error, in plane spacings", xticks=[], yticks=[])
figure.colorbar(shown, ax=axes[2])
plt.show()

# %%
# :mod:`lsmgeo.rays` has the differentiable forms of the last step: `composite` for opacities, `expected_depth` for
# scores.

composited = rays.composite(values, values[:, :, None], depths, visible)
mean_depth = composited.depth / (1 - composited.transmittance)
print(f"composited depth, median error: {(mean_depth - exact.depth)[surface].abs().median():.5f}")
