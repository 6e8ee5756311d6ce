"""The operators against hand-written and compiled PyTorch, and other systems: times, memory, goals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from benchmarks import competitors as who
from benchmarks import measuring, report
from benchmarks.comparing import BOTH, FORWARD, KINDS, memory, taking_part, timings
from benchmarks.measuring import Settings
from benchmarks.problems import Problem

UNPROJECT, SWEEP, FRUSTUM = Problem("unproject"), Problem("sweep", size=56), Problem("frustum", B=1)
MEAN, VARIANCE = UNPROJECT.but(statistic="mean"), UNPROJECT.but(statistic="variance")

# label, problem, rounds' seconds, {kind: (hand-written : ours, ours : floor, hand-written : kernel)}
SWEEP_GOALS = {FORWARD: (10.0, 1.6, 20.0), BOTH: (10.0, None, 16.0)}
STATISTIC_GOALS = {BOTH: (7.0, None, 12.0)}
WORK = (
    ("Unproject", UNPROJECT, 6.0, {FORWARD: (3.0, 1.6, 5.0), BOTH: (6.0, None, 10.0)}),
    ("Unproject, mean", MEAN, 8.0, STATISTIC_GOALS),
    ("Unproject, variance", VARIANCE, 8.0, STATISTIC_GOALS),
    ("Sweep, trilinear", SWEEP, 20.0, SWEEP_GOALS),
    ("Sweep, nearest", SWEEP.but(mode="nearest"), 20.0, SWEEP_GOALS),
    ("Sweep, trilinear, flattened", SWEEP.but(flatten=True), 20.0, SWEEP_GOALS),
    ("Sweep, nearest, flattened", SWEEP.but(mode="nearest", flatten=True), 20.0, SWEEP_GOALS),
)
COPIED = ("Unproject", "Unproject, variance", "Sweep, trilinear")  # also from sources in contiguous memory
REFERENCE_TARGETS = {FORWARD: 1.25, BOTH: 1.15}


def goals(case: dict[str, Any], targets: tuple[float, float | None, float] | None) -> list[dict[str, Any]]:
    """The goals of a case."""
    hand, floor, kernel = targets or (None, None, None)
    reference = REFERENCE_TARGETS[case["kind"]] if who.REFERENCE in case["times"] else None
    promised = (
        (who.COMPILED, who.OURS, 1.0, True),
        (who.HAND, who.OURS, hand, True),
        (who.OURS, who.COLD, floor, False),
        (who.HAND, who.KERNEL, kernel, True),
        (who.REFERENCE, who.HAND, reference, False),
    )
    return [report.ratio(case, top, bottom, aim, least) for top, bottom, aim, least in promised if aim is not None]


def channels_last(settings: Settings) -> list[dict[str, Any]]:
    """All work, from sources in channels-last memory."""
    cases = []
    for label, problem, seconds, targets in WORK:
        more = (who.REFERENCE, who.AUTOMATIC) if label == "Unproject" else ()
        names = (who.OURS, who.HAND, who.COMPILED, *more)
        made = timings(label, problem, names, settings, floors=True, budget=seconds)
        for case in made:
            case["goals"] = goals(case, targets.get(case["kind"]))
        cases += made
    return cases


def contiguous(settings: Settings) -> list[dict[str, Any]]:
    """Some work, from sources in contiguous memory, of which the library copies what it reads."""
    cases = []
    for label, problem, seconds, _ in WORK:
        if label in COPIED:
            names = (who.OURS, who.HAND, who.COMPILED, *((who.REFERENCE,) if label == "Unproject" else ()))
            sources = problem.but(layout="contiguous")
            cases += timings(label, sources, names, settings, floors=True, budget=seconds)
    return cases


def footprint(settings: Settings) -> list[dict[str, Any]]:
    """Memory of statistics without the views' volumes, 128^3 voxels, a sweep with its 1x1 map fused."""
    cases: list[dict[str, Any]] = []
    for problem in (MEAN, VARIANCE):
        taken = memory(problem, (who.OURS, who.REFERENCE, who.HAND, who.COMPILED), settings)
        ours = taken[who.OURS]
        share = None if "left_out" in ours else ours["above"] / ours["output"]
        what, reason = "peak above inputs, outputs, gradients : output", ours.get("left_out", "")
        label = f"Unproject, {problem.statistic}, {BOTH}"
        cases.append({"case": label, "memory": taken, "goals": [report.goal(what, share, 0.2, False, reason)]})

    large = UNPROJECT.but(B=1, V=8, voxels=128, statistic="mean")
    taken = memory(large, (who.OURS,), settings)
    ours = taken[who.OURS]
    share = None if "left_out" in ours else 1.0 + ours["above"] / (ours["inputs"] + ours["peak"] - ours["above"])
    met = [report.goal("peak : inputs, output, gradients", share, 1.1, False, ours.get("left_out", ""))]
    volumes = 4e-9 * large.V * large.C * large.sites
    reason = f"the volumes of its views take {volumes:.1f} GB, and several of them exist at once"
    series = []
    for side in (4, 8) if settings.quick else (32, 64, 128):
        series += timings(f"{side}^3 voxels, 8 views, mean", large.but(voxels=side), [who.OURS], settings, budget=4.0)
    for kind in KINDS:
        some = [case for case in series if case["kind"] == kind]
        sites = [3 * math.log(case["problem"]["voxels"]) for case in some]
        times = [math.log(case["times"][who.OURS]["median_ms"]) for case in some]
        power = float(np.polynomial.Polynomial.fit(sites, times, 1).convert().coef[1])
        met.append(report.goal(f"time grows as voxels to the power, {kind}", power, 1.1, False))
    label, left_out = f"128^3 voxels, 8 views, mean, {BOTH}", dict.fromkeys((who.HAND, who.COMPILED), reason)
    cases += [{"case": label, "memory": taken, "goals": met, "left_out": left_out, "times": {}}, *series]

    both, label, names = Problem("reduce", size=56), "Sweep and 1x1 map, 32 x 64 to 512", (who.OURS, who.UNFUSED)
    for case in timings(label, both, names, settings, budget=15.0):
        case["memory"] = memory(both, names, settings, case["kind"])
        ours, apart = case["memory"].values()
        reason = ours.get("left_out", apart.get("left_out", ""))
        saved = None if reason else apart["above"] / max(ours["above"], 1)
        what, time = "peak above inputs, outputs, gradients, unfused : fused", report.ratio(case, *names, 1.05, False)
        case["goals"] = [report.goal(what, saved, 10.0, True, reason), {**time, "goal": "time, fused : unfused"}]
        cases.append(case)
    return cases


