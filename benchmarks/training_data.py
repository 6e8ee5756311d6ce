"""Speed of rendering analytic scenes, of writing a training set, and of loading it for training."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from benchmarks import measuring
from benchmarks.measuring import Settings
from lsmgeo.cameras import orbit
from lsmgeo.data import EpochSampler, Recipe, ShapeDataset, ShardSet, collate, render_set
from lsmgeo.scenes import Lights, Material, Scene, box, cone, cylinder, ellipsoid, render, sphere

VIEWS, SIZE = 20, 224
TAKEN, BATCH, WORKERS = 4, 4, 2  # views of a shape and shapes of a training step, workers of its loader
# Per second: views rendered of ten solids, views written, shapes loaded with and without depth.
RENDERED, WRITTEN, LOADED = 50.0, 30.0, {True: 60.0, False: 120.0}


def ten_solids() -> Scene:
    """A chair with a few things on it: every kind of primitive, textures, one cut."""
    wood, cloth = Material((0.5, 0.3, 0.1)), Material((0.2, 0.3, 0.8), "checker", (1.0, 1.0, 1.0), 6.0)
    back = box((-0.22, 0.25, 0), (0.05, 0.4, 0.5), cloth)
    return Scene(
        [
            *(cylinder((x, -0.5, z), (x, 0, z), 0.03, wood) for x in (-0.2, 0.2) for z in (-0.2, 0.2)),
            box((0, 0.02, 0), (0.5, 0.05, 0.5), wood),
            back.minus(cylinder((-1, 0.25, 0), (1, 0.25, 0), 0.1)),
            sphere((0.05, 0.15, 0), 0.1, Material((0.9, 0.9, 0.2), "waves", (0.1, 0.1, 0.1), 4.0)),
            cone((0.1, 0.05, 0.15), (0.1, 0.3, 0.15), 0.08, 0.02),
            ellipsoid((0.1, 0.1, -0.15), (0.1, 0.06, 0.05)).rotated(1, 30.0),
            cylinder((-0.2, 0.45, -0.25), (-0.2, 0.45, 0.25), 0.04),
        ]
    )


def scenes(settings: Settings) -> list[dict[str, Any]]:
    """Views per second of one scene."""
    size, scene = 64 if settings.quick else SIZE, ten_solids()
    azimuth = torch.linspace(0, 342, VIEWS, dtype=torch.float64)[None]
    views = orbit(azimuth, 15.0, 2.0, focal_length=1.875 * size, height=size, width=size)
    lights = Lights(torch.tensor([[0.0, 1.0, 0.0], [0.8, 0.6, 0.0]]), torch.full((2, 3), 0.4), torch.full((3,), 0.35))
    runs = {
        "": lambda: render([scene], views, lights, shadows=False),
        ", shadows": lambda: render([scene], views, lights, shadows=True),
    }
    seconds = measuring.interleaved(runs, settings.repeats or 9)
    case, targets = f"10 solids, {size} x {size}, 1 x {VIEWS} views", {"": RENDERED}
    return [
        measuring.rate(case + name, "views/s", [VIEWS / each for each in taken], targets.get(name))
        for name, taken in seconds.items()
    ]


def render_shapes(settings: Settings) -> list[dict[str, Any]]:
    """``lsmgeo render`` on synthetic-13 with all cores, depth included."""
    shapes, views, size, jobs = (4, 2, 64, 1) if settings.quick else (1000, VIEWS, SIZE, -1)
    options = {"source": "synthetic-13", "shapes": shapes, "views": views, "size": size, "jobs": jobs}
    with tempfile.TemporaryDirectory() as folder:
        words = [word for name, value in {**options, "out": folder}.items() for word in (f"--{name}", str(value))]
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "lsmgeo.cli", "render", *words], stdout=subprocess.DEVNULL, check=True)
        seconds = time.perf_counter() - start
        written = len(ShardSet(folder))
        stored = sum(path.stat().st_size for path in Path(folder).iterdir())
    case = f"lsmgeo render, {written} shapes of {views} views at {size} x {size} with depth and voxels"
    measured = {"rate": written * views / seconds, "seconds": seconds, "bytes_per_shape": stored / written}
    return [{"case": case, "unit": "views/s", **measured, "target": WRITTEN}]


def loading(settings: Settings) -> list[dict[str, Any]]:
    """Shapes per second from a loader, in random order, some views of each; files are in the cache."""
    # Starting workers takes longer than rendering eight shapes.
    shapes, views, size, jobs = (8, 4, 64, 1) if settings.quick else (208, VIEWS, SIZE, -1)
    with tempfile.TemporaryDirectory() as folder:
        render_set("synthetic-13", folder, Recipe(views=views, size=size), shapes=shapes, jobs=jobs)
        sampler, loaders = EpochSampler(shapes, seed=0), {}
        for depth in LOADED:
            dataset = ShapeDataset(ShardSet(folder), views=TAKEN, depth=depth)
            loaders[depth] = DataLoader(
                dataset, BATCH, sampler=sampler, collate_fn=collate, num_workers=WORKERS, persistent_workers=True
            )
        runs = {str(depth): lambda depth=depth: sum(len(batch.name) for batch in loaders[depth]) for depth in LOADED}
        seconds = measuring.interleaved(runs, settings.repeats or 7)  # the first pass starts the workers
    case = f"{TAKEN} of {views} views, {size} x {size}"
    return [
        measuring.rate(f"{case}, {'with' if depth else 'no'} depth", "shapes/s",
                       [shapes / each for each in seconds[str(depth)]], target)
        for depth, target in LOADED.items()
    ]  # fmt: skip
