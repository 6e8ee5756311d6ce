"""What `render` and `convert` print of the shards that they made, and how many processes they take."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["count_jobs", "print_shards", "print_skipped"]

MOST_SKIPPED = 5


def count_jobs(jobs: int) -> int:
    """All cores where joblib is there to let them work, else one."""
    from importlib.util import find_spec

    if jobs == -1 and not find_spec("joblib"):
        print("lsmgeo: one process works; joblib (of the extra data) lets all cores work", file=sys.stderr)
        return 1
    return jobs


def print_shards(shards: Sequence[Path], kept: int, out: str) -> None:
    """Print how many shards there are, where, and how many were there before."""
    megabytes = sum(path.stat().st_size for path in shards) / 1e6
    print(f"shards:   {len(shards)} in {Path(out).resolve()}, {megabytes:.0f} MB; {kept} were there already")


def print_skipped(skipped: Sequence[tuple[str, str]], what: str) -> None:
    """Print how many of ``what`` were left out, and why."""
    if skipped:
        print(f"skipped:  {len(skipped)} {what} that cannot be used")
        for path, reason in skipped[:MOST_SKIPPED]:
            print(f"          {path}: {reason}")
        if len(skipped) > MOST_SKIPPED:
            print(f"          and {len(skipped) - MOST_SKIPPED} more")
