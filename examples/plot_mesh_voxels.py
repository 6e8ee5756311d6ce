"""
What is solid in a mesh with holes?
===================================

Modelled meshes are seldom closed: hidden faces are missing, parts overlap, sheets have no thickness. Yet a network that
learns shape needs voxels that are solid or empty. A line through a hole gives a wrong answer; but its number of
crossings is odd, so it is *known* to be wrong. It abstains, and lines in twelve other directions vote.

The fork lift is by TheGIWI, in the public domain (CC0), from Blend Swap.
"""

# %%
# The mesh, with its box centred and its diagonal scaled to 1 as in ShapeNet, and three images of one call: colour with
# shadows, depth, and normals.

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from lsmgeo import cameras, data, scenes

folder = Path.cwd() / "meshes" if (Path.cwd() / "meshes").is_dir() else Path("examples/meshes")
mesh = data.normalise(data.load_mesh(folder / "truck_000.ply"))
view = cameras.orbit(torch.tensor([38.0]), 24.0, 2.0, focal_length=740.0, height=320, width=320)
towards = torch.nn.functional.normalize(torch.tensor([[0.5, 1.0, 0.6], [1.0, 0.1, -0.6]]), dim=-1)
lights = scenes.Lights(towards, torch.tensor([[0.75] * 3, [0.15] * 3]), torch.full((3,), 0.3))
image = data.render_mesh(mesh, view, lights)

# %%
# A random tenth of its faces is removed. Which voxels are solid now?

kept = np.random.default_rng(0).random(len(mesh.faces)) >= 0.1
holed = data.Mesh(mesh.vertices, mesh.faces[kept], mesh.face_colours[kept])


def overlap(first: torch.Tensor, second: torch.Tensor) -> float:
    return float((first & second).sum() / (first | second).sum())


whole = data.voxelise(mesh, 64)
print(f"{int(whole.sum())} voxels of 64^3 are solid")
voted = data.voxelise(holed, 64)
print(f"without a tenth of the faces, the IoU of the voxels is {overlap(whole, voted):.3f}")

# %%
# The same renderer draws the voxels: their free sides are a mesh of squares.


def voxel_mesh(solid: torch.Tensor) -> data.Mesh:
    cells = np.pad(solid.numpy(), 1).transpose(2, 1, 0)  # x, y, z
    squares, tints = [], []
    for axis in range(3):
        u, v = (np.eye(3)[k] / 2 for k in range(3) if k != axis)
        for step in (-1, 1):
            free = cells & ~np.roll(cells, -step, axis)
            middle = np.argwhere(free) - 0.5 + 0.5 * step * np.eye(3)[axis]
            squares.append(middle[:, None] + np.stack((-u - v, u - v, u + v, v - u)))
            tints.append(np.where(np.argwhere(free).sum(1, keepdims=True) % 2, 0.62, 0.78))  # a checkerboard
    corners = np.concatenate(squares)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate((first + np.array([0, 1, 2]), first + np.array([0, 2, 3])))
    return data.Mesh(corners.reshape(-1, 3) / len(solid) - 0.5, faces, np.tile(np.concatenate(tints), (2, 3)))


def show(axis: plt.Axes, image: torch.Tensor, title: str) -> None:
    axis.imshow(image.numpy(), cmap="viridis")
    axis.set_title(title)
    axis.axis("off")


figure, axes = plt.subplots(2, 3, figsize=(10.5, 7.2), layout="constrained")
depth = torch.where(image.mask[0], image.depth[0], torch.nan)
show(axes[0, 0], image.images[0].permute(1, 2, 0), "the mesh")
show(axes[0, 1], depth, f"depth, {float(depth[image.mask[0]].min()):.2f} to {float(depth[image.mask[0]].max()):.2f}")
normals = torch.where(image.mask[0], 0.5 + 0.5 * image.normals[0], 1.0)
show(axes[0, 2], normals.permute(1, 2, 0), "normals")
show(axes[1, 0], data.render_mesh(holed, view, lights).images[0].permute(1, 2, 0), "a tenth of its faces missing")
for axis, solid, title in ((axes[1, 1], whole, "voxels of the whole mesh"), (axes[1, 2], voted, "voxels of the rest")):
    blocks = data.render_mesh(voxel_mesh(solid), view, lights, smooth=False)
    show(axis, blocks.images[0].permute(1, 2, 0), title)
plt.show()
