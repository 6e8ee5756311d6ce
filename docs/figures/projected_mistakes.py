"""What usual mistakes do to a known object that is drawn into an image: a box and a ball, right and wrong."""

import itertools

import matplotlib.pyplot as plt
import torch
from format_drawing import INK, OTHER
from mistaken_cameras import BALL, BOX, HEIGHT, RADIUS, SIZE, WIDTH, mistakes, project, see

corners = torch.tensor(list(itertools.product((-0.5, 0.5), repeat=3)), dtype=torch.float64)
corners = corners * torch.tensor(SIZE) + torch.tensor(BOX)
along = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
edges = [
    torch.lerp(corners[i], corners[j], along)
    for i, j in itertools.combinations(range(8), 2)
    if int((corners[i] != corners[j]).sum()) == 1
]
turn = torch.linspace(0, 2 * torch.pi, 80, dtype=torch.float64)
circle = RADIUS * torch.stack((turn.cos(), turn.sin(), torch.zeros_like(turn)), -1)
rings = [circle.roll(axis, -1) + torch.tensor(BALL) for axis in range(3)]

images, _, K, E = see()
figure, axes = plt.subplots(2, 4, figsize=(9.6, 4.2), layout="constrained")
axes[0, 0].imshow(images[1])
axes[0, 0].set_title("image", fontsize=9.5, color=INK)
for axis, (name, (intrinsics, poses)) in zip(axes.flat[1:], mistakes(K, E).items(), strict=True):
    axis.imshow(images[1], alpha=0.55)
    where = "all of it behind the camera"
    for line in (*edges, *rings):
        pixels, depth = project(intrinsics[1], poses[1], line)
        front = depth > 0
        inside = front & (pixels > 0).all(-1) & (pixels < torch.tensor([WIDTH, HEIGHT])).all(-1)
        if bool(front.any()):
            where = "" if bool(inside.any()) or not where else "all of it outside the image"
            axis.plot(*pixels[front].T, color=OTHER, lw=1.3)
    axis.text(WIDTH / 2, 25, where, color=OTHER, fontsize=9.5, ha="center")
    axis.set_title(name, fontsize=9.5, color=INK)
for axis in axes.flat:
    axis.set(xlim=(-0.5, WIDTH - 0.5), ylim=(HEIGHT - 0.5, -0.5), xticks=[], yticks=[])