SYSTEMS = (
    ("Frustum, volume of each view", FRUSTUM, (who.HAND, who.WARPER, who.HOMOGRAPHY)),
    ("Frustum, variance", FRUSTUM.but(statistic="variance"), (who.HAND, who.WARPER, who.HOMOGRAPHY, who.MVSNET)),
    ("Frustum, products with the first view", FRUSTUM.but(statistic="dot"), (who.DOT,)),
    ("Voxels, mean of nearest pixels", MEAN.but(mode="nearest"), (who.HAND, who.ATLAS)),
    ("Volume at scattered points", Problem("points", size=56), (who.HAND,)),
)


def systems(settings: Settings) -> list[dict[str, Any]]:
    """Warps of kornia plane by plane; loops over the views in the styles of Atlas and MVSNet; correlation volumes."""
    cases = []
    for label, problem, rivals in SYSTEMS:
        names = (who.OURS, *rivals)
        cases += timings(label, problem, names, settings, budget=6.0, fewest=3)
        cases[-1]["memory"] = memory(problem, names, settings)
    return cases


DTYPES, THREADS = ("float32", "bfloat16", "float16"), (1, 2)
GROWTH: tuple[tuple[str, Problem, dict[str, tuple[Any, ...]]], ...] = (
    (
        "Unproject, mean",
        MEAN.but(B=1),
        {"voxels": (16, 32, 64, 128), "V": (1, 4, 16), "C": (8, 32, 128), "size": (28, 112)},
    ),
    ("Sweep, trilinear", SWEEP.but(B=1), {"voxels": (16, 32, 64), "V": (1, 4), "C": (8, 32), "size": (28, 56)}),
)
LARGEST = 600e6  # bytes of all views' values from which only the library's fast path is timed


