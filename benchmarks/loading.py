"""What feeding a training run from shards costs: ``python -m benchmarks.loading``.

A set of synthetic shapes is rendered and read as a trainer reads it: by a loader's workers, in random order, some views
of each shape. Files are in the cache; the trainer itself does nothing.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks import timing
from lsmgeo.data import EpochSampler, Recipe, ShapeDataset, ShardSet, collate, render_set

VIEWS, SIZE = 20, 224
GOALS = {True: 60.0, False: 120.0}  # shapes a second, with and without depth


def alone(dataset: ShapeDataset, epoch: int) -> float:
    """Milliseconds a shape in this process."""
    started = time.perf_counter()
    for index in range(len(dataset)):
        dataset[epoch, index]
    return 1e3 * (time.perf_counter() - started) / len(dataset)


def loaded(loader: DataLoader[Any], sampler: EpochSampler, epoch: int) -> float:
    """Shapes a second that come out of a loader, its workers running already."""
    sampler.set_epoch(epoch)
    started = time.perf_counter()
    count = sum(len(batch.name) for batch in loader)
    return count / (time.perf_counter() - started)


def measure(folder: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    runs = {}
    for depth in (True, False):
        dataset = ShapeDataset(ShardSet(folder), views=options.taken, depth=depth)
        sampler = EpochSampler(len(dataset), seed=0)
        loader = DataLoader(
            dataset,
            options.batch,
            sampler=sampler,
            collate_fn=collate,
            num_workers=options.workers,
            persistent_workers=True,
        )
        runs[depth] = dataset, sampler, loader
    rates: dict[bool, list[float]] = {depth: [] for depth in runs}
    times: dict[bool, list[float]] = {depth: [] for depth in runs}
    for number in range(options.passes + 1):
        for depth, (dataset, sampler, loader) in runs.items():
            rate, milliseconds = loaded(loader, sampler, number), alone(dataset, number)
            if number:  # the first pass starts the workers
                rates[depth].append(rate)
                times[depth].append(milliseconds)
    what = f"{options.taken} of {options.views} views, {options.size} x {options.size}"
    return [
        {
            "case": f"{what}, {'with' if depth else 'no'} depth",
            "workers": options.workers,
            "batch": options.batch,
            "unit": "shapes/s",
            "rate": statistics.median(rates[depth]),
            "slowest": min(rates[depth]),
            "fastest": max(rates[depth]),
            "target": GOALS[depth],
            "one_process_ms": statistics.median(times[depth]),
            "one_process_least_ms": min(times[depth]),
            "passes": options.passes,
        }
        for depth in runs
    ]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shapes", type=int, default=208)
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--taken", type=int, default=4, help="views of a shape that a step takes")
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--passes", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="see whether it works")
    options = parser.parse_args(argv)
    if options.quick:
        options.shapes, options.views, options.size, options.passes = 8, 4, 64, 1
    where = timing.machine("cpu")
    with tempfile.TemporaryDirectory() as folder:
        recipe = Recipe(views=options.views, size=options.size)
        jobs = 1 if options.quick else -1  # workers take longer to start than eight shapes to draw
        made = render_set("synthetic-13", folder, recipe, shapes=options.shapes, jobs=jobs)
        size = sum(path.stat().st_size for path in made.shards) / made.shapes
        cases = measure(Path(folder), options)
    columns = {"case": "", "rate": ".0f", "slowest": ".0f", "fastest": ".0f", "target": ".0f"}
    timing.table(cases, {**columns, "one_process_ms": ".1f", "one_process_least_ms": ".1f"})
    print(f"{size / 1e3:.0f} kB a shape on disk")
    if not options.quick:
        print(timing.save("loading", where, cases, bytes_per_shape=size))


if __name__ == "__main__":
    main()
