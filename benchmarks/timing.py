"""Interleaved timing, and the file that keeps it."""

from __future__ import annotations

import datetime
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

RESULTS = Path(__file__).parent / "results"
FEWEST, MOST = 5, 31


def seconds_of(run: Callable[[], Any], device: str = "cpu") -> float:
    """Seconds of one call: by the clock on a CPU, by events on a GPU."""
    if device == "cuda":
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        run()
        end.record()
        end.synchronize()
        return begin.elapsed_time(end) * 1e-3
    start = time.perf_counter()
    result = run()
    del result  # giving its memory back is part of the call
    return time.perf_counter() - start


def interleaved(
    runs: Mapping[str, Callable[[], Any]],
    repeats: int | None = None,
    warm_up: int = 1,
    budget: float = 10.0,
    fewest: int = FEWEST,
    device: str = "cpu",
) -> dict[str, list[float]]:
    """Seconds of each run: one after another in turn, so that a busy moment meets all alike; the order alternates.

    Without `repeats` there are as many rounds as fit into `budget` seconds, between `fewest` and `MOST`.
    """
    names = list(runs)

    def turn(number: int) -> dict[str, float]:
        return {name: seconds_of(runs[name], device) for name in names[:: 1 if number % 2 else -1]}

    spent = 0.0
    for number in range(warm_up):
        spent = sum(turn(number).values())
    if repeats is None:
        repeats = min(MOST, max(fewest, int(budget / max(spent, 1e-6))))
    rounds = [turn(number) for number in range(repeats)]
    return {name: [taken[name] for taken in rounds] for name in names}


def spread(seconds: list[float]) -> dict[str, Any]:
    """Median and quartiles, in milliseconds."""
    quartiles = statistics.quantiles(seconds, n=4) if len(seconds) > 1 else 3 * seconds
    low, middle, high = (1e3 * value for value in quartiles)
    return {"median_ms": middle, "quartiles_ms": [low, high], "rounds": len(seconds)}


def summary(seconds: Mapping[str, list[float]]) -> dict[str, Any]:
    """Medians of two runs named "ours" and "rival", and two forms of their ratio."""
    ours, rival = seconds["ours"], seconds["rival"]
    ratios = [a / b for a, b in zip(ours, rival, strict=True)]
    return {
        "ours_ms": 1e3 * statistics.median(ours),
        "rival_ms": 1e3 * statistics.median(rival),
        "ratio_of_medians": statistics.median(ours) / statistics.median(rival),
        "median_of_ratios": statistics.median(ratios),
        "ratio_quartiles": statistics.quantiles(ratios, n=4)[::2],
        "repeats": len(ours),
    }


def processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def huge_pages() -> str:
    """When the system gives huge pages: "always", "madvise", "never", or "unknown"."""
    try:
        text = Path("/sys/kernel/mm/transparent_hugepage/enabled").read_text(encoding="ascii")
        return text.split("[")[1].split("]")[0]
    except (OSError, IndexError):
        return "unknown"


def machine(device: str) -> dict[str, Any]:
    """Where and when something was timed."""
    import kornia

    import lsmgeo

    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else processor(),
        "vector_instructions": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "huge_pages": huge_pages(),
        "load_before": os.getloadavg()[0],
        "system": f"{platform.system()} {platform.release()}",
        "lsmgeo": lsmgeo.__version__,
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
    }


def save(name: str, where: Mapping[str, Any], cases: list[dict[str, Any]], folder: Path = RESULTS, **more: Any) -> Path:
    """Write results as JSON; returns the path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    text = json.dumps({"machine": where, **more, "cases": cases}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def table(cases: list[dict[str, Any]], columns: Mapping[str, str]) -> None:
    """Print the cases; columns are keys with their formats."""
    rows = [list(columns), *([format(case[key], form) for key, form in columns.items()] for case in cases)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(columns))]
    for first, *rest in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True))]
        print("  ".join(cells).rstrip(), flush=True)
