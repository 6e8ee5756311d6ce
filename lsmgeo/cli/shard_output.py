"""The output of `render` and `convert` on their shards, and their number of processes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["count_jobs", "print_shards", "print_skipped"]

MOST_SKIPPED = 5


def count_jobs(jobs: int) -> int:
    """The number of processes: one instead of all cores if joblib is not installed."""
    from importlib.util import find_spec

    if jobs == -1 and not find_spec("joblib"):
        print("lsmgeo: using one process; install lsmgeo[data] to use all cores", file=sys.stderr)
        return 1
    return jobs


def print_shards(shards: Sequence[Path], kept: int, out: str) -> None:
    """Print the number of shards, their folder, and the number that existed before."""
    megabytes = sum(path.stat().st_size for path in shards) / 1e6
    print(f"shards:   {len(shards)} in {Path(out).resolve()}, {megabytes:.0f} MB; {kept} existed already")


def print_skipped(skipped: Sequence[tuple[str, str]], what: str) -> None:
    """Print the number of ``what`` that were left out, and the reasons."""
    if skipped:
        print(f"skipped:  {len(skipped)} {what} that cannot be used")
        for path, reason in skipped[:MOST_SKIPPED]:
            print(f"          {path}: {reason}")
        if len(skipped) > MOST_SKIPPED:
            print(f"          and {len(skipped) - MOST_SKIPPED} more")
