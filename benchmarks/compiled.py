"""The gather form, compiled: index a channels-last table at the taps of each sample, and add them with their weights.

`torch.compile` gains nothing on `grid_sample`; as a gather, projection, taps and sum become one vectorised loop. Its
derived backward uses atomic additions on the threads of a CPU, which cost more than the threads gain. So backward is a
second graph, compiled for one thread, that recomputes the taps and passes once over the gradient.
`competitor(scene, automatic=True)` uses the backward that `torch.compile` derives.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.problems import IMAGE, LeftOut, Run, Scene
from benchmarks.rivals import NEAR, feature_intrinsics, pixel_rays

MOST_VIEWS = 4  # statistics unroll the views, so each number of views is compiled separately


def require_compiler() -> None:
    """Raise `LeftOut` if nothing can be compiled for a CPU."""
    try:
        from torch._inductor.cpp_builder import get_cpp_compiler

        get_cpp_compiler()
    except Exception as error:  # for any reason, the competitor is left out
        raise LeftOut(f"no C++ compiler at run time ({type(error).__name__})") from error


class Samples(NamedTuple):
    """Positions (B, V, N) along each axis of an array, the fastest axis first."""

    index: list[Tensor]
    sizes: list[int]
    front: Tensor
    first: Tensor  # the first row of the array in the table

    def visible(self) -> Tensor:
        seen = self.front
        for axis, n in zip(self.index, self.sizes, strict=True):
            seen = seen & (axis >= -0.5) & (axis < n - 0.5)
        return seen

    def of_view(self, v: int) -> Samples:
        return Samples([axis[:, v] for axis in self.index], self.sizes, self.front[:, v], self.first[:, v])

    def tap(self, mode: str, corner: int | Tensor) -> tuple[Tensor, Tensor]:
        """A row of the table and its weight; both (..., corners) for several corners."""
        index, inside, first = self.index, self.front, self.first
        if isinstance(corner, Tensor):
            index, inside, first = [axis[..., None] for axis in index], inside[..., None], first[..., None]
        row, weight = torch.zeros_like(first), torch.ones_like(index[0])
        stride = 1
        for position, (axis, n) in enumerate(zip(index, self.sizes, strict=True)):
            if mode == "nearest":
                cell = (axis + 0.5).floor()
            else:
                low, high = axis.floor(), (corner >> position) & 1
                cell = low + high
                weight = weight * (1.0 - high - (axis - low)).abs()  # the fraction above, what is left of 1 below
            inside = inside & (cell >= 0) & (cell < n)
            row = row + stride * cell.clamp(0, n - 1).to(torch.int64)
            stride = stride * n
        return row + first, torch.where(inside, weight, 0.0)


Find = Callable[..., Samples]


def image_samples(P: Tensor, points: Tensor, side: int) -> Samples:
    """Points (B or 1, N, 3) in images (B, V) of side x side pixels."""
    X, Y, Z = points[:, None].unbind(-1)  # (B or 1, 1, N)
    x, y, depth = (
        P[..., i, 0, None] * X + P[..., i, 1, None] * Y + P[..., i, 2, None] * Z + P[..., i, 3, None] for i in range(3)
    )
    front = depth > NEAR
    inverse = 1.0 / torch.where(front, depth, 1.0)
    B, V = P.shape[:2]
    first = torch.arange(B * V, device=P.device).reshape(B, V, 1) * side**2
    return Samples([x * inverse, y * inverse], [side, side], front, first)


def volume_samples(center: Tensor, rays: Tensor, depths: Tensor, side: int) -> Samples:
    """``center + depth ray``, in index units, in volumes (B,) of side^3 voxels."""
    index = [(center[..., i, None, None] + depths[:, None] * rays[..., None, :, i]).flatten(2) for i in range(3)]
    B, V = center.shape[:2]
    first = (torch.arange(B, device=center.device)[:, None, None] * side**3).expand(B, V, 1)
    return Samples(index, [side, side, side], torch.ones_like(index[0], dtype=torch.bool), first)


def corners(samples: Samples, mode: str) -> int:
    return 1 if mode == "nearest" else 2 ** len(samples.index)


def blend(table: Tensor, samples: Samples, mode: str) -> Tensor:
    """Rows of (rows, C), weighted and added: (..., C)."""
    value = 0.0
    for corner in range(corners(samples, mode)):
        row, weight = samples.tap(mode, corner)
        value = value + table[row].float() * weight[..., None]
    return value


def scatter(table: Tensor, values: Tensor, samples: Samples, mode: str) -> Tensor:
    """The adjoint of `blend`: values (..., C) added to the table's rows, all taps of a sample in one pass."""
    row, weight = samples.tap(mode, torch.arange(corners(samples, mode), device=table.device))
    return table.index_put((row,), values[..., None, :] * weight[..., None], accumulate=True)


def share(visible: Tensor) -> Tensor:
    """1 over the number of views that see a site: (B, N)."""
    return 1.0 / visible.sum(1).clamp(min=1).float()


