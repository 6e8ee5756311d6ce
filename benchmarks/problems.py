"""Problems to time: a problem is a few numbers, from which every process makes the same tensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from lsmgeo import FrustumGrid, VoxelGrid, cameras, depth_planes

# From a source, a leaf or not, to the compared results: an output, and visibility or None.
Run = Callable[[Tensor], tuple[Tensor, Tensor | None]]

IMAGE = 224  # pixels of the images; feature maps and swept maps are smaller
TINY = {"B": 2, "V": 2, "C": 8, "size": 16, "voxels": 8, "planes": 4, "outputs": 8}


class LeftOut(Exception):
    """A competitor cannot run a problem; the text is the reason for the table."""


@dataclass(frozen=True)
class Problem:
    """Sizes and options."""

    # "unproject" (images to voxels), "sweep" (voxels to images), "reduce" (a sweep and a linear map of its stacked
    # channels), "frustum" (images to the frustum of the first view) or "points" (voxels at scattered points).
    operator: str
    B: int = 4  # scenes
    V: int = 4  # views of a scene
    C: int = 32  # channels
    size: int = 112  # side of the feature maps; of the maps for a sweep
    voxels: int = 32  # side of the grid
    planes: int = 64  # of a sweep or frustum; there are planes * size^2 points
    mode: str = "smooth"  # or "nearest"
    statistic: str = ""  # over the views; "" keeps them; "dot": the mean product with the first view
    flatten: bool = False  # whether a sweep stacks its planes into the channels
    outputs: int = 512  # channels of the linear map
    dtype: str = "float32"  # of the source
    layout: str = "channels_last"  # of the source in memory; or "contiguous"
    device: str = "cpu"  # or "cuda"

    def but(self, **changes: Any) -> Problem:
        return replace(self, **changes)

    @property
    def is_sweep(self) -> bool:
        return self.operator in ("sweep", "reduce")

    @property
    def reads_volume(self) -> bool:
        return self.is_sweep or self.operator == "points"

    @property
    def torch_dtype(self) -> torch.dtype:
        return getattr(torch, self.dtype)

    @property
    def sites(self) -> int:
        """Sites of a view."""
        return self.voxels**3 if self.operator == "unproject" else self.planes * self.frustum_size**2

    @property
    def frustum_size(self) -> int:
        """Side of a frustum's images: half of the features', so that it is inside the other views; all of a sweep's."""
        return self.size // 2 if self.operator == "frustum" else self.size


def channels_last(tensor: Tensor, axis: int) -> Tensor:
    """The same values with an axis innermost in memory."""
    return tensor.movedim(axis, -1).contiguous().movedim(-1, axis)


def _random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


class Scene:
    """The tensors of a problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem

    @cached_property
    def cameras(self) -> cameras.CameraTensors:
        """Around the cube; close together for a frustum, so that every view sees all of it."""
        problem = self.problem
        shape = (problem.B, problem.V)
        generator = torch.Generator().manual_seed(0)
        azimuth, elevation = (torch.rand(shape, generator=generator) for _ in range(2))
        if problem.operator == "frustum":
            azimuth, elevation = 8.0 * azimuth, 8.0 * elevation
        else:
            azimuth, elevation = 360.0 * azimuth, 50.0 * elevation - 20.0
        made = cameras.orbit(azimuth, elevation, 2.0, focal_length=420.0, height=IMAGE, width=IMAGE)
        return cameras.to(made, problem.device)

    @cached_property
    def source(self) -> Tensor:
        """Features (B, V, C, size, size), or a volume (B, C, voxels, voxels, voxels)."""
        problem, axis = self.problem, 1 if self.problem.reads_volume else 2
        sides = (problem.voxels,) * 3 if problem.reads_volume else (problem.size,) * 2
        made = _random((*(problem.B, problem.V)[:axis], problem.C, *sides), 1)
        made = channels_last(made, axis) if problem.layout == "channels_last" else made
        return made.to(problem.device, problem.torch_dtype)

    @cached_property
    def grid(self) -> VoxelGrid | FrustumGrid:
        """Voxels, or the frustum of the central half of the first view: `window` of its feature map's pixels."""
        if self.problem.operator != "frustum":
            return VoxelGrid(self.problem.voxels)
        quarter, size = IMAGE // 4, (self.problem.frustum_size,) * 2
        camera = cameras.crop(cameras.select(self.cameras, 1, 0), quarter, quarter, IMAGE // 2, IMAGE // 2)
        return FrustumGrid(camera, self.depths, size=size)

    @property
    def window(self) -> slice:
        """The rows, and columns, of the first feature map that a frustum uses."""
        return slice(self.problem.size // 4, self.problem.size // 4 + self.problem.frustum_size)

    @cached_property
    def depths(self) -> Tensor:
        problem = self.problem
        if problem.operator == "frustum":
            return depth_planes(1.75, 2.25, problem.planes, spacing="inverse").to(problem.device)
        return depth_planes(1.0, 3.0, problem.planes).to(problem.device)  # the cameras are 2 from a cube of side 1

    @cached_property
    def points(self) -> Tensor:
        """Scattered over the cube and a little around it, (B, sites, 3)."""
        problem, generator = self.problem, torch.Generator().manual_seed(4)
        return (1.2 * torch.rand(problem.B, problem.sites, 3, generator=generator) - 0.6).to(problem.device)

    @cached_property
    def weight(self) -> Tensor:
        """Of the linear map, (outputs, C * planes)."""
        problem = self.problem
        inputs = problem.C * problem.planes
        return (_random((problem.outputs, inputs), 3) * inputs**-0.5).to(problem.device, problem.torch_dtype)

    def cotangent(self, output: Tensor) -> Tensor:
        """One gradient for all, in the memory layout of each competitor's own output."""
        values = _random(tuple(output.shape), 2).to(output.dtype)
        return torch.empty_like(output).copy_(values)
