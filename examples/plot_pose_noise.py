"""
Can two degrees of pose noise be removed with photos?
=====================================================

There are five photos of an object; the first camera has a depth sensor, and defines the world. The poses of the other
four are wrong by two degrees each, like those of a cheap turntable or a phone's odometry. With wrong poses, the views
disagree about the colour of the surface. `unproject_points` measures how much, and its gradients reach the cameras.

So minimise the variance between the views. The exact answer is known, because the photos show a painted sphere in
closed form. The optimisation uses only the photos, the intrinsics, the noisy poses, and the first camera's depth.
"""

# %%
# The photos, and the noise: each camera except the first is rotated about the object by two degrees, about a random
# axis. A correction is a small motion of the world in front of a camera: a rotation vector, which kornia's ``So3.exp``
# maps to a rotation, and a shift: six numbers per camera. The noise has the same form.

import matplotlib.pyplot as plt
import torch
from analytic_scene import look_at_sphere
from kornia.filters import gaussian_blur2d
from kornia.geometry.liegroup import So3
from torch import Tensor

from lsmgeo import cameras, functional
from lsmgeo.cameras import CameraTensors


def moved(views: CameraTensors, rotations: Tensor, shifts: Tensor) -> CameraTensors:
    """Rotate the world in front of each camera (B, V) about the origin, then shift it; both are (B, V, 3)."""
    rotation = So3.exp(rotations.flatten(0, -2)).matrix().unflatten(0, rotations.shape[:-1])
    motion = torch.eye(4).repeat(*rotations.shape[:-1], 1, 1)
    motion = torch.cat((torch.cat((rotation, shifts[..., None]), -1), motion[..., 3:, :]), -2)
    return views._replace(cam_from_world=views.cam_from_world @ motion)


def pose_error(views: CameraTensors, truth: CameraTensors) -> Tensor:
    """The angle between two cameras' rotations, in degrees, (B, V)."""
    a, b = views.cam_from_world[..., :3, :3], truth.cam_from_world[..., :3, :3]
    # |A - B| = 2 sqrt(2) sin(angle / 2) is accurate for small angles, unlike the trace
    return torch.rad2deg(2 * ((a - b).flatten(-2).norm(dim=-1) / 8**0.5).asin())


def with_first_fixed(others: Tensor) -> Tensor:
    """Prepend zeros for the first camera, which is fixed."""
    return torch.cat((torch.zeros_like(others[:, :1]), others), 1)


azimuth = 90 + torch.tensor([[0.0, -15.0, -7.0, 7.0, 15.0]])
elevation = torch.tensor([[15.0, 20.0, 5.0, 25.0, 10.0]])
truth = cameras.orbit(azimuth, elevation, 1.0, focal_length=160.0, height=160, width=180)
photos, depth, _ = look_at_sphere(truth, wavelength=0.15)

generator = torch.Generator().manual_seed(0)
axes_of_noise = torch.nn.functional.normalize(torch.randn(1, 4, 3, generator=generator), dim=-1)
noise = with_first_fixed(torch.deg2rad(torch.tensor(2.0)) * axes_of_noise)
noisy = moved(truth, noise, torch.zeros_like(noise))

# %%
# The surface, from the first camera's depth: a point for each pixel with depth. Points near the object's silhouette are
# left out, because a camera that is wrong by two degrees may not see them.

centers = cameras.centers(noisy)
known = depth[:, :1].isfinite()
points = cameras.unproject_depth(noisy.at((slice(None), slice(1))), torch.where(known, depth[:, :1], 0.0))
points = torch.where(known[..., None], points, 0.0)[:, 0]
across, down = points[:, 1:-1, 2:] - points[:, 1:-1, :-2], points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
normals = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
to_cameras = torch.nn.functional.normalize(centers[:, :, None, None] - points[:, None, 1:-1, 1:-1], dim=-1)
facing = (to_cameras * normals[:, None]).sum(-1).amin(1) > 0.3
whole = -torch.nn.functional.max_pool2d(-known.float(), 3, stride=1)  # 1 where all nine neighbours have depth
facing &= whole[:, 0] == 1
surface = points[:, 1:-1, 1:-1][facing][None]
sites = surface[:, ::3]  # a third of them is enough
print(f"{sites.shape[1]} surface points")

# %%
# The optimisation, with Adam, from coarse to fine: first on blurred photos, in which two degrees are less than the
# period of the texture, then on sharp ones.

rotations = torch.zeros(1, 4, 3, requires_grad=True)
shifts = torch.zeros(1, 4, 3, requires_grad=True)
errors = [pose_error(noisy, truth)[0, 1:]]
for sigma, steps, rate in ((2.0, 40, 1e-2), (0.5, 160, 3e-2)):
    width = 2 * int(4 * sigma) + 1
    features = gaussian_blur2d(photos[0], (width, width), (sigma, sigma))[None]
    optimizer = torch.optim.Adam([rotations, shifts], lr=rate, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        estimate = moved(noisy, with_first_fixed(rotations), with_first_fixed(shifts))
        lifted = functional.unproject_points(features, estimate, sites, reduce="variance", padding_mode="border")
        optimizer.zero_grad()
        lifted.volume.mean().backward()
        optimizer.step()
        schedule.step()
        errors.append(pose_error(estimate, truth)[0, 1:].detach())
estimate = estimate._replace(cam_from_world=estimate.cam_from_world.detach())

final = pose_error(estimate, truth)[0, 1:]
print(f"pose error, largest of the four cameras: {errors[0].max():.2f} -> {final.max():.3f} degrees (exact: 0)")

# %%
# Before, the mean of the five views at the first camera's pixels is paler than the photos, because different points are
# averaged. Afterwards it is not, and the disagreement is gone. On the right, sharp photos replace blurred ones at the
# dashed line: they give all the precision.


def on_first_image(values: Tensor) -> Tensor:
    """Write values (C, N) of the surface points to the first image, (h, w, C); NaN elsewhere."""
    image = torch.full((*facing.shape[1:], len(values)), torch.nan)
    image[facing[0]] = values.T
    return image[15:-15, 25:-25]


figure, axes = plt.subplot_mosaic(
    [["before", "spread before", "curve"], ["after", "spread after", "curve"]],
    figsize=(11, 6),
    layout="constrained",
    width_ratios=(1, 1, 1.6),
)
for name, views in (("before", noisy), ("after", estimate)):
    mean, variance = functional.unproject_points(photos, views, surface, reduce=("mean", "variance")).volume[0].split(3)
    axes[name].imshow(on_first_image(mean))
    axes[name].set(title=f"mean of the views, {name}", xticks=[], yticks=[])
    shown = axes[f"spread {name}"].imshow(
        on_first_image(variance.mean(0, keepdim=True).sqrt()), cmap="magma", vmin=0, vmax=0.2
    )
    axes[f"spread {name}"].set(title=f"disagreement, {name}", xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes[f"spread {name}"], label="standard deviation")
axis = axes["curve"]
axis.semilogy(torch.stack(errors), lw=1.5)
axis.axhline(0.2, color="black", ls=":", lw=1)
axis.text(len(errors), 0.21, "0.2 degrees", ha="right")
axis.axvline(40, color="gray", ls="--", lw=1)
axis.text(70, 2.6, "sharp photos from here", color="gray", va="center")
axis.set(title="pose error of each of the four cameras", xlabel="step", ylabel="degrees", ylim=(None, 3))
plt.show()
