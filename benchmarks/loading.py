"""What feeding a training run from shards costs: ``python -m benchmarks.loading``.

A set of analytic shapes is rendered, written as shards, and read as a trainer reads it: by a loader's workers, in
random order, some views of each shape. Files are in the cache; the trainer itself does nothing.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks import timing
from lsmgeo import scenes
from lsmgeo.cameras import CameraTensors
from lsmgeo.data import EpochSampler, Sample, ShapeDataset, ShardSet, collate, encode_sample, hash_settings, write_shard
from lsmgeo.scenes import synthetic13

VIEWS, SIZE = 20, 224
GOALS = {True: 60.0, False: 120.0}  # shapes a second, with and without depth


def rendered(index: int, views: int, size: int) -> tuple[Sample, torch.Tensor]:
    """One shape with its views and 32^3 occupancy, and its occupancy on 64^3."""
    made = synthetic13.shape(0, index)
    cameras = synthetic13.views(0, index, views, size)
    stacked = CameraTensors(*(torch.as_tensor(field)[None] for field in cameras))
    lights = scenes.Lights(*(field[None] for field in made.lights))
    picture = scenes.render([made.scene], stacked, lights)
    grids = {}
    for n in (32, 64):
        axis = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        grids[n] = scenes.occupancy([made.scene], torch.stack((x, y, z), -1)[None])[0]
    images, depth, mask = picture.images[0], picture.depth[0], picture.mask[0]
    return Sample(images, cameras, depth, mask, grids[32], None, made.category, made.name), grids[64]


def write(folder: Path, options: argparse.Namespace) -> dict[str, float]:
    """Write the set; what a shape takes on disk, and the encoding of a view."""
    seconds, sizes = [], []
    different = [rendered(index, options.views, options.size) for index in range(options.different)]

    def items() -> Iterator[tuple[int, dict[str, bytes]]]:
        for key in range(options.shapes):
            sample, grid = different[key % options.different]
            started = time.perf_counter()
            members = encode_sample(sample._replace(name=f"shape-{key}"), key, more_occupancy=[grid])
            seconds.append(time.perf_counter() - started)
            sizes.append(sum(map(len, members.values())))
            yield key, members

    write_shard(folder / "set-000000.tar", items(), hash_settings({"benchmark": "loading"}))
    return {
        "shape_kB": statistics.mean(sizes) / 1e3,
        "encode_view_ms": 1e3 * statistics.median(seconds) / options.views,
    }


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
    return [
        {
            "case": f"{options.taken} of {options.views} views, {options.size}^2, {'with' if depth else 'no'} depth",
            "workers": options.workers,
            "batch": options.batch,
            "shapes_per_s": statistics.median(rates[depth]),
            "slowest": min(rates[depth]),
            "fastest": max(rates[depth]),
            "goal": GOALS[depth],
            "one_process_ms": statistics.median(times[depth]),
            "one_process_least_ms": min(times[depth]),
            "passes": options.passes,
        }
        for depth in runs
    ]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shapes", type=int, default=208)
    parser.add_argument("--different", type=int, default=26, help="shapes rendered; the others are copies of these")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--taken", type=int, default=4, help="views of a shape that a step takes")
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--passes", type=int, default=7)
    parser.add_argument("--results", type=Path, default=timing.RESULTS)
    options = parser.parse_args(argv)
    where = timing.machine("cpu")
    with tempfile.TemporaryDirectory(prefix="lsmgeo-loading-") as folder:
        written = write(Path(folder), options)
        cases = measure(Path(folder), options)
    columns = {"case": "", "shapes_per_s": ".0f", "slowest": ".0f", "fastest": ".0f", "goal": ".0f"}
    timing.table(cases, {**columns, "one_process_ms": ".1f", "one_process_least_ms": ".1f"})
    print(f"{written['shape_kB']:.0f} kB a shape, {written['encode_view_ms']:.1f} ms to encode a view")
    print(timing.save("loading", where, cases, options.results, **written))


if __name__ == "__main__":
    main()
