"""Competitors of classical reconstruction with their settings, and a comparison of their times.

OpenCV's stereo, loops of OpenCV and warps of kornia, and the plainest plane sweep: none goes through the library's
operators.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import cv2
import kornia
import numpy as np
import torch
from kornia.geometry.transform import warp_perspective
from torch import Tensor

from benchmarks import measuring
from benchmarks.problems import LeftOut
from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import aggregate_views, matching_costs, sweep, sweep_planes
from tests.classical import analytic

# A negligible standard deviation; of three values, the one with the lowest errors of the plain sweep.
FAINT = 0.5 / 255


def row(section: str, what: str, measured: str, goal: str = "", reached: Any = None) -> dict[str, Any]:
    """A row of the table: its subject, the figure with its statistic, and the goal if there is one."""
    reached = bool(reached) if goal else None
    return {"section": section, "what": what, "measured": measured, "goal": goal, "reached": reached}


class Found(NamedTuple):
    """The result of a method at every pixel of a view: depth or disparity, and its confidence."""

    value: np.ndarray  # (h, w), NaN where it says nothing
    confidence: np.ndarray  # (h, w), higher is better, of any scale


def winners(found: Found, density: float) -> np.ndarray:
    """The pixels (h, w) bool of highest confidence: a fraction of all pixels; fewer if fewer have a value."""
    confidence = np.where(np.isfinite(found.value), found.confidence, -np.inf).ravel()
    mask = np.zeros(confidence.size, bool)
    mask[np.argsort(-confidence, kind="stable")[: round(density * confidence.size)]] = True
    return (mask & np.isfinite(confidence)).reshape(found.value.shape)


def bad_at(found: Found, true: np.ndarray, density: float, threshold: float) -> float:
    """The fraction of wrong pixels among those of highest confidence whose true value is known."""
    use = winners(found, density) & np.isfinite(true)
    return float((np.abs(found.value - true)[use] > threshold).mean())


def median_at(found: Found, true: np.ndarray, density: float) -> float:
    """The median relative error among the pixels of highest confidence whose true value is known."""
    use = winners(found, density) & np.isfinite(true)
    return float(np.median((np.abs(found.value - true) / true)[use])) if use.any() else float("nan")


def matchers(left: np.ndarray, right: np.ndarray) -> dict[str, Found]:
    """Disparities of OpenCV's matchers for a rectified pair of (h, w, 3) uint8, all of equal confidence."""
    block = cv2.StereoBM_create(numDisparities=64, blockSize=15)  # type: ignore[attr-defined]
    block.setUniquenessRatio(10)
    block.setDisp12MaxDiff(1)
    # 5 x 5 blocks, the penalties that OpenCV's documentation gives for them, a uniqueness margin of 10 %, and both
    # directions within one pixel of each other.
    semi_global = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
        minDisparity=0, numDisparities=64, blockSize=5, P1=8 * 5 * 5, P2=32 * 5 * 5, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM,
    )  # fmt: skip
    grey = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    computed = {"StereoSGBM": semi_global.compute(left, right), "StereoBM": block.compute(*grey)}
    found = {}
    for name, sixteenths in computed.items():
        disparity = np.where(sixteenths > 0, sixteenths / 16.0, np.nan)
        found[name] = Found(disparity, np.isfinite(disparity).astype(float))
    return found


def luminance(image: Any) -> np.ndarray:
    """(3, h, w) in [0, 1] to (h, w) float32."""
    return np.einsum("chw,c->hw", np.asarray(image, np.float32), np.float32((0.299, 0.587, 0.114)))


