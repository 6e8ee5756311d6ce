"""The operators on a GPU: ``python -m benchmarks.gpu``.

Times are those of CUDA events; the latency of a call stands apart. Goals: at least 4 times as fast as hand-written
PyTorch, never slower than the compiled gather, and a share of the bandwidth of a copy, counting source and output once
each.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks import contenders as who
from benchmarks import gate, memory, report, timing
from benchmarks.measure import timings
from benchmarks.operators import ratio
from benchmarks.problems import Problem, Scene
from benchmarks.settings import Settings, parse

UNPROJECT, SWEEP = Problem("unproject", B=1), Problem("sweep", B=1)
WORK = (
    ("Unproject, 64^3", UNPROJECT.but(voxels=64), 0.7),
    ("Unproject, 128^3", UNPROJECT.but(voxels=128), 0.7),
    ("Unproject, 128^3, mean", UNPROJECT.but(voxels=128, statistic="mean"), None),
    ("Unproject, 128^3, variance", UNPROJECT.but(voxels=128, statistic="variance"), None),
    ("Sweep, 64^3, trilinear", SWEEP.but(voxels=64), 0.4),
    ("Sweep, 128^3, trilinear", SWEEP.but(voxels=128), 0.4),
    ("Sweep, 128^3, nearest", SWEEP.but(voxels=128, mode="nearest"), None),
)
COPIED = 1 << 30  # bytes


def copy_bandwidth(settings: Settings) -> float:
    """Bytes a second, read and written, of the device's own copy."""
    count = COPIED >> 8 if settings.quick else COPIED
    source = torch.zeros(count // 4, device=settings.device)
    target = torch.empty_like(source)
    seconds = timing.interleaved({"copy": lambda: target.copy_(source)}, 21, 3, device=settings.device)["copy"]
    return 2e3 * count / timing.spread(seconds)["median_ms"]


def latency(settings: Settings) -> dict[str, Any]:
    """Time until a call returns, for a problem so small that the device never keeps it waiting."""
    scene = Scene(Problem("unproject", B=1, V=2, C=4, size=8, voxels=4, device=settings.device))
    runs, _ = who.gather(scene, (who.OURS, who.HAND))
    source = gate.leaves(scene)[0]

    def call(run: Callable[..., Any]) -> float:
        start = time.perf_counter()
        with torch.no_grad():
            run(source)
        taken = time.perf_counter() - start
        if settings.device == "cuda":
            torch.cuda.synchronize()
        return taken

    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(220):
        for name, run in runs.items():
            taken = call(run)
            if number >= 20:
                seconds[name].append(taken)
    times = {name: timing.spread(values) for name, values in seconds.items()}
    return {"case": "Unproject, 4^3, until the call returns", "kind": "latency", "times": times, "left_out": {}}


def main(argv: Sequence[str] | None = None) -> None:
    settings = parse(__doc__, argv)
    if settings.device == "cuda" and not torch.cuda.is_available():
        print("no CUDA device")
        return
    bandwidth = copy_bandwidth(settings)
    print(f"copy: {bandwidth / 1e9:.1f} GB/s")
    cases = [latency(settings)]
    for label, problem, share in WORK:
        sized = settings.sized(problem)
        names = settings.names(who.OURS, who.HAND, who.COMPILED)
        made = timings(label, sized, names, repeats=settings.repeats, budget=5.0)
        for case in made:
            hand, reason = ratio(case, who.HAND, who.OURS)
            compiled, missing = ratio(case, who.COMPILED, who.OURS)
            case["goals"] = [
                report.goal(f"{who.HAND} : {who.OURS}", hand, 4.0, True, reason),
                report.goal(f"{who.COMPILED} : {who.OURS}", compiled, 1.0, True, missing),
            ]
            if share is not None and case["kind"] == "forward":
                moved = sized.result_bytes + Scene(sized).source.nbytes
                reached = 1e3 * moved / case["times"][who.OURS]["median_ms"]
                case["goals"].append(report.goal("share of the copy's bandwidth", reached / bandwidth, share, True))
        made[-1]["memory"] = {name: memory.measure(sized, name, made[-1]["kind"]) for name in names}
        cases += made
    report.show(report.time_rows(cases), "milliseconds")
    report.show(report.goal_rows(cases), "goals")
    report.show(report.memory_rows([case for case in cases if "memory" in case]), "peak memory, forward+backward")
    settings.save("gpu", cases, copy_bandwidth=bandwidth)


if __name__ == "__main__":
    main(["--device", "cuda", *sys.argv[1:]])
