"""How cost grows along one axis at a time: ``python -m benchmarks.growth``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from benchmarks import contenders as who
from benchmarks import memory, report
from benchmarks.measure import timings
from benchmarks.problems import Problem
from benchmarks.settings import Settings, parse

BASES = {
    "Unproject, mean": Problem("unproject", B=1, statistic="mean"),
    "Sweep, trilinear": Problem("sweep", B=1, size=56),
}
AXES: dict[str, dict[str, tuple[Any, ...]]] = {
    "Unproject, mean": {
        "voxels": (16, 32, 64, 128),
        "V": (1, 4, 16),
        "C": (8, 32, 128),
        "size": (28, 112),
        "dtype": ("float32", "bfloat16", "float16"),
        "threads": (1, 2),
    },
    "Sweep, trilinear": {
        "voxels": (16, 32, 64),
        "V": (1, 4),
        "C": (8, 32),
        "size": (28, 56),
        "dtype": ("float32", "bfloat16", "float16"),
        "threads": (1, 2),
    },
}
NAMES = (who.OURS, who.REFERENCE, who.HAND, who.COMPILED_ANY)
LARGEST = 600e6  # bytes of the values of all views from which only the library's fast path is timed
MEMORY_AXES = ("voxels", "V", "C")
REFERENCE_AXES = ("voxels", "dtype")


def point(label: str, problem: Problem, axis: str, value: Any, settings: Settings) -> list[dict[str, Any]]:
    """Times of one point, and its peak memory on the axes along which memory grows."""
    names = settings.names(*(name for name in NAMES if name != who.REFERENCE or axis in REFERENCE_AXES))
    width = torch.finfo(problem.torch_dtype).bits // 8
    held = width * problem.B * problem.V * problem.C * problem.sites
    left_out = {}
    if held > LARGEST:
        reason = f"the values of all views take {held / 1e9:.1f} GB: too much memory, or time, for one point"
        left_out = {name: reason for name in names if name != who.OURS}
    threads = torch.get_num_threads()
    if axis == "threads":
        torch.set_num_threads(value)
        # A graph is compiled for a number of threads.
        left_out[who.COMPILED_ANY] = "compiled for one number of threads"
    names = [name for name in names if name not in left_out]
    try:
        cases = timings(f"{label}, {axis} = {value}", problem, names, repeats=settings.repeats, budget=2.5, fewest=3)
    finally:
        torch.set_num_threads(threads)
    for case in cases:
        case.update(operator=label, axis=axis, value=value, left_out={**case["left_out"], **left_out})
    if axis in MEMORY_AXES:
        measured = [name for name in names if name != who.COMPILED_ANY]  # each process would compile anew
        cases[-1]["memory"] = {name: memory.measure(problem, name, "forward+backward", threads) for name in measured}
    return cases


def main(argv: Sequence[str] | None = None) -> None:
    settings = parse(__doc__, argv)
    cases = []
    measured: dict[Problem, list[dict[str, Any]]] = {}
    for label, base in BASES.items():
        axes = {axis: AXES[label][axis][:2] for axis in ("voxels", "dtype")} if settings.quick else AXES[label]
        for axis, values in axes.items():
            for value in values:
                problem = settings.sized(base)
                if axis == "dtype" or (axis != "threads" and not settings.quick):
                    problem = problem.but(**{axis: value})
                if axis == "threads" or problem not in measured:
                    measured[problem] = point(label, problem, axis, value, settings)
                # The base is a point of every axis.
                cases += [
                    {**case, "axis": axis, "value": value, "case": f"{label}, {axis} = {value}, {case['kind']}"}
                    for case in measured[problem]
                ]
            settings.save("growth", cases)  # a run that is cut short leaves what it has
    report.show(report.time_rows(cases), "milliseconds")
    report.show(report.memory_rows([case for case in cases if "memory" in case]), "peak memory, forward+backward")
    report.show(report.left_out_rows([case for case in cases if case["kind"] == "forward"]), "left out")


if __name__ == "__main__":
    main()
