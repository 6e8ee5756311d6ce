"""Measurements for the documentation: ``python -m benchmarks [NAME ...]`` measures, prints and saves them.

Results go to benchmarks/results/NAME.json. Without a name: the operators and the models on a CPU, and what importing
costs. Sets that cannot be distributed are read from the folder ``LSMGEO_TEST_DATA``; without it, benchmarks that need
them are left out.
"""

from __future__ import annotations

import argparse
import atexit
import importlib
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks import measuring, report
from benchmarks.measuring import RESULTS, Settings

# Name of the results: module and function.
BENCHMARKS = {
    "operators_channels_last": "operators.channels_last",
    "operators_contiguous": "operators.contiguous",
    "footprint": "operators.footprint",
    "systems": "operators.systems",
    "cost_volumes": "cost_volumes.measure",
    "splats": "splats.measure",
    "growth": "operators.growth",
    "models": "models.steps",
    "imports": "models.imports",
    "gpu": "operators.gpu",
    "models_gpu": "models.on_gpu",
    "scenes": "training_data.scenes",
    "render_set": "training_data.render_shapes",
    "loading": "training_data.loading",
    "classical": "classical.measure",
    "known_sets": "known_sets.figures",
    "planted_mistakes": "known_sets.mistakes",
}
USUAL = (
    "operators_channels_last",
    "operators_contiguous",
    "footprint",
    "systems",
    "cost_volumes",
    "splats",
    "growth",
    "models",
    "imports",
)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: checks that everything works, not how fast")
    parser.add_argument("--only", default="", help="only parts whose name contains this; nothing is saved")
    parser.add_argument("--repeats", type=int, help="rounds; by default as many as fit into the time budget")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--data", type=Path, default=os.environ.get("LSMGEO_TEST_DATA"), help="folder of the sets")
    parser.add_argument("--results", type=Path, help="folder for the JSON; by default benchmarks/results")
    options = parser.parse_args(argv)
    if unknown := set(options.names).difference(BENCHMARKS):
        parser.error(f"there is no benchmark {sorted(unknown)}")
    torch.set_num_threads(options.threads)
    # No process pool besides the timings, and an empty cache: all compile times are of a first run.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    if "TORCHINDUCTOR_CACHE_DIR" not in os.environ:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache = tempfile.mkdtemp(prefix="lsmgeo-benchmarks-")
        atexit.register(shutil.rmtree, cache, ignore_errors=True)
    repeats = 3 if options.quick and options.repeats is None else options.repeats
    # Figures of a quick run are meaningless: they are saved only on request.
    folder = options.results or (None if options.quick or options.only else RESULTS)
    for name in options.names or USUAL:
        is_gpu = torch.cuda.is_available() and "gpu" in name
        if "gpu" in name and not (is_gpu or options.quick):
            print(f"{name}: no CUDA device")
            continue
        settings = Settings(options.quick, repeats, "cuda" if is_gpu else "cpu", options.data, options.only)
        module, function = BENCHMARKS[name].split(".")
        where = measuring.machine(settings.device)
        print(f"\n{name}: {report.machine_line(where)}", flush=True)
        measuring.others.clear()
        cases = getattr(importlib.import_module(f"benchmarks.{module}"), function)(settings)
        report.show(cases)
        if folder is not None and cases:
            measuring.save(folder / f"{name}.json", where, cases)


if __name__ == "__main__":
    main()
