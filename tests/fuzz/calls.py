"""Right calls of the operators, with one argument to spoil."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from lsmgeo import CameraTensors, VoxelGrid, functional
from lsmgeo.functional import Projected, Unprojected
from tests.fuzz.positions import DEPTHS, FEATURES, GRID, MAP, VIEWS, VOLUME


def with_value(field: str, index: tuple[int, ...], value: float) -> CameraTensors:
    """The views with one element of a matrix replaced."""
    changed = getattr(VIEWS, field).clone()
    changed[index] = value
    return VIEWS._replace(**{field: changed})


def with_scale(rotation: float = 1.0, first_row: float = 1.0) -> CameraTensors:
    """The views with the last one's rotation, or first row of the extrinsics, times a number."""
    E = VIEWS.cam_from_world.clone()
    E[1, 2, :3, :3] *= rotation
    E[1, 2, 0] *= first_row
    return VIEWS._replace(cam_from_world=E)


def unproject(features: Any = FEATURES, views: CameraTensors = VIEWS, **options: Any) -> Unprojected:
    return functional.unproject(features, views, GRID, **options)


def sweep(
    volume: Tensor = VOLUME,
    views: CameraTensors = VIEWS,
    grid: VoxelGrid = GRID,
    depths: Tensor = DEPTHS,
    size: Any = MAP,
    **options: Any,
) -> Projected:
    return functional.plane_sweep_project(volume, views, grid, depths, size, **options)
