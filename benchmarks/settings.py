"""What the commands of this folder have in common."""

from __future__ import annotations

import argparse
import atexit
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks import contenders, timing
from benchmarks.problems import Problem

TINY = {"B": 2, "V": 2, "C": 8, "size": 16, "voxels": 8, "planes": 4, "outputs": 8}
SLOW_TO_START = (contenders.COMPILED, contenders.COMPILED_ANY, contenders.AUTOMATIC)


@dataclass(frozen=True)
class Settings:
    """How to run.

    Args:
        quick: tiny sizes, few rounds, nothing compiled: whether everything works, not how fast.
        repeats: rounds; None fills the time that each benchmark allows itself.
        device: "cpu" or "cuda".
        folder: where results go; None for nowhere.
    """

    quick: bool = False
    repeats: int | None = None
    device: str = "cpu"
    folder: Path | None = timing.RESULTS

    def sized(self, problem: Problem) -> Problem:
        """The problem, or its tiny form."""
        problem = problem.but(device=self.device)
        return problem.but(**TINY) if self.quick else problem

    def names(self, *names: str) -> list[str]:
        return [name for name in names if not (self.quick and name in SLOW_TO_START)]

    def save(self, name: str, cases: list[dict[str, Any]], **more: Any) -> None:
        """Write the results and print where."""
        if self.folder is not None:
            print(timing.save(name, timing.machine(self.device), cases, self.folder, **more), flush=True)


def parse(description: str | None, argv: Sequence[str] | None) -> Settings:
    """Settings from a command line; sets threads, and an empty cache, so that all compile times are of a first run."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="tiny sizes: whether everything works, not how fast")
    parser.add_argument("--repeats", type=int, help="rounds; by default as many as fit into the time allowed")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--results", type=Path, help="folder for the JSON; by default benchmarks/results")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")  # no pool of processes beside the timings
    if "TORCHINDUCTOR_CACHE_DIR" not in os.environ:
        cache = tempfile.mkdtemp(prefix="lsmgeo-benchmarks-")
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
        atexit.register(shutil.rmtree, cache, ignore_errors=True)
    # A quick run's figures mean nothing: they are kept only where asked for.
    folder = options.results or (None if options.quick else timing.RESULTS)
    repeats = 3 if options.quick and options.repeats is None else options.repeats
    return Settings(options.quick, repeats, options.device, folder)
