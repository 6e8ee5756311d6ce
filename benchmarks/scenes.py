"""How fast analytic scenes are rendered and a training set is made: ``python -m benchmarks.scenes``.

Making the set runs ``lsmgeo render`` in a process of its own, and looks at the memory of all its processes.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks import timing
from lsmgeo import scenes
from lsmgeo.cameras import orbit, to
from lsmgeo.data import ShardSet

VIEWS = 20
SIZE = 224
RENDER_TARGET = 50.0  # views a second, a scene of ten solids
MAKE_TARGET = 30.0  # views a second, written


def ten_solids() -> scenes.Scene:
    """A chair with a few things on it: every kind of solid, textures, one cut."""
    wood, cloth = scenes.Material((0.5, 0.3, 0.1)), scenes.Material((0.2, 0.3, 0.8), "checker", (1.0, 1.0, 1.0), 6.0)
    legs = [scenes.cylinder((x, -0.5, z), (x, 0, z), 0.03, wood) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    back = scenes.box((-0.22, 0.25, 0), (0.05, 0.4, 0.5), cloth)
    return scenes.Scene(
        [
            *legs,
            scenes.box((0, 0.02, 0), (0.5, 0.05, 0.5), wood),
            back.minus(scenes.cylinder((-1, 0.25, 0), (1, 0.25, 0), 0.1)),
            scenes.sphere((0.05, 0.15, 0), 0.1, scenes.Material((0.9, 0.9, 0.2), "waves", (0.1, 0.1, 0.1), 4.0)),
            scenes.cone((0.1, 0.05, 0.15), (0.1, 0.3, 0.15), 0.08, 0.02),
            scenes.ellipsoid((0.1, 0.1, -0.15), (0.1, 0.06, 0.05)).rotated(1, 30.0),
            scenes.cylinder((-0.2, 0.45, -0.25), (-0.2, 0.45, 0.25), 0.04),
        ]
    )


def rendering(device: str, repeats: int, size: int = SIZE) -> list[dict[str, Any]]:
    """Views a second of one scene on a CPU, of 32 scenes on a GPU."""
    count = 1 if device == "cpu" else 32
    azimuth = torch.linspace(0, 342, VIEWS, dtype=torch.float64).expand(count, VIEWS)
    views = to(orbit(azimuth, 15.0, 2.0, focal_length=1.875 * size, height=size, width=size), device=device)
    lights = scenes.Lights(
        torch.tensor([[0.0, 1.0, 0.0], [0.8, 0.6, 0.0]]), torch.full((2, 3), 0.4), torch.full((3,), 0.35)
    )
    some = [ten_solids()] * count
    cases = []
    for shadows in (False, True):
        seconds = []
        for _ in range(repeats + 1):
            start = time.perf_counter()
            scenes.render(some, views, lights, shadows=shadows)
            if device != "cpu":
                torch.cuda.synchronize()
            seconds.append(time.perf_counter() - start)
        rates = [count * VIEWS / s for s in seconds[1:]]
        target = RENDER_TARGET if device == "cpu" and not shadows else None
        cases.append(
            {
                "case": f"10 solids, {size} x {size}, {count} x {VIEWS} views{', shadows' if shadows else ''}",
                "unit": "views/s",
                "rate": statistics.median(rates),
                "slowest": min(rates),
                "fastest": max(rates),
                "target": target,
            }
        )
    return cases


def resident(process: int) -> int:
    """Bytes of resident memory of a process and its descendants; pages they share count in each."""
    total = 0
    try:
        for task in Path(f"/proc/{process}/task").iterdir():
            total += sum(resident(int(child)) for child in (task / "children").read_text().split())
        total += int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096
    except (OSError, ValueError):
        pass  # it ended meanwhile
    return total


def making(shapes: int, views: int, size: int = SIZE, jobs: int = -1) -> dict[str, Any]:
    """Run ``lsmgeo render`` on synthetic-13 with all cores, depth included."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "lsmgeo.cli", "render", "--source", "synthetic-13", "--out", folder]
        command += ["--shapes", str(shapes), "--views", str(views), "--size", str(size), "--jobs", str(jobs)]
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        memory = []
        while process.poll() is None:
            time.sleep(1)
            memory.append(resident(process.pid))
        seconds = time.perf_counter() - start
        if process.returncode:
            raise RuntimeError(f"lsmgeo render ended with status {process.returncode}")
        written = len(ShardSet(folder))
        stored = sum(path.stat().st_size for path in Path(folder).iterdir())
    # Of the time when all workers are up: from a fifth of the run on.
    steady = memory[len(memory) // 5 : -2] or memory
    third = max(len(steady) // 3, 1)
    return {
        "case": f"lsmgeo render, {written} shapes of {views} views at {size} x {size} with depth and voxels",
        "unit": "views/s",
        "rate": written * views / seconds,
        "seconds": seconds,
        "bytes_per_shape": stored / written,
        "memory_early_mb": statistics.median(steady[:third]) / 1e6,
        "memory_late_mb": statistics.median(steady[-third:]) / 1e6,
        "target": MAKE_TARGET,
    }


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--shapes", type=int, default=1000)
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--quick", action="store_true", help="see whether it works")
    options = parser.parse_args(argv)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    where = timing.machine(device)
    rendered = rendering(device, 1, 64) if options.quick else rendering(device, options.repeats)
    timing.table(rendered, {"case": "", "rate": ".0f", "slowest": ".0f", "fastest": ".0f"})
    made = making(4, 2, 64, jobs=1) if options.quick else making(options.shapes, options.views)
    columns = {
        "case": "",
        "rate": ".1f",
        "memory_early_mb": ".0f",
        "memory_late_mb": ".0f",
        "target": ".0f",
    }
    timing.table([made], columns)
    if not options.quick:
        print(timing.save("scenes" if device == "cpu" else "scenes_gpu", where, rendered))
        print(timing.save("render_set", where, [made]))


if __name__ == "__main__":
    main()
