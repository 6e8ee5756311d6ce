"""The smallest calls, one scene, view, channel and thread: what is paid before the kernels start."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks import measuring, report, rivals
from benchmarks.comparing import FORWARD, KINDS, compare
from benchmarks.competitors import HAND, OURS
from benchmarks.measuring import Settings
from benchmarks.problems import IMAGE, Problem, Scene
from lsmgeo import FrustumGrid, cameras, functional

SMALL = Problem("unproject", B=1, V=1, C=1, voxels=8, size=16, planes=8)
CALLS = 100  # of a round
BORDERS = 0.1  # relative norm: of samples within rounding of a border
GOALS = {"Unproject": (1.35, 2.2), "Sweep": (1.35, 2.2), "Splat": (None, None)}  # forward and both, ours : hand-written


def _measured(runs: dict[str, Callable[[], Any]], settings: Settings) -> dict[str, Any]:
    """Times of one call each, from rounds of many."""
    calls = 3 if settings.quick else CALLS

    def repeated(run: Callable[[], Any]) -> None:
        for _ in range(calls):
            run()

    taken = measuring.interleaved({name: partial(repeated, run) for name, run in runs.items()}, settings.repeats)
    return {name: measuring.spread([each / calls for each in seconds]) for name, seconds in taken.items()}


def _forward(run: Callable[[Tensor], Tensor], source: Tensor) -> Tensor:
    with torch.no_grad():
        return run(source)


def _both(run: Callable[[Tensor], Tensor], source: Tensor, cotangent: Tensor) -> tuple[Tensor, ...]:
    return torch.autograd.grad(run(source), source, cotangent)


def _runs() -> dict[str, tuple[Tensor, dict[str, Callable[[Tensor], Tensor]]]]:
    """For each operator its source, and the values from it; grids and their sites are made before."""
    images, volumes = Scene(SMALL), Scene(SMALL.but(operator="sweep"))
    views, grid, depths = images.cameras, images.grid, images.depths
    K, E, centers = views.intrinsics, views.cam_from_world, grid.centers()
    full, size = (IMAGE, IMAGE), (SMALL.size, SMALL.size)
    weights = torch.rand(1, 1, SMALL.planes, *size, generator=torch.Generator().manual_seed(5))
    lifted = {
        OURS: lambda source: functional.unproject(source, views, grid).volume,
        HAND: lambda source: rivals.unproject(source, K, E, centers, full)[0],
    }
    swept = {
        OURS: lambda source: functional.plane_sweep_project(source, views, grid, depths, size, flatten=False).maps,
        HAND: lambda source: rivals.plane_sweep_project(source, K, E, depths, full, size, "smooth")[0],
    }
    splat = {OURS: lambda source: functional.splat(source, views, grid, depths, weights=weights)}
    return {
        "Unproject": (images.source, lifted),
        "Sweep": (volumes.source, swept),
        "Splat": (images.source, splat),
    }


def measure(settings: Settings) -> list[dict[str, Any]]:
    """Times of the operators, and of making a `FrustumGrid`, each beside its rival in one interleaved run."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*_operators(settings), _frustum(settings)]
    finally:
        torch.set_num_threads(threads)


def _operators(settings: Settings) -> list[dict[str, Any]]:
    cases = []
    for label, (source, runs) in _runs().items():
        outputs = {name: _forward(run, source) for name, run in runs.items()}
        if HAND in outputs:
            compare(f"{label}, {HAND}", outputs[HAND], outputs[OURS], BORDERS)
        leaf, cotangent = source.clone().requires_grad_(), torch.ones_like(outputs[OURS])
        for kind, target in zip(KINDS, GOALS[label], strict=True):
            calls: dict[str, Callable[[], Any]] = {
                name: partial(_forward, run, leaf) if kind == FORWARD else partial(_both, run, leaf, cotangent)
                for name, run in runs.items()
            }
            case = {"case": f"{label}, 1 x 1 x 1 x 8^3, {kind}", "kind": kind, "left_out": {}}
            case["times"] = _measured(calls, settings)
            case["goals"] = [] if target is None else [report.ratio(case, OURS, HAND, target, False)]
            cases.append(case)
    return cases


def _frustum(settings: Settings) -> dict[str, Any]:
    scene = Scene(SMALL)
    camera, depths = cameras.select(scene.cameras, 1, 0), scene.depths
    times = _measured({OURS: lambda: FrustumGrid(camera, depths)}, settings)
    return {"case": "FrustumGrid, making one", "times": times, "left_out": {}, "goals": []}
