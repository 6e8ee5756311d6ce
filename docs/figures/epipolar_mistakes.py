"""What usual mistakes do to epipolar lines: two images of one scene, right cameras and six wrong ones."""

import matplotlib.pyplot as plt
import torch
from format_drawing import INK
from mistaken_cameras import HEIGHT, WIDTH, mistakes, project, see

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7")
images, depth, K, E = see()
marked = torch.tensor([[112, 80], [181, 135], [60, 150], [215, 62]])  # columns and rows of the first image
u, v = marked.unbind(-1)
pixels = torch.stack((u, v, torch.ones_like(u))).double()
points = torch.linalg.inv(E[0]) @ torch.cat((torch.linalg.inv(K[0]) @ pixels * depth[0, v, u], pixels[2:]))
expected, _ = project(K[1], E[1], points[:3].T)


def epipolar_lines(K: torch.Tensor, E: torch.Tensor) -> torch.Tensor:
    """(N, 3) lines a x + b y + c = 0 of the second image, unit normals, on which the first one's pixels lie."""
    relative = E[1] @ torch.linalg.inv(E[0])
    tx, ty, tz = relative[:3, 3]
    cross = torch.tensor([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]], dtype=torch.float64)
    lines = pixels.T @ (torch.linalg.inv(K[1]).T @ cross @ relative[:3, :3] @ torch.linalg.inv(K[0])).T
    return lines / lines[:, :2].norm(dim=-1, keepdim=True)


figure, axes = plt.subplots(2, 4, figsize=(9.6, 4.2), layout="constrained")
axes[0, 0].imshow(images[0])
axes[0, 0].set_title("first image", fontsize=9.5, color=INK)
axes[0, 0].scatter(u, v, c=COLOURS, s=34, edgecolors="white", zorder=3)
for axis, (name, stated) in zip(axes.flat[1:], mistakes(K, E).items(), strict=True):
    lines = epipolar_lines(*stated)
    misses = (lines[:, :2] * expected).sum(-1) + lines[:, 2]
    axis.imshow(images[1])
    for (a, b, c), (x, row), colour in zip(lines.tolist(), expected.tolist(), COLOURS, strict=True):
        if abs(b) > abs(a):
            axis.axline((0, -c / b), (WIDTH, -(c + a * WIDTH) / b), color=colour, lw=1.6)
        else:
            axis.axline((-c / a, 0), (-(c + b * HEIGHT) / a, HEIGHT), color=colour, lw=1.6)
        axis.plot(x, row, "o", color=colour, mec="white", ms=6, zorder=3)
    axis.set_title(f"{name}: {misses.abs().median().round(decimals=2):.2g} px", fontsize=9.5, color=INK)
for axis in axes.flat:
    axis.set(xlim=(-0.5, WIDTH - 0.5), ylim=(HEIGHT - 0.5, -0.5), xticks=[], yticks=[])
