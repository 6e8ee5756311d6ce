"""What the classical machine reaches: ``python -m benchmarks.classical [--only NAME]``.

One table of everything: analytic scenes, photographs, silhouettes, fusion, speed. Each figure stands beside the one
that it was to reach, or beside the rivals', which run here too, with settings that `benchmarks.classical_baselines`
holds.

Densities are fractions of all pixels of a view, taken in the order of the method's own confidence; an error at a
density is over those of them whose true value is known. "Bad-2" is the fraction whose disparity is off by more than two
pixels.

The folder of sets is the one that ``LSMGEO_TEST_DATA`` names; figures that need it are left out without. The sets
themselves cannot be distributed; the results that are kept hold figures alone.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import report, timing
from benchmarks.classical_rows import Row

SECTIONS = ("analytic", "stereo", "rgbd", "posed", "hull", "tsdf", "speed")


def measure(section: str, root: Path | None) -> tuple[list[Row], dict[str, Any]]:
    """The rows of a section, and the numbers that its curves are drawn from, where it has any."""
    module = importlib.import_module(f"benchmarks.classical_{section}")
    if hasattr(module, "measure") and root is not None:
        rows, figures = module.measure(root)
        return rows, figures
    return module.rows(root), {}


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the table, keep the figures; 1 if one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("LSMGEO_TEST_DATA"), help="folder of the sets")
    parser.add_argument("--only", default="", choices=("", *SECTIONS), help="one section; its rows alone are replaced")
    options = parser.parse_args(arguments)
    root = options.data if options.data is not None and options.data.is_dir() else None
    if root is None:
        print("no folder of sets: --data, or LSMGEO_TEST_DATA, names none; figures that need it are left out")
    rows: list[Row] = []
    measured: dict[str, dict[str, Any]] = {}
    for section in (options.only,) if options.only else SECTIONS:
        start = time.perf_counter()
        found, figures = measure(section, root)
        rows += found
        measured[section] = {
            "section": section,
            "seconds": time.perf_counter() - start,
            "rows": [row._asdict() for row in found],
            **figures,
        }
    report.show(report.reached_rows(list(measured.values())))
    missed = [row for row in rows if row.reached is False]
    print(f"{sum(row.reached is True for row in rows)} figures reached, {len(missed)} missed")
    if root is not None:
        path = timing.RESULTS / "classical.json"
        kept = json.loads(path.read_text(encoding="utf-8"))["cases"] if options.only and path.is_file() else []
        cases = {**{case["section"]: case for case in kept}, **measured}
        device = "cuda" if torch.cuda.is_available() else "cpu"
        print(timing.save("classical", timing.machine(device), [cases[name] for name in SECTIONS if name in cases]))
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
