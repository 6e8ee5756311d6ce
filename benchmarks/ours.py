"""The library's own calls, by backend."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import conv2d

from benchmarks.problems import LeftOut, Run, Scene
from lsmgeo import cameras, functional, kernels, rays

MODES = {False: {"smooth": "bilinear", "nearest": "nearest"}, True: {"smooth": "trilinear", "nearest": "nearest"}}


def contender(scene: Scene, backend: str = "auto") -> Run:
    """The public call."""
    problem = scene.problem
    names = [candidate.name for candidate in kernels.BACKENDS]
    if backend not in ("auto", *names):
        raise LeftOut(f"no backend of that name; there are {', '.join(names)}")
    size = (problem.size, problem.size)
    options = {"mode": MODES[problem.is_sweep][problem.mode], "backend": backend}

    def lifted(features: Tensor) -> tuple[Tensor, Tensor]:
        statistic = problem.statistic or None
        return functional.unproject(features, scene.cameras, scene.grid, reduce=statistic, **options)

    def products(features: Tensor) -> tuple[Tensor, None]:
        window = slice(scene.frustum_offset, scene.frustum_offset + problem.frustum_size)
        first = features[:, :1, :, None, window, window]  # at the frustum's own pixels nothing is to be interpolated
        others = cameras.CameraTensors(*(field[:, 1:] for field in scene.cameras))
        volume, _ = functional.unproject(features[:, 1:], others, scene.grid, **options)
        return (volume * first).mean(2), None

    def swept(volume: Tensor) -> tuple[Tensor, Tensor]:
        return functional.plane_sweep_project(
            volume, scene.cameras, scene.grid, scene.depths, size, flatten=problem.flatten, **options
        )

    def reduced(volume: Tensor) -> tuple[Tensor, Tensor]:
        return rays.project_reduce(volume, scene.cameras, scene.grid, scene.depths, scene.weight, None, size, **options)

    if problem.statistic == "dot":
        return products
    return {"sweep": swept, "reduce": reduced}.get(problem.operator, lifted)


def unfused(scene: Scene) -> Run:
    """The public sweep, then a convolution over all its channels: what the fused call spares."""
    problem = scene.problem
    if problem.operator != "reduce":
        raise LeftOut("there is nothing to fuse")
    size = (problem.size, problem.size)
    mode = MODES[True][problem.mode]

    def run(volume: Tensor) -> tuple[Tensor, Tensor]:
        maps, visible = functional.plane_sweep_project(volume, scene.cameras, scene.grid, scene.depths, size, mode=mode)
        mapped = conv2d(maps.flatten(0, 1), scene.weight[..., None, None])
        return mapped.unflatten(0, maps.shape[:2]), visible

    return run