@lru_cache
class Graphs:
    """The compiled functions for one kind of call. All take a table and the geometry of its samples."""

    def __init__(self, operator: str, statistic: str, mode: str, dynamic: bool, device: str) -> None:
        self.find = volume_samples if operator == "sweep" else image_samples
        self.statistic, self.mode = statistic, mode
        torch._dynamo.config.recompile_limit = 64
        options = {"cpp.threads": 1} if device == "cpu" else None
        self.forward = torch.compile(self.make_values, dynamic=dynamic)
        self.spread = torch.compile(self.spread_gradient, dynamic=dynamic)
        self.backward = torch.compile(self.make_gradient, dynamic=dynamic, options=options)
        # PyTorch itself transposes slowly.
        self.transpose = torch.compile(lambda values: values.transpose(-1, -2).contiguous(), dynamic=dynamic)

    def make_values(self, table: Tensor, *geometry: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Values, visibility and the views' mean, which the variance's backward needs."""
        samples = self.find(*geometry)
        visible = samples.visible()
        if not self.statistic:
            return blend(table, samples, self.mode).to(table.dtype), visible, table.new_zeros(())  # (B, V, N, C)
        total, squares = 0.0, 0.0
        for v in range(visible.shape[1]):
            value = blend(table, samples.of_view(v), self.mode) * visible[:, v, :, None]
            total, squares = total + value, squares + value * value
        mean = total * share(visible)[..., None]
        if self.statistic == "mean":
            return mean.to(table.dtype), visible, table.new_zeros(())
        return (squares * share(visible)[..., None] - mean * mean).to(table.dtype), visible, mean

    def spread_gradient(self, table: Tensor, gradient: Tensor, mean: Tensor, *geometry: Any) -> Tensor:
        """The gradient of each view's values from that of a statistic, (B, N, C)."""
        samples = self.find(*geometry)
        visible = samples.visible()
        scale = (share(visible)[:, None] * visible)[..., None]
        if self.statistic == "mean":
            return scale * gradient[:, None]
        return 2.0 * (blend(table, samples, self.mode) - mean[:, None]) * scale * gradient[:, None]

    def make_gradient(self, table: Tensor, gradient: Tensor, *geometry: Any) -> Tensor:
        """The gradient of the table from that of the views' values."""
        zeros = torch.zeros_like(table, dtype=torch.float32)
        return scatter(zeros, gradient.float(), self.find(*geometry), self.mode).to(table.dtype)


class Gather(torch.autograd.Function):
    """A compiled forward with a compiled backward; values (..., N, C), or (..., C, N) if `planar`."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, graphs: Graphs, planar: bool, *geometry: Any) -> Any:
        values, visible, mean = graphs.forward(table, *geometry)
        ctx.save_for_backward(table, mean)
        ctx.call = graphs, planar, geometry
        ctx.mark_non_differentiable(visible)
        return graphs.transpose(values) if planar else values, visible

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Any) -> tuple[Any, ...]:
        graphs, planar, geometry = ctx.call
        table, mean = ctx.saved_tensors
        gradient = graphs.transpose(gradient) if planar else gradient
        if graphs.statistic:
            gradient = graphs.spread(table, gradient, mean, *geometry)
        return graphs.backward(table, gradient, *geometry), *(None,) * (2 + len(geometry))


def competitor(scene: Scene, dynamic: bool = False, automatic: bool = False) -> Run:
    """The compiled gather form of a problem."""
    problem = scene.problem
    if problem.operator not in ("unproject", "sweep"):
        raise LeftOut("not written")
    if problem.statistic and problem.V > MOST_VIEWS:
        raise LeftOut(f"unrolls the views; more than {MOST_VIEWS} take long to compile")
    if problem.device == "cpu":
        require_compiler()
    K, E = scene.cameras.intrinsics, scene.cameras.cam_from_world
    image, size = (IMAGE, IMAGE), (problem.size, problem.size)
    planar = problem.operator == "sweep" and problem.flatten
    graphs = Graphs(problem.operator, problem.statistic, problem.mode, dynamic, problem.device)

    def gather(source: Tensor, axis: int, sites: tuple[int, ...], *geometry: Any) -> tuple[Tensor, Tensor]:
        table = source.movedim(axis, -1).reshape(-1, problem.C)  # a copy unless channels are innermost
        if automatic:
            values, visible, _ = graphs.forward(table, *geometry)
            values = values.transpose(-1, -2).contiguous() if planar else values
        else:
            values, visible = Gather.apply(table, graphs, planar, *geometry)
        values = values if planar else values.movedim(-1, -2)  # (B, V, C, N)
        return values.unflatten(-1, sites), visible.unflatten(-1, sites)

    def lifted(features: Tensor) -> tuple[Tensor, Tensor]:
        P = feature_intrinsics(K, image, size) @ E[..., :3, :]
        return gather(features, 2, scene.grid.shape, P, scene.grid.centers().to(K).reshape(1, -1, 3), problem.size)

    def swept(volume: Tensor) -> tuple[Tensor, Tensor]:
        center, rays = pixel_rays(K, E, image, size)
        side, sites = problem.voxels, (problem.planes, *size)  # positions are in the volume's index units
        geometry = (center + 0.5) * side - 0.5, rays * side, scene.depths, side
        maps, visible = gather(volume, 1, sites, *geometry)
        return maps.flatten(2, 3) if problem.flatten else maps, visible

    return swept if problem.operator == "sweep" else lifted
