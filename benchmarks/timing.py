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


def interleaved(runs: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 2) -> dict[str, list[float]]:
    """Seconds of each run: one after another in turn, so that a busy moment meets all alike; the order alternates."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(-warm_up, repeats):
        for name in list(runs)[:: 1 if repeat % 2 else -1]:
            start = time.perf_counter()
            runs[name]()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if repeat >= 0:
                seconds[name].append(time.perf_counter() - start)
    return seconds


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


def machine(device: str) -> dict[str, Any]:
    """Where and when something was timed."""
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_before": os.getloadavg()[0],
        "torch": torch.__version__,
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
    }


def save(name: str, where: Mapping[str, Any], cases: list[dict[str, Any]]) -> Path:
    """Write results as JSON; returns the path."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": where, "cases": cases}, indent=2) + "\n", encoding="utf-8")
    return path


def table(cases: list[dict[str, Any]], columns: Mapping[str, str]) -> None:
    """Print the cases; columns are keys with their formats."""
    rows = [list(columns), *([format(case[key], form) for key, form in columns.items()] for case in cases)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(columns))]
    for first, *rest in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True))]
        print("  ".join(cells).rstrip(), flush=True)
