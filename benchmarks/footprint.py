"""Memory, and what it buys: ``python -m benchmarks.footprint``.

Statistics over views without the views' volumes, 128^3 voxels, and a sweep with its 1x1 map fused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from benchmarks import contenders as who
from benchmarks import memory, report
from benchmarks.measure import timings
from benchmarks.problems import Problem
from benchmarks.settings import Settings, parse

UNPROJECT = Problem("unproject")
LARGE = Problem("unproject", B=1, V=8, voxels=128, statistic="mean")
REDUCE = Problem("reduce", size=56)
BACK = "forward+backward"


def needed(taken: dict[str, Any]) -> float:
    """Bytes of output, visibility and gradients."""
    return taken["output"] + taken["visible"] + taken["gradients"]


def statistics(settings: Settings) -> list[dict[str, Any]]:
    cases = []
    for statistic in ("mean", "variance"):
        problem = settings.sized(UNPROJECT.but(statistic=statistic))
        names = settings.names(who.OURS, who.REFERENCE, who.HAND, who.COMPILED)
        taken = {name: memory.measure(problem, name, BACK, torch.get_num_threads()) for name in names}
        ours = taken[who.OURS]
        share = None if "left_out" in ours else ours["above"] / ours["output"]
        goal = report.goal(
            "peak above inputs, outputs, gradients : output", share, 0.2, False, ours.get("left_out", "")
        )
        cases.append({"case": f"Unproject, {statistic}, {BACK}", "memory": taken, "goals": [goal]})
    return cases


def large(settings: Settings) -> list[dict[str, Any]]:
    """128^3 voxels of 8 views, and time against the number of voxels."""
    problem = settings.sized(LARGE)
    ours = memory.measure(problem, who.OURS, BACK, torch.get_num_threads())
    share = None if "left_out" in ours else 1.0 + ours["above"] / (ours["inputs"] + needed(ours))
    goals = [
        report.goal("peak : inputs, output, gradients", share, 1.1, False, ours.get("left_out", "")),
    ]
    volumes = LARGE.V * LARGE.C * LARGE.voxels**3 * 4 / 1e9
    reason = f"the volumes of its views take {volumes:.1f} GB, and several of them exist at once"
    left_out = {name: reason for name in (who.HAND, who.COMPILED)}
    sides = (4, 8) if settings.quick else (32, 64, 128)
    series = []
    for side in sides:
        sized = problem.but(voxels=side)
        series += timings(
            f"{side}^3 voxels, {sized.V} views, mean", sized, [who.OURS], repeats=settings.repeats, budget=4.0
        )
    for kind in ("forward", BACK):
        times = [report.median(case, who.OURS) for case in series if case["kind"] == kind]
        power = slope([3 * math.log(side) for side in sides], [math.log(time or math.nan) for time in times])
        goals.append(report.goal(f"time grows as voxels to the power, {kind}", power, 1.1, False))
    label = f"{problem.voxels}^3 voxels, {problem.V} views, mean, {BACK}"
    return [{"case": label, "memory": {who.OURS: ours}, "goals": goals, "left_out": left_out, "times": {}}, *series]


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Of the line of least squares."""
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    above = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    return above / sum((a - mean_x) ** 2 for a in x)


def fused(settings: Settings) -> list[dict[str, Any]]:
    """A sweep and a 1x1 convolution, in one call and in two."""
    problem = settings.sized(REDUCE)
    names = (who.OURS, who.UNFUSED)
    label = f"Sweep and 1x1 map, {problem.C} x {problem.planes} to {problem.outputs}"
    cases = timings(label, problem, names, repeats=settings.repeats, budget=15.0)
    for case in cases:
        threads = torch.get_num_threads()
        taken = {name: memory.measure(problem, name, case["kind"], threads) for name in names}
        reasons = [taken[name]["left_out"] for name in names if "left_out" in taken[name]]
        saved = None if reasons else taken[who.UNFUSED]["above"] / max(taken[who.OURS]["above"], 1)
        time = cases_ratio(case)
        case["memory"] = taken
        case["goals"] = [
            report.goal(
                "peak above inputs, outputs, gradients, unfused : fused", saved, 10.0, True, "".join(reasons[:1])
            ),
            report.goal("time, fused : unfused", time, 1.05, False),
        ]
    return cases


def cases_ratio(case: dict[str, Any]) -> float:
    return case["times"][who.OURS]["median_ms"] / case["times"][who.UNFUSED]["median_ms"]


def main(argv: Sequence[str] | None = None) -> None:
    settings = parse(__doc__, argv)
    cases = statistics(settings) + large(settings) + fused(settings)
    report.show(report.memory_rows([case for case in cases if "memory" in case]), "peak memory")
    report.show(report.time_rows([case for case in cases if case.get("times")]), "milliseconds")
    report.show(report.goal_rows(cases), "goals")
    settings.save("footprint", cases)


if __name__ == "__main__":
    main()
