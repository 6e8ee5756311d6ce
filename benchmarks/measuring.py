"""Time, peak memory, the machine, and the file of results."""

from __future__ import annotations

import ctypes
import datetime
import gc
import json
import multiprocessing
import os
import platform
import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kornia
import torch
from torch.utils.benchmark import timer

import lsmgeo
from benchmarks.problems import LeftOut

RESULTS = Path(__file__).parent / "results"
FEWEST, MOST = 5, 31
STATUS, REFERENCES, PROCESSORS = Path("/proc/self/status"), Path("/proc/self/clear_refs"), Path("/proc/stat")
QUIET, TRIES = 0.05, 3  # share of the processors that others may use before a run is taken again

# The share that others used during each run that was kept.
others: list[float] = []


@dataclass(frozen=True)
class Settings:
    """How to run."""

    quick: bool = False  # tiny sizes, few rounds, no compilation: checks that everything works, not how fast
    repeats: int | None = None  # rounds; None fills the time budget of each benchmark
    device: str = "cpu"  # or "cuda"
    data: Path | None = None  # folder of the sets that cannot be distributed; None where there is none
    only: str = ""  # of a benchmark in several parts, those whose name holds this


def interleaved(
    runs: Mapping[str, Callable[[], Any]],
    repeats: int | None = None,
    warm_up: int = 1,
    budget: float = 10.0,
    fewest: int = FEWEST,
) -> dict[str, list[float]]:
    """Seconds of each run, interleaved so that other load affects all equally; the order alternates.

    Without `repeats` there are as many rounds as fit into `budget` seconds, between `fewest` and `MOST`. The clock
    waits for a GPU. Where other processes use more than `QUIET` of the processors meanwhile, the rounds are taken
    again, unless their number is given, and the quietest of `TRIES` is kept.
    """
    order = list(runs)

    def round_of_all(taken: dict[str, list[float]]) -> float:
        order.reverse()
        for name in order:
            start = timer()
            result = runs[name]()
            del result  # freeing its memory is part of the call
            taken[name].append(timer() - start)
        return sum(seconds[-1] for seconds in taken.values())

    spent = [round_of_all({name: [] for name in runs}) for _ in range(warm_up)]
    tries = TRIES if repeats is None else 1
    if repeats is None:
        repeats = min(MOST, max(fewest, int(budget / max(spent[-1], 1e-6))))
    kept, least = {}, float("inf")
    for _ in range(tries):
        taken: dict[str, list[float]] = {name: [] for name in runs}
        start, before, own = timer(), _busy_seconds(), _own_seconds()
        for _ in range(repeats):
            round_of_all(taken)
        used = max(0.0, _busy_seconds() - before - (_own_seconds() - own))
        share = used / ((timer() - start) * (os.cpu_count() or 1))
        if share < least:
            kept, least = taken, share
        if least <= QUIET:
            break
    others.append(least)
    return kept


def _busy_seconds() -> float:
    """Seconds that all processors have worked, for any process; 0 where the system does not say."""
    try:
        fields = [int(field) for field in PROCESSORS.read_text(encoding="ascii").splitlines()[0].split()[1:9]]
    except (OSError, ValueError):
        return 0.0
    return (sum(fields) - fields[3] - fields[4]) / os.sysconf("SC_CLK_TCK")  # less idle, and waiting for a disk


def _own_seconds() -> float:
    """Seconds that this process and its children that ended have worked."""
    return sum(os.times()[:4])


def spread(seconds: list[float]) -> dict[str, Any]:
    """Median and quartiles, in milliseconds."""
    quartiles = statistics.quantiles(seconds, n=4) if len(seconds) > 1 else 3 * seconds
    low, middle, high = (1e3 * value for value in quartiles)
    return {"median_ms": middle, "quartiles_ms": [low, high], "rounds": len(seconds)}


def rate(case: str, unit: str, rates: Iterable[float], target: float | None = None) -> dict[str, Any]:
    """A case of a rate per second, measured in several rounds."""
    found = sorted(rates)
    middle = statistics.median(found)
    return {"case": case, "unit": unit, "rate": middle, "slowest": found[0], "fastest": found[-1], "target": target}


def peak(run: Callable[[], Any], device: str = "cpu") -> int:
    """Peak bytes of a call above those in use before it.

    PyTorch counts on a GPU. Linux keeps the high-water mark of a process's resident memory (VmHWM) and sets it back on
    request.

    Raises:
        LeftOut: this system does not report a peak.
    """
    run()  # pools, caches and code of the first call are not counted
    gc.collect()
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    if not os.access(REFERENCES, os.W_OK):
        raise LeftOut("this system does not report a peak")
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)  # freed blocks of the first call would be reused uncounted
    before = _status("VmRSS")
    REFERENCES.write_text("5", encoding="ascii")
    run()
    return _status("VmHWM") - before


def _status(key: str) -> int:
    line = next(line for line in STATUS.read_text(encoding="ascii").splitlines() if line.startswith(key + ":"))
    return int(line.split()[1]) * 1024


def _call(threads: int, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    torch.set_num_threads(threads)
    return function(*arguments)


def isolated(function: Callable[..., Any], *arguments: Any, device: str = "cpu", limit: float = 300.0) -> Any:
    """The result of a function; on a CPU in its own process, forked from one that has imported everything.

    Raises:
        LeftOut: out of memory, or no result within `limit` seconds.
    """
    if device == "cuda":
        return function(*arguments)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.comparing"])
    try:
        with context.Pool(1) as pool:
            return pool.apply_async(_call, (torch.get_num_threads(), function, arguments)).get(limit)
    except multiprocessing.TimeoutError:
        raise LeftOut("took too long, or ended early, most likely out of memory") from None
    except MemoryError:
        raise LeftOut("no memory") from None


def processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def huge_pages() -> str:
    """When the system provides huge pages: "always", "madvise", "never", or "unknown"."""
    try:
        text = Path("/sys/kernel/mm/transparent_hugepage/enabled").read_text(encoding="ascii")
        return text.split("[")[1].split("]")[0]
    except (OSError, IndexError):
        return "unknown"


def machine(device: str = "cpu") -> dict[str, Any]:
    """Where and when something was measured."""
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


def save(path: Path, where: Mapping[str, Any], cases: list[dict[str, Any]]) -> None:
    """Write results as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    where = {**where, "others": max(others, default=None)}
    text = json.dumps({"machine": where, "cases": cases}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
