"""What ``import lsmgeo`` costs beside torch and kornia: ``python -m benchmarks.imports``.

Fresh processes in turn, files in the cache; the first round is not counted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Sequence

from benchmarks import timing

TARGET = 1.1


def fresh(code: str) -> Callable[[], None]:
    """Run code in a new interpreter."""
    return lambda: subprocess.run([sys.executable, "-c", code], check=True)  # type: ignore[return-value]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=11)
    options = parser.parse_args(argv)
    where = timing.machine("cpu")
    runs = {"ours": fresh("import lsmgeo"), "rival": fresh("import torch, kornia")}
    seconds = timing.interleaved(runs, options.repeats, warm_up=1)
    case = {"case": "import lsmgeo : import torch, kornia", **timing.summary(seconds), "target": TARGET}
    columns = {"case": "", "ours_ms": ".0f", "rival_ms": ".0f", "ratio_of_medians": ".3f", "median_of_ratios": ".3f"}
    timing.table([case], {**columns, "target": ".2f"})
    print(timing.save("imports", where, [case]))


if __name__ == "__main__":
    main()
