"""What the tests of the models feed them with."""

from __future__ import annotations

import torch
from torch import Tensor

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
