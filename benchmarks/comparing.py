"""A problem and its competitors: equal results are required, times are interleaved, peak memory is measured."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks import competitors as who
from benchmarks import measuring
from benchmarks.measuring import Settings
from benchmarks.problems import TINY, LeftOut, Problem, Run, Scene

KINDS = FORWARD, BOTH = ("forward", "forward+backward")
# Relative norms of the difference. Competitors compute pixels in float32, which moves a sample by up to 1e-4 pixel or
# voxel; one in some hundred thousand samples changes its nearest cell by that.
TOLERANCES = {"float32": 3e-4, "float16": 5e-3, "bfloat16": 3e-2}
NEAREST = 1e-2
STATISTIC = 5e-3  # rounding at an image's border may add a view to a mean or remove it
INVISIBLE = 1e-4  # the fraction of samples at a border, where visibility may differ


class Different(AssertionError):
    """A competitor that computes something else."""


def compare(what: str, value: Tensor, expected: Tensor, limit: float) -> None:
    """Require a shape, and a small relative norm of the difference."""
    if value.shape != expected.shape:
        raise Different(f"{what} of shape {tuple(value.shape)}, not {tuple(expected.shape)}")
    norm = float(expected.float().norm())
    distance = float((value.float() - expected.float()).norm())
    if not norm > 0.0:
        raise Different(f"{what}: the reference is zero, which proves nothing")
    if not distance <= limit * norm:
        raise Different(f"{what} differ by {distance / norm:.1e} of their norm; at most {limit:.1e}")


def tolerance(problem: Problem) -> float:
    """Largest relative norm of a difference."""
    borders = NEAREST if problem.mode == "nearest" else STATISTIC if problem.statistic else 0.0
    return max(TOLERANCES[problem.dtype], borders)


def leaves(scene: Scene) -> list[Tensor]:
    """The inputs of gradients: the source, and the weights of a linear map."""
    source = scene.source.detach().requires_grad_()
    return [source, scene.weight.requires_grad_()] if scene.problem.operator == "reduce" else [source]


def forward(run: Run, inputs: list[Tensor]) -> tuple[Tensor, Tensor | None]:
    with torch.no_grad():
        return run(inputs[0])


def differentiate(run: Run, inputs: list[Tensor], cotangent: Tensor) -> tuple[Tensor, Tensor | None, list[Tensor]]:
    """Output, visibility, and the gradients."""
    output, visible = run(inputs[0])
    return output, visible, list(torch.autograd.grad(output, inputs, cotangent))


def check(scene: Scene, runs: Mapping[str, Run]) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Compare all with the reference.

    Returns:
        A cotangent for each competitor, in the memory layout of its output, and the seconds of its first calls:
        compilation, loading and layout.

    Raises:
        Different: results differ by more than rounding.
    """
    limit, inputs, reference = tolerance(scene.problem), leaves(scene), who.ours(scene, "reference")
    expected, expected_visible = forward(reference, inputs)
    cotangent = scene.cotangent(expected)
    expected_gradients = differentiate(reference, inputs, cotangent)[2]
    cotangents, first = {}, {}
    for name, run in runs.items():
        start = time.perf_counter()
        output, visible = forward(run, inputs)
        first[name] = time.perf_counter() - start
        compare(f"{name}: values", output, expected, limit)
        if visible is not None and expected_visible is not None:
            share = float((visible != expected_visible).double().mean())
            if share > INVISIBLE:
                raise Different(f"{name}: visibility differs at a share of {share:.1e} of the samples")
        cotangents[name] = torch.empty_like(output).copy_(cotangent)
        del output, visible
        start = time.perf_counter()
        gradients = differentiate(run, inputs, cotangents[name])[2]
        first[name] += time.perf_counter() - start
        for gradient, expected_gradient in zip(gradients, expected_gradients, strict=True):
            compare(f"{name}: gradient", gradient, expected_gradient, limit)
    return cotangents, first


