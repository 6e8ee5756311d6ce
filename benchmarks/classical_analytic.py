"""Depth of textured surfaces known in closed form, by plane sweep: ``python -m benchmarks.classical --only analytic``.

The pictures are traced by `tests.classical.analytic`, which shares no code with the library: 96 x 72 pixels, four
views, 64 planes even in inverse depth, 5 x 5 correlation; pixels nearer than three to the surface's end are left out.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.classical_rows import Row
from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import sweep, sweep_planes
from tests.classical import analytic

__all__ = ["errors", "rows"]

PLANES = 64
LEAST, LEAST_BOX, MEDIAN = 99.5, 98.0, 1e-3
SEEDS = (0, 1)


def errors(surface: str, planes: int = PLANES, seed: int = 0) -> tuple[float, float, float]:
    """Percentage within one plane, and median relative depth errors: refined, and at the winning plane."""
    pictures = analytic.render(surface, seed=seed)
    height, width = pictures.depth.shape
    cameras = CameraTensors(torch.from_numpy(pictures.K), torch.from_numpy(pictures.E), height, width)
    depths = sweep_planes(cameras, analytic.NEAR, analytic.FAR, planes)
    found = sweep(torch.from_numpy(pictures.images), cameras, depths)
    true = pictures.depth[pictures.mask]
    winner = found.planes.round().numpy()[pictures.mask]
    ideal = np.interp(-1 / true, -1 / depths.numpy(), np.arange(planes))
    within = 100 * float((np.abs(winner - ideal) <= 1).mean())
    refined = np.abs(found.depth.numpy()[pictures.mask] - true) / true
    plain = np.abs(depths.numpy()[winner.clip(0).astype(int)] - true) / true
    return within, float(np.median(refined)), float(np.median(plain))


def rows(root: Path | None = None) -> list[Row]:
    """The table's lines; the folder of sets is not used. The worse of two textures counts."""
    found = []
    for surface in (*analytic.SURFACES, "corner"):
        measured = [errors(surface, seed=seed) for seed in SEEDS]
        within, median = min(values[0] for values in measured), max(values[1] for values in measured)
        least = LEAST_BOX if surface == "box" else LEAST
        # Of a corner all faces are steep: windows that face the camera lie on none of them.
        is_goal = surface != "corner"
        name = f"analytic {surface}"
        found += [
            Row(
                name,
                "pixels within one of 64 planes",
                f"{within:.2f} %",
                f"at least {least:g} %" if is_goal else "",
                within >= least if is_goal else None,
            ),
            Row(
                name,
                "median relative error, refined",
                f"{median:.1e}",
                f"at most {MEDIAN:.0e}" if is_goal else "",
                median <= MEDIAN if is_goal else None,
            ),
        ]
    for surface in ("slanted", "sphere"):
        medians = [errors(surface, planes)[2] for planes in (16, 32, 64)]
        ratios = [first / second for first, second in pairwise(medians)]
        found.append(
            Row(
                f"analytic {surface}",
                "unrefined error of 16 over 32, 32 over 64 planes",
                " and ".join(f"{ratio:.2f}" for ratio in ratios),
                "1.7 to 2.3",
                all(1.7 <= ratio <= 2.3 for ratio in ratios),
            )
        )
    return found
