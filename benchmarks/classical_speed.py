"""A plane sweep against loops of OpenCV and warps of kornia: ``python -m benchmarks.classical --only speed``.

One view of 640 x 480 pixels with four neighbours, 300 planes, correlation over 5 x 5 pixels, the mean of the better
half of the neighbours, and the plane where it is lowest. The pictures are an analytic scene's
(`tests.classical.analytic`). What each does:

- ours: `lsmgeo.classical.sweep`; besides, it tells which neighbours see a site, refines between planes, and gives a
  confidence;
- OpenCV: for every plane and neighbour ``cv2.remap``, three ``cv2.boxFilter`` and arithmetic in place, in float32; the
  reference's own sums and all coordinates that do not depend on the plane are computed once, and OpenCV has its
  threads;
- kornia: for every plane ``warp_perspective`` of all neighbours at once and ``box_blur``. It is timed on fewer planes,
  of which each costs the same, and its time is multiplied.

All run in turn in one process, and medians are compared. Memory is that which a sweep adds to a process of its own.
"""

from __future__ import annotations

import multiprocessing
import statistics
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from kornia.geometry.transform import warp_perspective
from torch import Tensor

from benchmarks import memory, timing
from benchmarks.classical_rows import Row
from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import aggregate_views, matching_costs, sweep, sweep_planes
from tests.classical import analytic

__all__ = ["opencv_sweep", "rows"]

SIZE, PLANES, THREADS, WINDOW, NOISE, BEST = (480, 640), 300, 2, 5, 2 / 255, 2
KORNIA_PLANES = 10
MEMORY = 1 << 29
ROUNDS = 5
KORNIA_RATIO = 4.0


class Problem:
    """The pictures and their cameras."""

    def __init__(self, size: tuple[int, int] = SIZE, planes: int = PLANES):
        scale = size[1] / analytic.SIZE[1]
        pictures = analytic.render("sphere", size=size, focal=260.0 * scale, wavelength=0.045 / scale, views=5)
        self.images = torch.from_numpy(pictures.images)
        self.cameras = CameraTensors(torch.from_numpy(pictures.K), torch.from_numpy(pictures.E), *size)
        self.depths = sweep_planes(self.cameras, analytic.NEAR, analytic.FAR, planes)
        self.mask = pictures.mask
        self.depth = pictures.depth

    def relative(self) -> tuple[np.ndarray, np.ndarray]:
        """``M = K_v R K_0^-1`` and ``q = K_v t`` of the neighbours, which see a pixel p at ``M p + q / depth``."""
        K, E = self.cameras.intrinsics.numpy(), self.cameras.cam_from_world.numpy()
        matrices, offsets = [], []
        for view in range(1, len(K)):
            moved = E[view] @ np.linalg.inv(E[0])
            matrices.append(K[view] @ moved[:3, :3] @ np.linalg.inv(K[0]))
            offsets.append(K[view] @ moved[:3, 3])
        return np.array(matrices), np.array(offsets)


def ours(problem: Problem) -> Any:
    """The library's sweep."""
    return sweep(problem.images, problem.cameras, problem.depths, best=BEST, noise=NOISE, memory=MEMORY)


