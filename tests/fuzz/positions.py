"""Every argument of the public functions, with a call that is right; a position is one argument of one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lsmgeo import (
    CameraTensors,
    FrustumGrid,
    PlaneSweepProject,
    Splat,
    Unproject,
    VoxelGrid,
    cameras,
    depth_planes,
    functional,
    fusion,
    kernels,
    rays,
)

B, V, C, P = 2, 3, 4, 5
SIZE = (6, 7)
MAP = (8, 9)
SHAPE = (3, 4, 6)


def right_cameras(*leading: int) -> CameraTensors:
    azimuth = torch.linspace(0.0, 200.0, torch.Size(leading).numel()).reshape(leading)
    made = cameras.orbit(azimuth, 20.0, 2.0, focal_length=20.0, height=12, width=14)
    return CameraTensors(*(field.clone() for field in made))


def _unproject(**arguments: Any) -> Any:
    fields = [arguments.pop(name) for name in CameraTensors._fields]
    return functional.unproject(cameras=CameraTensors(*fields), **arguments)


def _slabs(**arguments: Any) -> Any:
    volumes = [volume for _, volume, _ in functional.unproject_slabs(**arguments)]
    return torch.cat(volumes, 3)


def _layer(layer: Callable[..., Any], count: int) -> Callable[..., Any]:
    """Make the layer from all but the first `count` arguments and call it with those."""

    def run(**arguments: Any) -> Any:
        given = [arguments.pop(name) for name in list(arguments)[:count]]
        made = layer(**arguments)
        assert repr(made)
        return made(*given)

    return run


def _splat(**arguments: Any) -> Any:
    called = {name: arguments.pop(name) for name in ("features", "cameras", "view_mask", "weights")}
    return Splat(**arguments)(**called)


def _grid(**arguments: Any) -> Any:
    grid = VoxelGrid(**arguments)
    assert repr(grid).startswith("VoxelGrid(")
    # Index space is not asked for where sizes make it large.
    return grid.centers() if torch.Size(grid.shape).numel() <= 1e5 else (), grid.lattice_from_world


def _frustum(**arguments: Any) -> Any:
    grid = FrustumGrid(**arguments)
    assert repr(grid).startswith("FrustumGrid(")
    return grid.centers(), grid.lattice_from_world


def _explain(**arguments: Any) -> Any:
    kernels.explain(**arguments)
    return ()


VIEWS = right_cameras(B, V)
FEATURES = torch.rand(B, V, C, *SIZE)
VOLUME = torch.rand(B, C, *SHAPE)
GRID = VoxelGrid(SHAPE)
DEPTHS = depth_planes(1.0, 3.0, P)
MASK = torch.tensor([[True, False, True], [True, True, True]])
SAMPLING: dict[str, Any] = {"view_mask": MASK, "padding_mode": "zeros", "augment": (), "direction_frame": "world"}
SAMPLING |= {"near": 1e-6, "backend": "auto"}
IMAGE = {"mode": "bilinear", "reduce": None, **SAMPLING}
SWEPT = {"mode": "trilinear", **SAMPLING}
ADDED = {"weights": torch.rand(B, V, P, *SIZE), "view_mask": MASK, "mode": "trilinear", "padding_mode": "zeros"}
ADDED |= {"near": 1e-6, "backend": "auto"}
SCORES = torch.rand(B, P, *MAP)
SEEN = torch.rand(B, P, *MAP) > 0.3
K, E = VIEWS.intrinsics, VIEWS.cam_from_world
R, T = E[..., :3, :3].clone(), E[..., :3, 3].clone()
IMAGE_SIZE = {"height": 12, "width": 14}
COMMON = {name: value for name, value in SAMPLING.items() if name != "view_mask"}

LIFTED = {"features": FEATURES, "cameras": VIEWS, "grid": GRID}
SWEEP = {"volume": VOLUME, "cameras": VIEWS, "grid": GRID, "depths": DEPTHS}
BLOCKS = {"volume": torch.rand(B, V, C, 11), "visible": torch.rand(B, V, 11) > 0.3}
# The call of a layer goes before what it is made from.
CALLED = {"cameras": VIEWS, "view_mask": MASK}
PLANES = {"grid": GRID, "depths": DEPTHS, "size": MAP}

CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "unproject": (_unproject, {"features": FEATURES, **VIEWS._asdict(), "grid": GRID, **IMAGE}),
    "unproject of cameras": (functional.unproject, LIFTED),
    "unproject with reduce": (functional.unproject, {**LIFTED, "reduce": "max", "near": 0.1, "view_mask": MASK}),
    "unproject_slabs": (_slabs, {**LIFTED, "planes": 2, "view_mask": MASK}),
    "unproject_points": (
        functional.unproject_points,
        {"features": FEATURES, "cameras": VIEWS, "points": torch.rand(B, 11, 3) - 0.5, **IMAGE},
    ),
    "sample_views": (
        functional.sample_views,
        {
            "features": FEATURES,
            "pixels": 5.0 * torch.rand(B, V, 11, 2),
            "depth": torch.rand(B, V, 11) + 1.0,
            "valid": torch.rand(B, V, 11) > 0.3,
            **{name: IMAGE[name] for name in ("mode", "padding_mode", "augment", "reduce", "near", "backend")},
        },
    ),
    "plane_sweep_project": (functional.plane_sweep_project, {**SWEEP, "size": MAP, "flatten": True, **SWEPT}),
    "sample_volume": (
        functional.sample_volume,
        {"volume": VOLUME, "grid": GRID, "points": torch.rand(B, 11, 3) - 0.5, "mode": "trilinear"}
        | {"padding_mode": "zeros", "near": 1e-6},
    ),
    "sample_volume of a frustum": (
        functional.sample_volume,
        {"volume": torch.rand(B, C, P, *MAP), "grid": FrustumGrid(right_cameras(B), DEPTHS, MAP)}
        | {"points": torch.rand(B, 11, 3) - 0.5},
    ),
    "splat": (functional.splat, {"features": FEATURES, "cameras": VIEWS, "grid": GRID, "depths": DEPTHS, **ADDED}),
    "splat without weights": (
        functional.splat,
        {
            "features": torch.rand(B, V, C, P, *SIZE),
            "cameras": VIEWS,
            "grid": GRID,
            "depths": DEPTHS,
            "mode": "nearest",
        },
    ),
    "view_statistics": (functional.view_statistics, {**BLOCKS, "statistics": ("mean", "max"), "view_mask": MASK}),
    "Unproject": (
        _layer(Unproject, 3),
        {"features": FEATURES, **CALLED, "grid": GRID, "mode": "bilinear", "reduce": None, **COMMON},
    ),
    "PlaneSweepProject": (
        _layer(PlaneSweepProject, 3),
        {"volume": VOLUME, **CALLED, **PLANES, "flatten": True, "mode": "trilinear", **COMMON},
    ),
    "Splat": (
        _splat,
        {"features": FEATURES, **CALLED, "weights": ADDED["weights"], "grid": GRID, "depths": DEPTHS, "near": 0.1},
    ),
    "ProjectReduce": (
        _layer(rays.ProjectReduce, 3),
        {"volume": VOLUME, **CALLED, "in_channels": C, "out_channels": 2, **PLANES, "bias": True, "mode": "trilinear"}
        | COMMON,
    ),
    "project_reduce": (
        rays.project_reduce,
        {**SWEEP, "weight": torch.rand(2, C * P), "bias": torch.rand(2), "size": MAP, **SWEPT},
    ),
    "expected_depth": (rays.expected_depth, {"scores": SCORES, "depths": DEPTHS, "visible": SEEN}),
    "max_along_rays": (rays.max_along_rays, {"maps": SCORES, "visible": SEEN}),
    "composite": (
        rays.composite,
        {"alpha": torch.rand(B, P, *MAP), "values": torch.rand(B, C, P, *MAP), "depths": DEPTHS, "visible": SEEN},
    ),
    "Mean": (_layer(fusion.Mean, 3), {**BLOCKS, "view_mask": MASK}),
    "VoxelGrid": (_grid, {"shape": SHAPE, "lower": (-1.0, -2.0, -3.0), "upper": 1.0, "world_from_grid": torch.eye(4)}),
    "FrustumGrid": (_frustum, {"camera": right_cameras(B), "depths": DEPTHS, "size": MAP}),
    "depth_planes": (depth_planes, {"near": 1.0, "far": 3.0, "num": P, "spacing": "log"}),
    "stack": (cameras.stack, {"cameras": [right_cameras(V), right_cameras(V)], "dim": 1}),
    "to": (cameras.to, {"cameras": VIEWS, "dtype": torch.float64}),
    "resize": (cameras.resize, {"cameras": VIEWS, "height": 6, "width": 5}),
    "crop": (cameras.crop, {"cameras": VIEWS, "top": 2, "left": 3, "height": 6, "width": 5}),
    "look_at": (
        cameras.look_at,
        {"eye": torch.rand(B, 3) + 1.0, "target": torch.zeros(3), "up": torch.tensor([0.0, 1.0, 0.0])},
    ),
    "orbit": (
        cameras.orbit,
        {"azimuth": torch.rand(B), "elevation": 20.0, "distance": torch.tensor(2.0), "focal_length": 20.0}
        | {**IMAGE_SIZE, "target": (0.0, 0.0, 0.0)},
    ),
    "perturb": (cameras.perturb, {"cameras": VIEWS, "degrees": 2.0, "target": torch.zeros(3), "generator": None}),
    "rays": (cameras.rays, {"cameras": VIEWS, "size": MAP}),
    "project": (cameras.project, {"cameras": VIEWS, "points": torch.rand(B, 11, 3) - 0.5, "near": 0.1}),
    "unproject_depth": (cameras.unproject_depth, {"cameras": VIEWS, "depth": torch.rand(B, V, *MAP) + 1.0}),
    "centers": (cameras.centers, {"cameras": VIEWS}),
    "from_kornia": (CameraTensors.from_kornia, {"camera": VIEWS.to_kornia()}),
    "from_opencv": (
        cameras.from_opencv,
        {"intrinsics": K, "rotation": R, "translation": T, **IMAGE_SIZE, "pixel_center": "integer"},
    ),
    "from_opengl": (
        cameras.from_opengl,
        {"intrinsics": K, "world_from_cam": torch.linalg.inv(E), **IMAGE_SIZE, "pixel_center": "half"},
    ),
    "from_colmap": (
        cameras.from_colmap,
        {"intrinsics": K, "quaternion": torch.rand(B, V, 4) + 0.1, "translation": T}
        | {**IMAGE_SIZE, "pixel_center": "half"},
    ),
    "from_pytorch3d": (
        cameras.from_pytorch3d,
        {"R": R, "T": T, "focal_length": torch.rand(B, V, 2) + 1.0, "principal_point": torch.rand(B, V, 2)}
        | {**IMAGE_SIZE, "in_ndc": True},
    ),
    **{
        f"to_{tool}": (getattr(cameras, f"to_{tool}"), {"cameras": VIEWS, "pixel_center": "half"})
        for tool in ("opencv", "opengl", "colmap")
    },
    "to_pytorch3d": (cameras.to_pytorch3d, {"cameras": VIEWS, "in_ndc": False}),
    "explain": (_explain, {"operator": "unproject", "source": FEATURES, "mode": "nearest", "reduce": "mean"}),
}


@dataclass(frozen=True)
class Position:
    """One argument of one call."""

    call: str
    argument: str

    def run(self, value: Any) -> Any:
        """The call with this argument replaced."""
        function, arguments = CALLS[self.call]
        return function(**{**arguments, self.argument: value})

    @property
    def right(self) -> Any:
        """What the call has there."""
        return CALLS[self.call][1][self.argument]

    def __str__(self) -> str:
        return f"{self.call}({self.argument})"


POSITIONS = [Position(call, argument) for call, (_, arguments) in CALLS.items() for argument in arguments]


def tensors_of(value: Any) -> list[Tensor]:
    """All tensors in an answer."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, tuple | list):
        return [tensor for item in value for tensor in tensors_of(item)]
    return []
