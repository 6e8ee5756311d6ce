"""Frames of a walk through a room with measured depth: our sweep against the plainest, frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.classical_baselines import Found, luminance, median_at, plain_sweep
from benchmarks.classical_rows import Row
from lsmgeo import data
from lsmgeo.cameras import resize, stack
from lsmgeo.classical import reconstruct_scene

SECTION = "HoloLens"
NEAR, FAR, PLANES = 0.7, 8.0, 128  # metres; for all methods
DENSITIES = (0.1, 0.2, 0.4)
MOST_TIMES_PLAIN = 0.5


def errors(root: Path, views: list[int] | None = None, size: int = 540) -> dict[str, np.ndarray]:
    """The median relative depth error of every frame (rows) at every density (columns), of both methods."""
    scene = data.open(root / "hololens_rgbd")
    result = reconstruct_scene(
        scene, views, near=NEAR, far=FAR, planes=PLANES, size=size, density=1.0, mesh=False, progress=True
    )
    table: dict[str, list[list[float]]] = {"ours": [], "plain ZNCC": []}
    for one in result.views:
        measured = scene.load_depth(one.view)
        assert measured is not None
        height, width = one.mask.shape
        y, x = (
            np.round((np.arange(n) + 0.5) * m / n - 0.5).astype(int)
            for n, m in zip((height, width), measured.shape, strict=True)
        )
        true = measured.double().numpy()[np.ix_(y, x)]
        true = np.where(true > 0, true, np.nan)
        depth = one.depth_map.depth.double().numpy()
        ours = Found(np.where(depth > 0, depth, np.nan), one.depth_map.confidence.numpy())
        seen = (one.view, *one.neighbours)
        images = [luminance(_resized(scene.load(view), (height, width))) for view in seen]
        cameras = stack([resize(scene.camera(view), height, width) for view in seen])
        plain = plain_sweep(images, cameras, one.depths.numpy())
        for name, method in (("ours", ours), ("plain ZNCC", plain)):
            table[name].append([median_at(method, true, density) for density in DENSITIES])
    return {name: np.array(values) for name, values in table.items()}


def _resized(image: Any, shape: tuple[int, int]) -> np.ndarray:
    import cv2

    picture = image.permute(1, 2, 0).numpy()
    if picture.shape[:2] != shape:
        picture = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(picture.transpose(2, 0, 1))


def rows(root: Path | None) -> list[Row]:
    """Medians over the frames of the frames' medians."""
    return [] if root is None else measure(root)[0]


def measure(root: Path, views: list[int] | None = None, size: int = 540) -> tuple[list[Row], dict[str, Any]]:
    """The rows, and every frame's figures."""
    found = errors(root, views, size)
    table, frames = [], len(found["ours"])
    for column, density in enumerate(DENSITIES):
        ours, plain = (float(np.median(found[name][:, column])) for name in ("ours", "plain ZNCC"))
        goal = density == DENSITIES[-1]
        table.append(
            Row(
                SECTION,
                f"median depth error at {100 * density:.0f} % density over plain ZNCC's, middle of {frames} frames",
                f"{100 * ours:.1f} % : {100 * plain:.1f} % = {ours / plain:.2f}",
                f"at most {MOST_TIMES_PLAIN}" if goal else "",
                ours <= MOST_TIMES_PLAIN * plain if goal else None,
            )
        )
    ratios = found["ours"][:, -1] / found["plain ZNCC"][:, -1]
    table.append(
        Row(
            SECTION,
            f"frames of {frames} whose error at 40 % density is at most half of plain ZNCC's",
            f"{int((ratios <= MOST_TIMES_PLAIN).sum())}, largest ratio {ratios.max():.2f}",
            "all",
            bool((ratios <= MOST_TIMES_PLAIN).all()),
        )
    )
    return table, {"median_errors": {name: values.tolist() for name, values in found.items()}, "densities": DENSITIES}