def growth(settings: Settings) -> list[dict[str, Any]]:
    """How cost grows along one axis at a time."""
    cases = []
    for label, base, sizes in GROWTH:
        axes = {**sizes, "dtype": DTYPES, "threads": THREADS}
        for axis, values in ({"voxels": (4, 8), "threads": THREADS} if settings.quick else axes).items():
            for value in values:
                problem = base if axis == "threads" else base.but(**{axis: value})
                cases += point(label, problem, axis, value, settings)
    return cases


def point(label: str, problem: Problem, axis: str, value: Any, settings: Settings) -> list[dict[str, Any]]:
    """Times of one point, and its peak memory on the axes along which memory grows."""
    names = [who.OURS, *((who.REFERENCE,) if axis in ("voxels", "dtype") else ()), who.HAND, who.COMPILED_ANY]
    held = torch.finfo(problem.torch_dtype).bits // 8 * problem.B * problem.V * problem.C * problem.sites
    left_out = {}
    if held > LARGEST:
        reason = f"the values of all views take {held / 1e9:.1f} GB: too much memory, or time, for one point"
        left_out = {name: reason for name in taking_part(names, settings) if name != who.OURS}
    threads = torch.get_num_threads()
    if axis == "threads":
        torch.set_num_threads(value)
        left_out[who.COMPILED_ANY] = "compiled for one number of threads"
    names = [name for name in names if name not in left_out]
    try:
        cases = timings(f"{label}, {axis} = {value}", problem, names, settings, budget=2.5, fewest=3)
    finally:
        torch.set_num_threads(threads)
    for case in cases:
        case.update(operator=label, axis=axis, value=value, left_out={**case["left_out"], **left_out})
    if axis in ("voxels", "V", "C"):
        measured = [name for name in names if name != who.COMPILED_ANY]  # each process would compile again
        cases[-1]["memory"] = memory(problem, measured, settings)
    return cases


ONE, ONE_SWEEP = UNPROJECT.but(B=1, voxels=128), Problem("sweep", B=1, voxels=128)
# label, problem, goal as a fraction of a copy's bandwidth
GPU = (
    ("Unproject, 64^3", ONE.but(voxels=64), 0.7),
    ("Unproject, 128^3", ONE, 0.7),
    ("Unproject, 128^3, mean", ONE.but(statistic="mean"), None),
    ("Unproject, 128^3, variance", ONE.but(statistic="variance"), None),
    ("Sweep, 64^3, trilinear", ONE_SWEEP.but(voxels=64), 0.4),
    ("Sweep, 128^3, trilinear", ONE_SWEEP, 0.4),
    ("Sweep, 128^3, nearest", ONE_SWEEP.but(mode="nearest"), None),
)


def gpu(settings: Settings) -> list[dict[str, Any]]:
    """The operators on a GPU, and the fraction of a copy's bandwidth, counting source and output once each."""
    source = torch.zeros(1 << (20 if settings.quick else 28), device=settings.device)
    target = torch.empty_like(source)
    taken = measuring.interleaved({"copy": lambda: target.copy_(source)}, 21, 3)["copy"]
    bandwidth = 2e3 * source.nbytes / measuring.spread(taken)["median_ms"]
    print(f"copy: {bandwidth / 1e9:.1f} GB/s")
    cases = []
    for label, problem, share in GPU:
        names = (who.OURS, who.HAND, who.COMPILED)
        made, taken = timings(label, problem, names, settings, budget=5.0), memory(problem, names, settings)
        for case in made:
            rivals = (who.HAND, 4.0), (who.COMPILED, 1.0)
            case["goals"] = [report.ratio(case, name, who.OURS, target) for name, target in rivals]
        if share is not None and "peak" in taken[who.OURS]:
            moved = 1e3 * sum(taken[who.OURS][key] for key in ("inputs", "output"))
            reached = moved / made[0]["times"][who.OURS]["median_ms"] / bandwidth
            made[0]["goals"].append(report.goal("share of the copy's bandwidth", reached, share, True))
        made[-1]["memory"] = taken
        cases += made
    return cases
