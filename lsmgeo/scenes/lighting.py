"""Lambertian shading, for analytic scenes and for rendered meshes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Lights", "shade"]


class Lights(NamedTuple):
    """Distant lights and ambient light; a pytree, any leading shape.

    Attributes:
        directions: (..., L, 3) unit vectors, world frame, from the surface towards each light.
        colours: (..., L, 3) RGB intensities; at 1 a white surface that faces the light has full brightness.
        ambient: (..., 3) RGB intensity on every surface.
    """

    directions: Tensor
    colours: Tensor
    ambient: Tensor


def shade(albedo: Tensor, normals: Tensor, lights: Lights, lit: Tensor | None = None) -> Tensor:
    """The colour of Lambertian surfaces.

    Equation: albedo (ambient + sum over l of max(0, <n, d_l>) colour_l), at most 1.

    Args:
        albedo: (..., 3) RGB.
        normals: (..., 3) unit vectors, world frame.
        lights: leading shape that broadcasts against that of the surfaces.
        lit: (..., L) bool, False where a light is blocked.

    Returns:
        (..., 3) RGB.

    Example:
        >>> import torch
        >>> from lsmgeo.scenes import Lights, shade
        >>> above = Lights(torch.tensor([[0.0, 1.0, 0.0]]), torch.full((1, 3), 0.5), torch.full((3,), 0.25))
        >>> shade(torch.ones(2, 3), torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), above)
        tensor([[0.7500, 0.7500, 0.7500],
                [0.2500, 0.2500, 0.2500]])
    """
    light = lights.ambient.expand_as(albedo)
    for index in range(lights.directions.shape[-2]):
        direction, colour = lights.directions[..., index, :], lights.colours[..., index, :]
        facing = (normals * direction).sum(-1, keepdim=True).clamp_min(0)
        if lit is not None:
            facing = facing * lit[..., index, None]
        light = torch.addcmul(light, facing, colour.to(facing.dtype))
    return (albedo * light).clamp(0, 1)