def moments(image: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation around every pixel."""
    mean = cv2.boxFilter(image, -1, shape)
    variance = cv2.boxFilter(image * image, -1, shape) - mean * mean
    return mean, np.sqrt(np.maximum(variance, 0) + FAINT**2)


def plain_sweep(images: Sequence[np.ndarray], cameras: Any, depths: np.ndarray, window: int = 5) -> Found:
    """The depth of the first view by a plain plane sweep: mean ZNCC over the neighbours, winner takes all.

    Images are (h, w) float32 luminances in [0, 1], the reference first, cameras at their size. Depths are those of
    planes, with the correlation as confidence.
    """
    best, winner = np.full(images[0].shape, -2.0, np.float32), np.full(images[0].shape, -1)
    matrices, offsets = relative(*(np.asarray(value, np.float64) for value in cameras[:2]))
    size, shape = images[0].shape[::-1], (window, window)
    mean, deviation = moments(images[0], shape)
    for index, depth in enumerate(depths):
        total, count = np.zeros_like(mean), np.zeros_like(mean)
        for image, matrix, offset in zip(images[1:], matrices, offsets, strict=True):
            homography = matrix + np.outer(offset, (0, 0, 1 / depth))
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warped = cv2.warpPerspective(image, homography, size, flags=flags, borderValue=-1.0)
            seen = cv2.erode((warped >= 0).astype(np.uint8), np.ones(shape, np.uint8)) > 0
            other, spread = moments(warped, shape)
            score = (cv2.boxFilter(images[0] * warped, -1, shape) - mean * other) / (deviation * spread)
            total += np.where(seen, score, 0)
            count += seen
        scores = np.where(count > 0, total / np.maximum(count, 1), -1)
        better = scores > best
        best[better], winner[better] = scores[better], index
    return Found(np.where(winner >= 0, np.asarray(depths)[winner], np.nan), best)


def relative(K: np.ndarray, E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``M = K_v R K_0^-1`` and ``q = K_v t`` of the neighbours, which see a pixel p at ``M p + q / depth``."""
    moved = E[1:] @ np.linalg.inv(E[0])
    return K[1:] @ moved[:, :3, :3] @ np.linalg.inv(K[0]), (K[1:] @ moved[:, :3, 3:])[..., 0]


# The sweep that is timed: one view with four neighbours, correlation over 5 x 5 pixels, the mean of the better half of
# the neighbours, and the plane where it is lowest.
SIZE, PLANES, WINDOW, NOISE, BEST = (480, 640), 300, 5, 2 / 255, 2
KORNIA_PLANES = 10
MEMORY = 1 << 29


class Timed:
    """The images of an analytic scene, and their cameras."""

    def __init__(self, size: tuple[int, int] = SIZE, planes: int = PLANES):
        scale = size[1] / analytic.SIZE[1]
        rendered = analytic.render("sphere", size=size, focal=260.0 * scale, wavelength=0.045 / scale, views=5)
        self.images, self.mask = torch.from_numpy(rendered.images), rendered.mask
        self.cameras = CameraTensors(torch.from_numpy(rendered.K), torch.from_numpy(rendered.E), *size)
        self.depths = sweep_planes(self.cameras, analytic.NEAR, analytic.FAR, planes)
        self.relative = relative(rendered.K, rendered.E)
        # The planes that kornia is timed on, evenly spaced among all.
        self.some = np.linspace(0, planes - 1, KORNIA_PLANES).round().astype(int).tolist()

    def ours(self) -> Any:
        """The library's sweep, which also computes visibility, refines, and estimates confidence."""
        return sweep(self.images, self.cameras, self.depths, best=BEST, noise=NOISE, memory=MEMORY)


def opencv_sweep(timed: Timed) -> tuple[np.ndarray, np.ndarray]:
    """Lowest cost and its plane, (h, w) each, by loops over planes and neighbours.

    ``cv2.remap``, three ``cv2.boxFilter`` and arithmetic in place, in float32; the reference's own sums and all
    coordinates that do not depend on the plane are computed once, and OpenCV has its threads.
    """
    height, width = timed.images.shape[2:]
    images = timed.images[:, 0].numpy()
    y, x = np.mgrid[:height, :width].astype(np.float32)
    matrices, offsets = (values.astype(np.float32) for values in timed.relative)
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
    for index, depth in enumerate(timed.depths.tolist()):
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


def kornia_costs(timed: Timed) -> Tensor:
    """Costs (p, h, w) of some planes with a running minimum: for each plane all neighbours are warped at once.

    Each plane costs the same.
    """
    height, width = timed.images.shape[2:]
    matrices, offsets = (torch.from_numpy(values).float() for values in timed.relative)
    neighbours, reference = timed.images[1:], timed.images[:1]

    def box(values: Tensor) -> Tensor:
        return kornia.filters.box_blur(values, (WINDOW, WINDOW), "replicate")

    mean = box(reference)
    spread = box(reference * reference) - mean**2 + NOISE**2
    best, plane = torch.full((height, width), torch.inf), torch.zeros((height, width), dtype=torch.int64)
    kept = []
    for index in timed.some:
        homographies = matrices.clone()
        homographies[:, :, 2] += offsets / timed.depths[index].float()
        warped = warp_perspective(neighbours, torch.linalg.inv(homographies), (height, width), padding_mode="border")
        average = box(warped)
        energy = box(warped * warped) - average**2 + NOISE**2
        covariance = box(warped * reference) - average * mean
        costs = 1 - covariance * (energy * spread).rsqrt()
        cost = costs[:, 0].topk(BEST, 0, largest=False).values.mean(0)
        better = cost < best
        best, plane = torch.where(better, cost, best), torch.where(better, index, plane)
        kept.append(cost)
    return torch.stack(kept)


def agreement(timed: Timed) -> str:
    """Agreement of the results on the surface: pixels within one plane of OpenCV's, and differences of costs."""
    found, (cost, plane), costs = timed.ours(), opencv_sweep(timed), kornia_costs(timed)
    near = (np.abs(found.planes.round().numpy() - plane) <= 1) & timed.mask
    at_planes = matching_costs(timed.images, timed.cameras, timed.depths[timed.some], noise=NOISE)
    aggregated, count = aggregate_views(*at_planes, best=BEST)
    # Kornia's box filters repeat the border pixels, and its warps do not compute visibility.
    whole = (count == len(timed.images) - 1).numpy()
    whole[:, :WINDOW] = whole[:, -WINDOW:] = whole[:, :, :WINDOW] = whole[:, :, -WINDOW:] = False
    away = np.median(np.abs(found.cost.numpy() - cost)[near]), np.median(np.abs(aggregated - costs).numpy()[whole])
    return f"{100 * near.sum() / timed.mask.sum():.2f} %; {away[0]:.0e}, {away[1]:.0e}"


def added_memory(planes: int = 40) -> int:
    """Bytes that our sweep adds to a process; they do not grow with the planes."""
    return measuring.peak(Timed(planes=planes).ours)


def speed() -> list[dict[str, Any]]:
    """A plane sweep against loops of OpenCV and warps of kornia, alternately in one process."""
    cv2.setNumThreads(torch.get_num_threads())
    timed = Timed()
    runs = {"ours": timed.ours, "opencv": lambda: opencv_sweep(timed), "kornia": lambda: kornia_costs(timed)}
    seconds = [statistics.median(taken) for taken in measuring.interleaved(runs, repeats=5).values()]
    ours, loops, warps = seconds[0], seconds[1], seconds[2] * PLANES / KORNIA_PLANES
    section = f"plane sweep, {SIZE[1]} x {SIZE[0]}, 4 neighbours, {PLANES} planes"
    what = f"kornia warps (timed on {KORNIA_PLANES} planes)"
    same = "same result: winner within one plane of OpenCV's; costs differ (median, OpenCV, kornia)"
    rows = [
        row(section, "ours", f"{ours:.2f} s"),
        row(section, "OpenCV loops", f"{loops:.2f} s, {loops / ours:.2f} of ours", "at least 1", loops >= ours),
        row(section, what, f"{warps:.1f} s, {warps / ours:.1f} of ours", "at least 4", warps >= 4 * ours),
        row(section, same, agreement(timed)),
    ]
    with suppress(LeftOut):
        added, goal = measuring.isolated(added_memory), f"at most {MEMORY >> 20} MiB"
        rows.append(row(section, "memory added to the process", f"{added / 2**20:.0f} MiB", goal, added <= MEMORY))
    return rows
