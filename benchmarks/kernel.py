"""The kernel alone: the low-level call, sites made beforehand, writing into memory that is in use already."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.ours import MODES
from benchmarks.problems import LeftOut, Scene, channels_last
from lsmgeo._sites import image_sites, sweep_sites
from lsmgeo.kernels import Options


def require_kernels() -> Any:
    """The module of the CPU kernels, or `LeftOut` with the reason why they cannot run."""
    try:
        from lsmgeo.kernels import cpu
    except ImportError as error:
        raise LeftOut("there are no CPU kernels") from error
    return cpu


def timed(scene: Scene) -> dict[str, Callable[[], Any]]:
    """Forward, and forward with backward to the source, on warm buffers."""
    problem, source = scene.problem, scene.source
    if problem.device != "cpu" or problem.operator == "reduce" or problem.statistic == "dot":
        raise LeftOut("not one call of a kernel")
    cpu = require_kernels()
    operator = "plane_sweep_project" if problem.is_sweep else "unproject"
    options = Options.checked(
        "benchmark", volume=problem.is_sweep, mode=MODES[problem.is_sweep][problem.mode],
        reduce=problem.statistic or None,
    )  # fmt: skip
    if reason := cpu.why_not(operator, source, options):
        raise LeftOut(reason)
    if problem.flatten and any(field.name == "stacked" for field in fields(options)):
        options = replace(options, stacked=True)
    if problem.is_sweep:
        size = (problem.size, problem.size)
        sites = sweep_sites("benchmark", source, scene.cameras, scene.grid, scene.depths, size, None, options)
        forward, backward, axis = cpu.volume, cpu.volume_backward, 1
    else:
        sites = image_sites("benchmark", source, scene.cameras, scene.grid, None, options)
        forward, backward, axis = cpu.images, cpu.images_backward, 2
    out, _ = forward(source, sites, options)
    gradient = scene.cotangent(out)
    into = channels_last(torch.zeros(source.shape), axis)
    needs = (True, False, False, False)

    def run_forward() -> Tensor:
        return forward(source, sites, options, out=out)[0]

    def run_both() -> tuple[Tensor, Tensor]:
        run_forward()
        into.zero_()  # it adds to what is there
        return out, backward(gradient, source, sites, options, needs, into=into)[0]

    return {"forward": run_forward, "forward+backward": run_both}