def check_kernel(scene: Scene, kernel: Callable[[], tuple[Tensor, Tensor]], run: Run) -> None:
    """Compare only the kernel with a competitor that passed `check`.

    Raises:
        Different: results differ by more than rounding.
    """
    limit, inputs = tolerance(scene.problem), leaves(scene)
    shape = forward(run, inputs)[0].shape
    output, gradient = kernel()
    expected, _, gradients = differentiate(run, inputs, scene.cotangent(output).reshape(shape))
    compare("kernel: values", output.reshape(shape), expected.detach(), limit)
    compare("kernel: gradient", gradient, gradients[0], limit)


def timings(
    label: str,
    problem: Problem,
    names: Iterable[str],
    settings: Settings,
    *,
    floors: bool = False,
    budget: float = 10.0,
    fewest: int = measuring.FEWEST,
) -> list[dict[str, Any]]:
    """A case for each kind: times of each competitor, seconds of first calls, and reasons of competitors left out.

    With `floors` also the time to write the output, and that of only the kernel.

    Raises:
        Different: results differ by more than rounding.
    """
    started, problem = time.perf_counter(), sized(problem, settings)
    scene = Scene(problem)
    runs, left_out = who.gather(scene, taking_part(names, settings))
    cotangents, first = check(scene, runs)
    inputs = leaves(scene)
    kernel: dict[str, Callable[[], Any]] = {}
    if floors:
        try:
            kernel = who.kernel(scene)
            check_kernel(scene, kernel[BOTH], runs[who.OURS])
        except LeftOut as reason:
            left_out[who.KERNEL] = str(reason)
    cases = []
    for kind in KINDS:
        calls: dict[str, Callable[[], Any]] = {
            name: partial(forward, run, inputs)
            if kind == FORWARD
            else partial(differentiate, run, inputs, cotangents[name])
            for name, run in runs.items()
        }
        if kernel:
            calls[who.KERNEL] = kernel[kind]
        if floors and kind == FORWARD:
            calls |= who.floors(next(iter(cotangents.values())).nbytes)
        seconds = measuring.interleaved(calls, settings.repeats, budget=budget, fewest=fewest)
        cases.append(
            {
                "case": f"{label}, {kind}",
                "kind": kind,
                "problem": vars(problem),
                "times": {name: measuring.spread(taken) for name, taken in seconds.items()},
                "first_call_s": first,
                "left_out": left_out,
            }
        )
    print(f"  {label}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return cases


def sized(problem: Problem, settings: Settings) -> Problem:
    """The problem, or its tiny version."""
    tiny = {name: min(getattr(problem, name), most) for name, most in TINY.items()} if settings.quick else {}
    return problem.but(device=settings.device, **tiny)


def taking_part(names: Iterable[str], settings: Settings) -> list[str]:
    """All of them, or in a quick run those without compilation."""
    slow = (who.COMPILED, who.COMPILED_ANY, who.AUTOMATIC) if settings.quick else ()
    return [name for name in names if name not in slow]


def memory(problem: Problem, names: Iterable[str], settings: Settings, kind: str = BOTH) -> dict[str, dict[str, Any]]:
    """Peak memory of each competitor, on a CPU each in its own process.

    Returns:
        Bytes: "peak" above the inputs, and "above" that less output, visibility and gradients; or "left_out".
    """
    found: dict[str, dict[str, Any]] = {}
    for name in taking_part(names, settings):
        try:
            arguments = sized(problem, settings), name, kind
            found[name] = measuring.isolated(taken_by, *arguments, device=settings.device)
        except LeftOut as reason:
            found[name] = {"left_out": str(reason)}
    return found


def taken_by(problem: Problem, name: str, kind: str) -> dict[str, Any]:
    """The peak of one competitor, and the bytes of what it returns."""
    scene = Scene(problem)
    run, inputs = who.COMPETITORS[name](scene), leaves(scene)
    output, visible = forward(run, inputs)
    cotangent, size = scene.cotangent(output) if kind == BOTH else output, sum(leaf.nbytes for leaf in inputs)
    kept = {"output": output.nbytes, "visible": 0 if visible is None else visible.nbytes}
    kept["gradients"] = size if kind == BOTH else 0
    del output, visible
    call = partial(forward, run, inputs) if kind == FORWARD else partial(differentiate, run, inputs, cotangent)
    peak = measuring.peak(call, problem.device)
    return {**kept, "inputs": size, "peak": peak, "above": peak - sum(kept.values())}
