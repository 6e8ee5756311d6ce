"""
Are these cameras right?
========================

A folder of photos has 4 x 4 matrices that are said to be world-to-camera. The matrices cannot confirm it, because their
inverses are equally valid poses. The photos can.
"""

# %%
# Six renderings replace the photos. Their cameras are known, and are inverted here: the most common error of all.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from lsmgeo import cameras, data, diagnosis, scenes


def paint(first, second, frequency):
    return scenes.Material(first, texture="waves", second=second, frequency=frequency)


scene = scenes.Scene(
    [
        scenes.half_space((0.0, -0.45, 0.0), (0.0, 1.0, 0.0), paint((0.9, 0.88, 0.8), (0.25, 0.3, 0.35), 6.0)),
        scenes.box((0.85, -0.2, 0.6), (0.5, 0.5, 0.4), paint((0.75, 0.8, 0.85), (0.15, 0.25, 0.45), 9.0)),
        scenes.sphere((1.35, -0.2, 0.2), 0.25, paint((0.95, 0.8, 0.6), (0.5, 0.2, 0.1), 11.0)),
    ]
)
sun = scenes.Lights(torch.tensor([[0.4, 1.0, 0.5]]), torch.full((1, 3), 0.6), torch.full((3,), 0.4))
middle = (1.0, 0.0, 0.5)
azimuths = torch.linspace(0.0, 60.0, 6, dtype=torch.float64)
views = cameras.orbit(azimuths, 28.0, 2.2, focal_length=330.0, height=240, width=320, target=middle)
rendering = scenes.render([scene], cameras.stack([views]), sun)

scratch = tempfile.TemporaryDirectory()
folder = Path(scratch.name)
paths = [folder / f"{view}.png" for view in range(len(rendering.images[0]))]
for path, image in zip(paths, rendering.images[0], strict=True):
    plt.imsave(path, image.movedim(0, -1).numpy())
names = tuple(path.name for path in paths)

inverted = views._replace(cam_from_world=torch.linalg.inv(views.cam_from_world))
photos = data.PosedImages(names, tuple(paths), inverted, None, "drawn")

# %%
# Features are matched without the cameras, and then compared with them: what is the distance of a feature from the
# epipolar line of its match? If it is too large, every common error is corrected in turn, and everything is measured
# again. ``lsmgeo info`` prints this for any scene.

findings = diagnosis.examine(photos, folder)
for check in findings.checks:
    state = "ok" if check.passed else "FAILED"
    print(
        f"{check.name}: {check.value:.3g} {check.unit}, limit {check.limit:.3g}: {state} ({check.measured} {check.of})"
    )
print(f"verdict: {findings.verdict}, {findings.cause.name}")
print(f"because: {findings.cause.evidence}")

# %%
# The correction is one line, and the same examination confirms it.

corrected = inverted._replace(cam_from_world=torch.linalg.inv(inverted.cam_from_world))
after = diagnosis.examine(data.PosedImages(names, tuple(paths), corrected, None, "drawn"), folder)
print(
    f"epipolar error: {findings.checks[0].value:.1f} px before, {after.checks[0].value:.3f} px after ({after.verdict})"
)

# %%
# The cameras from above; the cross is the point they look at. Inverted, the cameras of a ring are closer together and
# elsewhere.

figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained", width_ratios=(1.3, 1, 1))
axes[0].imshow(rendering.images[0, 2].movedim(0, -1))
axes[0].set_title("one of six photos")
axes[0].axis("off")
for axis, shown, title in ((axes[1], inverted, "cameras as given"), (axes[2], corrected, "corrected")):
    world_from_cam = torch.linalg.inv(shown.cam_from_world)
    x, _, z = world_from_cam[:, :3, 3].unbind(-1)
    ahead = world_from_cam[:, :3, 2]
    axis.quiver(x, z, ahead[:, 0], ahead[:, 2], torch.arange(6), cmap="viridis", angles="xy", scale=3.0, width=0.012)
    axis.plot(middle[0], middle[2], "+", color="black", markersize=12)
    axis.set(xlim=(-2.6, 3.6), ylim=(-2.6, 3.6), xlabel="x", ylabel="z", title=title)
    axis.set_aspect("equal")
plt.show()
scratch.cleanup()
