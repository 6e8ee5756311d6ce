"""The queue of experiments, see docs/experiments.

"list" shows what is done and what is next, "next" trains and evaluates the next one (or the named one), "collect" keeps
the results of finished ones.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.experiments import collecting
from benchmarks.experiments.queue import QUEUE, TRIALS, Experiment, find
from benchmarks.experiments.running import Folder, run_experiment
from lsmgeo.models.weights import checkpoint_folders


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experiments", description=__doc__)
    parser.add_argument("command", choices=("list", "next", "collect"))
    parser.add_argument("name", nargs="?", help="for next: an experiment; by default the first that is not finished")
    parser.add_argument(
        "--folder", type=Path, default=Path("experiments"), help="of the set and the runs (%(default)s)"
    )
    options = parser.parse_args(argv)
    folder = Folder(options.folder)
    if options.command == "list":
        show(folder)
        return 0
    if options.command == "collect":
        for path in collecting.collect(folder):
            print(path)
        return 0
    if options.name is not None:
        return run_experiment(find(options.name), folder)
    for experiment in QUEUE:
        if state(experiment, folder) != "done":
            print(f"{experiment.name}: {experiment.what}, {experiment.minutes:g} CPU minutes", file=sys.stderr)
            return run_experiment(experiment, folder)
    print("all experiments are done")
    return 0


def show(folder: Folder) -> None:
    """Print what is done and what is next."""
    is_next = True
    for title, some in (("the queue, in this order", QUEUE), ("trials, run by name", TRIALS)):
        print(f"{title}:")
        for experiment in some:
            found = state(experiment, folder)
            if found != "done" and experiment in QUEUE and is_next:
                found, is_next = f"{found}, next" if found else "next", False
            words = experiment.what
            if (kept := collecting.RESULTS / f"{experiment.name}.json").is_file():
                words += f": {collecting.headline(json.loads(kept.read_text(encoding='utf-8')))}"
            minutes = f"{experiment.minutes:g} min"
            print(f"  {experiment.name:<22} {minutes:>8}  {found or 'not begun':<14}  {words}")


def state(experiment: Experiment, folder: Folder) -> str:
    """The state of a run: "done" (also where its results are committed), the step it has reached, or nothing."""
    if (collecting.RESULTS / f"{experiment.name}.json").is_file() or folder.is_done(experiment):
        return "done"
    steps = checkpoint_folders(folder.run(experiment))
    return f"at step {max(steps)}" if steps else ""


if __name__ == "__main__":
    sys.exit(main())
