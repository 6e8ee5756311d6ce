"""What the tests of the models feed them with."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import Module

from lsmgeo.cameras import CameraTensors, orbit


def look(scenes: int, views: int, size: int = 32, *, seed: int = 0) -> tuple[Tensor, CameraTensors]:
    """Random images (B, V, 3, size, size), and cameras on an orbit that see the unit cube."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(scenes, views, 3, size, size, generator=generator)
    azimuths = 360.0 * torch.rand(scenes, views, generator=generator)
    elevations = 50.0 * torch.rand(scenes, views, generator=generator) - 20.0
    return images, orbit(azimuths, elevations, 2.0, focal_length=1.875 * size, height=size, width=size)


def some(cameras: CameraTensors, scenes: slice | int, views: object) -> CameraTensors:
    """Cameras of some scenes and views."""
    scenes = slice(scenes, scenes + 1) if isinstance(scenes, int) else scenes
    return CameraTensors(*(torch.as_tensor(field)[scenes][:, views] for field in cameras))


def count(module: Module) -> int:
    """How many numbers a module learns."""
    return sum(weights.numel() for weights in module.parameters())


def shapes_at(model: Module, names: Iterable[str], images: Tensor, cameras: CameraTensors) -> dict[str, tuple]:
    """The shapes that come out of a model's modules."""
    shapes, hooks = {}, []
    for name in names:

        def note(module, given, made, name=name):
            shapes[name] = tuple((made[0] if isinstance(made, tuple) else made).shape)

        hooks.append(model.get_submodule(name).register_forward_hook(note))
    with torch.no_grad():
        model(images, cameras)
    for hook in hooks:
        hook.remove()
    return shapes
