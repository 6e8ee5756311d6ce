"""One problem, timed: gate first, then all contenders in turn."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

import torch

from benchmarks import contenders, floor, gate, kernel, timing
from benchmarks.problems import LeftOut, Problem, Run, Scene

KINDS = ("forward", "forward+backward")


def timings(
    label: str,
    problem: Problem,
    names: Iterable[str],
    kinds: Iterable[str] = KINDS,
    *,
    floors: bool = False,
    kernels: bool = False,
    repeats: int | None = None,
    budget: float = 10.0,
    fewest: int = timing.FEWEST,
) -> list[dict[str, Any]]:
    """A case for each kind: times of each contender, seconds of first calls, and who was left out and why.

    Raises:
        gate.Different: one of them computes something else.
    """
    started = time.perf_counter()
    scene = Scene(problem)
    runs, left_out = contenders.gather(scene, names)
    cotangents, first = gate.check(scene, runs, backward="forward+backward" in kinds)
    inputs = gate.leaves(scene)
    low: dict[str, Callable[[], Any]] = {}
    if kernels:
        try:
            low = kernel.timed(scene)
        except LeftOut as reason:
            left_out[contenders.KERNEL] = str(reason)
    cases = []
    for kind in kinds:
        turns = {name: _turn(scene, run, kind, inputs, cotangents[name]) for name, run in runs.items()}
        if kind in low:
            turns[contenders.KERNEL] = low[kind]
        if floors and kind == "forward":
            turns[contenders.COLD] = floor.cold(problem.result_bytes)
            turns[contenders.WARM] = floor.warm(problem.result_bytes)
        gc.collect()
        seconds = timing.interleaved(turns, repeats, budget=budget, fewest=fewest, device=problem.device)
        cases.append(
            {
                "case": f"{label}, {kind}",
                "kind": kind,
                "problem": problem.as_dict(),
                "times": {name: timing.spread(taken) for name, taken in seconds.items()},
                "first_call_s": first,
                "left_out": left_out,
            }
        )
    print(f"  {label}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return cases


def _turn(scene: Scene, run: Run, kind: str, inputs: list[torch.Tensor], cotangent: torch.Tensor) -> Callable[[], Any]:
    def forward() -> Any:
        with torch.no_grad():
            return run(inputs[0])

    def both() -> Any:
        return gate.differentiate(scene, run, inputs, cotangent)

    return forward if kind == "forward" else both
