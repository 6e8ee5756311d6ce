"""A painted sphere in closed form: its exact image, depth and surface points in any camera."""

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo import cameras

BACKGROUND = 0.9


class Rendering(NamedTuple):
    """Renderings of a sphere for cameras with leading shape (...)."""

    image: Tensor  # (..., 3, h, w), in [0, 1]
    depth: Tensor  # (..., h, w), camera z; infinite outside the sphere
    points: Tensor  # (..., h, w, 3), hits of the rays; undefined outside the sphere


def paint(points: Tensor, waves: int = 24, wavelength: float = 0.25) -> Tensor:
    """The colour (..., 3), in [0, 1], of points in space (..., 3): a sum of plane waves in random directions."""
    generator = torch.Generator().manual_seed(7)
    directions = torch.randn(3, waves, 3, generator=generator)
    directions = directions / directions.norm(dim=-1, keepdim=True) * 2 * torch.pi / wavelength
    directions = directions * (0.6 + 0.8 * torch.rand(3, waves, 1, generator=generator))  # lengths differ by +-40 %
    phases = 2 * torch.pi * torch.rand(3, waves, generator=generator)
    heights = torch.einsum("...x,cnx->...cn", points, directions.to(points)) + phases.to(points)
    return (2 * heights.sin().sum(-1) / waves**0.5).sigmoid()


def look_at_sphere(
    views: cameras.CameraTensors, center: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = 0.4, **painting
) -> Rendering:
    """Intersect the ray of every pixel with the sphere, and colour the first hit."""
    origins, directions = cameras.rays(views)
    offset = (origins - origins.new_tensor(center))[..., None, None, :]
    along = (directions * offset).sum(-1)
    discriminant = along**2 - offset.square().sum(-1) + radius**2
    distance = -along - discriminant.clamp_min(0).sqrt()
    hit = (discriminant > 0) & (distance > 0)
    points = origins[..., None, None, :] + distance[..., None] * directions
    forward = views.cam_from_world[..., 2, :3][..., None, None, :]
    depth = torch.where(hit, distance * (directions * forward).sum(-1), torch.inf)
    color = torch.where(hit[..., None], paint(points, **painting), BACKGROUND)
    return Rendering(color.movedim(-1, -3), depth, points)
