"""All competitors by the names in the tables, and the library's own calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from benchmarks import compiled, rivals
from benchmarks.problems import LeftOut, Run, Scene, channels_last
from lsmgeo import functional, rays
from lsmgeo._sites import image_sites, sweep_sites
from lsmgeo.kernels import Options
from lsmgeo.kernels.native import library

OURS = "lsmgeo"
REFERENCE = "lsmgeo, reference"
UNFUSED = "lsmgeo, sweep and convolution"
HAND = "hand-written"
COMPILED = "compiled gather"
COMPILED_ANY = "compiled gather, any size"
AUTOMATIC = "compiled gather, automatic backward"
WARPER = "kornia DepthWarper"
HOMOGRAPHY = "kornia homography_warp"
ATLAS = "running mean (Atlas)"
MVSNET = "running variance (MVSNet)"
DOT = "products view by view"
COLD = "floor, fresh memory"
WARM = "floor, warm memory"
KERNEL = "kernel, warm memory"


def ours(scene: Scene, backend: str = "auto", fused: bool = True) -> Run:
    """The public call; without `fused`, a sweep and a convolution over all its channels."""
    problem, size = scene.problem, (scene.problem.size,) * 2
    if not fused and problem.operator != "reduce":
        raise LeftOut("there is nothing to fuse")
    options: Any = {"mode": mode_of(scene), "backend": backend}

    def lifted(features: Tensor) -> Any:
        reduce = problem.statistic or None
        return functional.unproject(features, scene.cameras, scene.grid, reduce=reduce, **options)

    def products(features: Tensor) -> Any:
        # At the frustum's own pixels no interpolation is needed.
        first = features[:, 0, :, None, scene.window, scene.window]
        others = scene.cameras.at((slice(None), slice(1, None)))
        products = functional.unproject(features[:, 1:], others, scene.grid, reference=first, **options).volume
        return products[:, :, 0], None

    def swept(volume: Tensor, flatten: bool = problem.flatten) -> Any:
        where = scene.cameras, scene.grid, scene.depths, size
        return functional.plane_sweep_project(volume, *where, flatten=flatten, **options)

    def reduced(volume: Tensor) -> Any:
        if fused:
            where = scene.cameras, scene.grid, scene.depths, scene.weight, None, size
            return rays.project_reduce(volume, *where, **options)
        maps, visible = swept(volume, flatten=True)
        mapped = conv2d(maps.flatten(0, 1), scene.weight[..., None, None])
        return mapped.unflatten(0, maps.shape[:2]), visible

    def scattered(volume: Tensor) -> Any:
        return functional.sample_volume(volume, scene.grid, scene.points, mode=options["mode"])

    if problem.statistic == "dot":
        return products
    return {"sweep": swept, "reduce": reduced, "points": scattered}.get(problem.operator, lifted)


def mode_of(scene: Scene) -> str:
    """The library's name of a mode."""
    smooth = "trilinear" if scene.problem.reads_volume else "bilinear"
    return {"smooth": smooth, "nearest": "nearest"}[scene.problem.mode]


def kernel(scene: Scene) -> dict[str, Callable[[], Any]]:
    """Only the CPU kernel, forward, and with backward to the source: sites are precomputed, memory is reused."""
    problem, source = scene.problem, scene.source
    if problem.device != "cpu" or problem.operator in ("reduce", "points") or problem.statistic == "dot":
        raise LeftOut("not one call of a kernel")
    reduce, is_sweep = problem.statistic or None, problem.is_sweep
    options = Options.checked("benchmark", "trilinear" if is_sweep else "bilinear", mode_of(scene), reduce=reduce)
    options = options._replace(flatten=problem.flatten)
    if reason := library.why_not("plane_sweep_project" if is_sweep else "unproject", source, options):
        raise LeftOut(reason)
    if is_sweep:
        where = scene.cameras, scene.grid, scene.depths, (problem.size,) * 2
        sites = sweep_sites("benchmark", source, *where, None, options)
        forward, backward, given, axis = library.plane_sweep_project, library.plane_sweep_project_backward, (sites,), 1
    else:
        sites = image_sites("benchmark", source, scene.cameras, scene.grid, None, options)
        forward, backward, given, axis = library.unproject, library.unproject_backward, (sites, None), 2
    needs = (True, *(False,) * (2 + len(given)))
    out, _ = forward(source, *given, options)
    gradient = scene.cotangent(out)
    into = channels_last(torch.zeros(source.shape), axis)

    def both() -> tuple[Tensor, Tensor]:
        forward(source, *given, options, out=out)
        into.zero_()  # the kernel accumulates
        return out, backward(gradient, source, *given, options, needs, into=into)[0]

    return {"forward": lambda: forward(source, *given, options, out=out)[0], "forward+backward": both}


def floors(count: int) -> dict[str, Callable[[], Any]]:
    """Writing this many bytes: into fresh memory, with the library's page policy, and repeatedly into the same memory.

    A freed large block returns to the system, so every fresh output has page faults.
    """
    shape = (count // 4,)
    buffer = library.empty(shape, torch.float32)
    return {COLD: lambda: library.empty(shape, torch.float32).fill_(1.0), WARM: lambda: buffer.fill_(1.0)}


COMPETITORS: Mapping[str, Callable[[Scene], Run]] = {
    OURS: ours,
    REFERENCE: partial(ours, backend="reference"),
    UNFUSED: partial(ours, fused=False),
    HAND: rivals.competitor,
    COMPILED: compiled.competitor,
    COMPILED_ANY: partial(compiled.competitor, dynamic=True),
    AUTOMATIC: partial(compiled.competitor, automatic=True),
    WARPER: rivals.depth_warper,
    HOMOGRAPHY: rivals.homographies,
    ATLAS: rivals.running_mean,
    MVSNET: rivals.variance_volume,
    DOT: rivals.dot_volume,
}


def gather(scene: Scene, names: Iterable[str]) -> tuple[dict[str, Run], dict[str, str]]:
    """The runs of those that can run, and the reasons of those that cannot."""
    runs, left_out = {}, {}
    for name in names:
        try:
            runs[name] = COMPETITORS[name](scene)
        except LeftOut as reason:
            left_out[name] = str(reason)
    return runs, left_out
