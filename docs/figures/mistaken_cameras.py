"""A rendered scene with a box and a ball, cameras that see it, and the same cameras with usual mistakes."""

import torch
from torch import Tensor

from lsmgeo import cameras, scenes

HEIGHT, WIDTH, FOCAL = 180, 240, 260.0
BOX, SIZE = (-0.15, -0.2, 0.1), (0.5, 0.5, 0.4)
BALL, RADIUS = (0.35, -0.2, -0.3), 0.25

GRAPHICS, UPSIDE_DOWN = (torch.diag(torch.tensor([1.0, -1.0, z, 1.0])).double() for z in (-1.0, 1.0))
HALF_AS_LARGE = torch.diag(torch.tensor([0.5, 0.5, 1.0])).double()
HALF_A_PIXEL = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]).double()


def see() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images (V, H, W, 3), depth (V, H, W), K (V, 3, 3) and world-to-camera matrices (V, 4, 4) of three views."""

    def paint(first: tuple[float, float, float], second: tuple[float, float, float], texture: str) -> scenes.Material:
        return scenes.Material(first, texture=texture, second=second, frequency=5.0)

    primitives = [
        scenes.half_space((0, -0.45, 0), (0, 1, 0), paint((0.87, 0.85, 0.8), (0.68, 0.69, 0.7), "checker")),
        scenes.box(BOX, SIZE, paint((0.65, 0.72, 0.8), (0.42, 0.52, 0.65), "stripes")),
        scenes.sphere(BALL, RADIUS, paint((0.85, 0.72, 0.55), (0.7, 0.5, 0.35), "waves")),
    ]
    sun = scenes.Lights(torch.tensor([[0.4, 1.0, 0.5]]), torch.full((1, 3), 0.6), torch.full((3,), 0.4))
    azimuths = torch.tensor([10.0, 38.0, -25.0])
    views = cameras.orbit(azimuths, 24.0, 2.2, focal_length=FOCAL, height=HEIGHT, width=WIDTH)
    views = cameras.to(views, torch.float64)
    rendered = scenes.render([scenes.Scene(primitives)], type(views)(*(value[None] for value in views)), sun)
    return rendered.images[0].movedim(1, -1), rendered.depth[0].double(), views.intrinsics, views.cam_from_world


def mistakes(K: Tensor, E: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """K and world-to-camera matrices as they are, and as six mistakes make them."""
    return {
        "right": (K, E),
        "poses inverted": (K, torch.linalg.inv(E)),
        "OpenGL axes": (K, GRAPHICS @ E),
        "y flipped": (K, UPSIDE_DOWN @ E @ UPSIDE_DOWN),
        "K of another resolution": (HALF_AS_LARGE @ K, E),
        "frames shuffled": (K, E[[0, 2, 1]]),
        "half a pixel": (K + HALF_A_PIXEL, E),
    }


def project(K: Tensor, E: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, 2) and depth (N,) of points (N, 3) in one view."""
    seen = (points @ E[:3, :3].T + E[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:], seen[:, 2]
