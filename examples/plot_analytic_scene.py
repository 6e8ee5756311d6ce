"""
How exact is an analytic scene?
===============================

Tests, figures and training data need images whose depth, normals and silhouettes are *known*, not measured. A scene of
solids has them in closed form: every ray intersects a primitive in one interval, the pixel shows the interval that
starts first, and a subtracted primitive moves the start to its own end.
"""

# %%
# A union of solids; one has a hole, another is cut by a plane. Surfaces have one colour, or a solid texture.

import matplotlib.pyplot as plt
import torch

from lsmgeo import cameras, scenes

clay = scenes.Material((0.85, 0.55, 0.4))
tiles = scenes.Material((0.9, 0.9, 0.85), "checker", (0.5, 0.6, 0.7), frequency=2.5, seed=3)
marble = scenes.Material((0.95, 0.95, 0.9), "waves", (0.3, 0.4, 0.55), frequency=5.0)

block = scenes.box((-0.35, 0.0, 0.15), (0.3, 0.5, 0.4), clay).rotated(1, 20, center=(-0.35, 0, 0.15))
tunnel = scenes.cylinder((-1, 0.05, 0.15), (1, 0.05, 0.15), 0.13).rotated(1, 20, center=(-0.35, 0, 0.15))
bowl = scenes.sphere((0.05, -0.05, -0.3), 0.2, scenes.Material((0.35, 0.6, 0.5)))
scene = scenes.Scene(
    [
        scenes.half_space((0, -0.25, 0), (0, 1, 0), tiles),
        block.minus(tunnel),
        scenes.sphere((0.2, -0.02, 0.15), 0.23, marble),
        bowl.minus(scenes.half_space((0, 0, 0), (0, -1, 0)), scenes.sphere((0.05, 0.05, -0.3), 0.17)),
        scenes.cone((0.45, -0.25, -0.25), (0.45, 0.2, -0.25), 0.14, 0.03, clay),
    ]
)
view = cameras.orbit(torch.tensor([[35.0]], dtype=torch.float64), 28.0, 2.0, focal_length=600.0, height=300, width=400)
sun = torch.nn.functional.normalize(torch.tensor([[0.3, 1.0, -0.5]]), dim=-1)
lights = scenes.Lights(sun, torch.full((1, 3), 0.65), torch.full((3,), 0.3))
rendering = scenes.render([scene], view, lights, shadows=True)

# %%
# The number: every pixel of the ball is unprojected to its depth, and the distance of that point from the ball's
# surface is measured, in float32 and in float64.

for dtype in (torch.float32, torch.float64):
    exact = scenes.render([scene], view, lights, dtype=dtype)
    points = cameras.unproject_depth(view, exact.depth.double())[0, 0]
    away = (points - torch.tensor([0.2, -0.02, 0.15], dtype=torch.float64)).norm(dim=-1) - 0.23
    on_ball = exact.mask[0, 0] & (away.abs() < 1e-3)
    worst = float(away[on_ball].abs().max())
    print(f"{dtype}: {int(on_ball.sum())} pixels on the ball, at most {worst:.1e} from its surface")

# %%
# One call returns all of these. Occupancy, bottom right, is computed for any points, here for those of an upright
# slice.

y, x = torch.meshgrid(torch.linspace(0.4, -0.4, 240), torch.linspace(-0.7, 0.7, 420), indexing="ij")
slice_points = torch.stack((x, y, torch.full_like(x, 0.15)), -1)
inside = scenes.occupancy([scene], slice_points[None])[0]

figure, axes = plt.subplots(2, 2, figsize=(10, 7.4), layout="constrained")
axes[0, 0].imshow(rendering.images[0, 0].permute(1, 2, 0))
axes[0, 0].set_title("colour, with shadows")
depth = torch.where(rendering.mask, rendering.depth, torch.nan)[0, 0]
shown = axes[0, 1].imshow(depth, cmap="viridis", vmax=3.5)
axes[0, 1].set_title("depth: camera z")
figure.colorbar(shown, ax=axes[0, 1], shrink=0.8, label="world units", extend="max")
axes[1, 0].imshow(0.5 + 0.5 * rendering.normals[0, 0].permute(1, 2, 0))
axes[1, 0].set_title("normals, world frame, as colours")
axes[1, 1].imshow(inside, extent=(-0.7, 0.7, -0.4, 0.4), cmap="gray_r", interpolation="nearest")
axes[1, 1].set(title="occupancy in the slice z = 0.15", xlabel="x", ylabel="y")
for axis in axes.flat[:3]:
    axis.set_axis_off()
plt.show()
