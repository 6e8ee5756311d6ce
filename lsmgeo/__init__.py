"""Features between images and 3D space: differentiable unprojection and plane-sweep projection on kornia cameras."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lsmgeo import cameras, errors, functional, fusion, kernels, rays
    from lsmgeo.cameras import CameraTensors
    from lsmgeo.debugging import debug
    from lsmgeo.grids import FrustumGrid, VoxelGrid, depth_planes
    from lsmgeo.layers import PlaneSweepProject, Splat, Unproject

__version__ = "0.1.0"

__all__ = [
    "CameraTensors",
    "FrustumGrid",
    "PlaneSweepProject",
    "Splat",
    "Unproject",
    "VoxelGrid",
    "__version__",
    "cameras",
    "debug",
    "depth_planes",
    "errors",
    "functional",
    "fusion",
    "kernels",
    "rays",
]

# The modules of the names of `__all__` that are not modules.
_HOMES = {
    "CameraTensors": "cameras",
    "FrustumGrid": "grids",
    "PlaneSweepProject": "layers",
    "Splat": "layers",
    "Unproject": "layers",
    "VoxelGrid": "grids",
    "debug": "debugging",
    "depth_planes": "grids",
}

# Imported with their first use (PEP 562): without PyTorch, `lsmgeo --help` answers at once.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        from importlib import import_module

        if name not in __all__ and name not in _HOMES.values():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = import_module(f"{__name__}.{_HOMES.get(name, name)}")
        value = globals()[name] = getattr(module, name) if name in _HOMES else module
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