def opencv_sweep(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Lowest cost and its plane, (h, w) each, by loops over planes and neighbours."""
    height, width = problem.images.shape[2:]
    images = problem.images[:, 0].numpy()
    y, x = np.mgrid[:height, :width].astype(np.float32)
    matrices, offsets = (values.astype(np.float32) for values in problem.relative())
    rows = [[m[row, 0] * x + m[row, 1] * y + m[row, 2] for row in range(3)] for m in matrices]

    def box(values: np.ndarray, out: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, -1, (WINDOW, WINDOW), dst=out, borderType=cv2.BORDER_REPLICATE)

    map_x, map_y, height_of, warped, mean, energy, product, spare, lowest, second = np.empty(
        (10, height, width), np.float32
    )
    reference = images[0]
    reference_mean = box(reference, np.empty_like(reference))
    spread = box(reference * reference, np.empty_like(reference)) - reference_mean**2 + np.float32(NOISE**2)
    scale = -1 / np.sqrt(spread)
    best, plane = np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.int32)
    for index, depth in enumerate(problem.depths.tolist()):
        lowest.fill(np.inf)
        second.fill(np.inf)
        for view, (row_x, row_y, row_z) in enumerate(rows):
            q = offsets[view] / np.float32(depth)
            np.add(row_z, q[2], out=height_of)
            np.divide(np.add(row_x, q[0], out=map_x), height_of, out=map_x)
            np.divide(np.add(row_y, q[1], out=map_y), height_of, out=map_y)
            cv2.remap(images[view + 1], map_x, map_y, cv2.INTER_LINEAR, dst=warped, borderMode=cv2.BORDER_REPLICATE)
            box(warped, mean)
            box(np.multiply(warped, warped, out=spare), energy)
            box(np.multiply(warped, reference, out=spare), product)
            np.subtract(energy, np.multiply(mean, mean, out=spare), out=energy)
            np.sqrt(np.add(energy, np.float32(NOISE**2), out=energy), out=energy)
            np.subtract(product, np.multiply(mean, reference_mean, out=mean), out=product)
            np.divide(np.multiply(product, scale, out=product), energy, out=product)
            np.maximum(lowest, product, out=spare)
            np.minimum(second, spare, out=second)
            np.minimum(lowest, product, out=lowest)
        np.multiply(np.add(lowest, second, out=lowest), np.float32(0.5), out=lowest)
        better = np.less(lowest, best)
        np.copyto(best, lowest, where=better)
        np.copyto(plane, index, where=better)
    return best + 1, plane


def some_planes(planes: int) -> list[int]:
    """The planes that kornia is timed on, evenly taken from all."""
    return np.linspace(0, planes - 1, KORNIA_PLANES).round().astype(int).tolist()


def kornia_costs(problem: Problem) -> Tensor:
    """Costs (p, h, w) of some planes, while a lowest one is kept."""
    height, width = problem.images.shape[2:]
    matrices, offsets = (torch.from_numpy(values).float() for values in problem.relative())
    neighbours, reference = problem.images[1:], problem.images[:1]
    box = kornia.filters.box_blur
    mean = box(reference, (WINDOW, WINDOW), "replicate")
    spread = box(reference * reference, (WINDOW, WINDOW), "replicate") - mean**2 + NOISE**2
    best = torch.full((height, width), torch.inf)
    plane = torch.zeros((height, width), dtype=torch.int64)
    kept = []
    for index in some_planes(len(problem.depths)):
        homographies = matrices.clone()
        homographies[:, :, 2] += offsets / problem.depths[index].float()
        warped = warp_perspective(neighbours, torch.linalg.inv(homographies), (height, width), padding_mode="border")
        average = box(warped, (WINDOW, WINDOW), "replicate")
        energy = box(warped * warped, (WINDOW, WINDOW), "replicate") - average**2 + NOISE**2
        covariance = box(warped * reference, (WINDOW, WINDOW), "replicate") - average * mean
        costs = 1 - covariance * (energy * spread).rsqrt()
        cost = costs[:, 0].topk(BEST, 0, largest=False).values.mean(0)
        better = cost < best
        best, plane = torch.where(better, cost, best), torch.where(better, index, plane)
        kept.append(cost)
    return torch.stack(kept)


def agreement(problem: Problem, found: Any, opencv: tuple[np.ndarray, np.ndarray], costs: Tensor) -> dict[str, float]:
    """How far the results agree on the surface: pixels within one plane of OpenCV's, and differences of costs."""
    cost, plane = (values[problem.mask] for values in opencv)
    near = np.abs(found.planes.round().numpy()[problem.mask] - plane) <= 1
    indices = some_planes(len(problem.depths))
    with torch.no_grad():
        at_planes = matching_costs(problem.images, problem.cameras, problem.depths[indices], noise=NOISE)
        aggregated, count = aggregate_views(*at_planes, best=BEST)
    # Kornia's boxes repeat the border's pixels, and its warps know of no neighbour that does not see.
    whole = (count == len(problem.images) - 1).numpy()
    whole[:, :WINDOW] = whole[:, -WINDOW:] = whole[:, :, :WINDOW] = whole[:, :, -WINDOW:] = False
    return {
        "opencv_planes": 100 * float(near.mean()),
        "opencv_cost": float(np.median(np.abs(found.cost.numpy()[problem.mask] - cost)[near])),
        "kornia_cost": float(np.median(np.abs(aggregated - costs).numpy()[whole])),
    }


def _peak(connection: Any, size: tuple[int, int], planes: int) -> None:
    torch.set_num_threads(THREADS)
    problem = Problem(size, planes)
    connection.send(memory.peak(lambda: ours(problem)))


def added_memory(size: tuple[int, int] = SIZE, planes: int = 40) -> int:
    """Bytes that a sweep adds to a process of its own; they do not grow with the planes."""
    receiver, sender = multiprocessing.get_context("spawn").Pipe(duplex=False)
    process = multiprocessing.get_context("spawn").Process(target=_peak, args=(sender, size, planes))
    process.start()
    sender.close()
    try:
        return int(receiver.recv())
    finally:
        process.join()


def rows(root: Path | None = None) -> list[Row]:
    """The table's lines; the folder of sets is not used."""
    torch.set_num_threads(THREADS)
    cv2.setNumThreads(THREADS)
    problem = Problem()
    runs = {
        "ours": lambda: ours(problem),
        "opencv": lambda: opencv_sweep(problem),
        "kornia": lambda: kornia_costs(problem),
    }
    seconds = {name: statistics.median(taken) for name, taken in timing.interleaved(runs, repeats=ROUNDS).items()}
    seconds["kornia"] *= PLANES / KORNIA_PLANES
    agrees = agreement(problem, ours(problem), opencv_sweep(problem), kornia_costs(problem))
    loops, warps = seconds["opencv"] / seconds["ours"], seconds["kornia"] / seconds["ours"]
    name = f"plane sweep, {SIZE[1]} x {SIZE[0]}, 4 neighbours, {PLANES} planes"
    found = [
        Row(name, "ours", f"{seconds['ours']:.2f} s", "", None),
        Row(name, "OpenCV loops", f"{seconds['opencv']:.2f} s, {loops:.2f} of ours", "at least 1", loops >= 1),
        Row(
            name,
            f"kornia warps (timed on {KORNIA_PLANES} planes)",
            f"{seconds['kornia']:.1f} s, {warps:.1f} of ours",
            f"at least {KORNIA_RATIO:g}",
            warps >= KORNIA_RATIO,
        ),
        Row(
            name,
            "same result: winner within one plane of OpenCV's; costs differ (median, OpenCV, kornia)",
            f"{agrees['opencv_planes']:.2f} %; {agrees['opencv_cost']:.0e}, {agrees['kornia_cost']:.0e}",
            "",
            None,
        ),
    ]
    if memory.can_measure():
        added = added_memory()
        text = f"{added / 2**20:.0f} MiB"
        found.append(Row(name, "memory added to the process", text, f"at most {MEMORY >> 20} MiB", added <= MEMORY))
    return found
