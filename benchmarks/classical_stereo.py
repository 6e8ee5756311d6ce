"""The motorcycle of Middlebury: our sweep of a rectified pair against OpenCV's two matchers and the plainest sweep."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.classical_baselines import (
    Found,
    bad_at,
    block_matching,
    luminance,
    plain_sweep,
    semi_global_matching,
    winners,
)
from benchmarks.classical_rows import Row
from benchmarks.known_sets import BASELINE, FOCAL_LENGTH, OFFSET, write_motorcycle
from lsmgeo import data
from lsmgeo.classical import reconstruct_scene

SECTION = "motorcycle"
# The search range of all methods: whole disparities for those that take no others.
FIRST, LAST = 4, 64
THRESHOLD = 2.0
DENSITIES = tuple(tenth / 10 for tenth in range(1, 11))
LEAST_DENSITY, MOST_TIMES_RIVAL = 0.7, 1.5


def depth_of(disparity: Any) -> Any:
    """Z = f B / (d + doffs), millimetres."""
    return FOCAL_LENGTH * BASELINE / (disparity + OFFSET)


def disparity_of(depth: np.ndarray) -> np.ndarray:
    """NaN where there is no depth."""
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, FOCAL_LENGTH * BASELINE / np.where(known, depth, 1.0) - OFFSET, np.nan)


def found(root: Path, planes: int = 300, *, unfiltered: bool = True) -> tuple[dict[str, Found], np.ndarray, float]:
    """Disparities of all methods, the true ones, and the fraction of our pixels that both directions agree on.

    OpenCV's matchers say only whether they trust a pixel: their curves have a single point.
    """
    with tempfile.TemporaryDirectory() as scratch:
        scene = data.open(write_motorcycle(root, Path(scratch)))
        images = [scene.load(view) for view in (0, 1)]
        true = disparity_of(np.asarray(scene.load_depth(0), np.float64))
        near, far = depth_of(LAST), depth_of(FIRST)
        ours = {
            name: reconstruct_scene(
                scene,
                near=near,
                far=far,
                size=max(true.shape),
                planes=planes,
                density=1.0,
                filtered=filtered,
                mesh=False,
            ).views[0]
            for name, filtered in (("ours, filtered", True), ("ours, unfiltered", False))[: 1 + unfiltered]
        }
        plain = plain_sweep([luminance(image) for image in images], scene.cameras, depth_of(np.arange(FIRST, LAST + 1)))
    pair = [(image.permute(1, 2, 0) * 255).round().byte().numpy() for image in images]
    methods = {
        name: Found(disparity_of(one.depth_map.depth.double().numpy()), one.depth_map.confidence.numpy())
        for name, one in ours.items()
    }
    methods["plain ZNCC"] = Found(disparity_of(plain.value), plain.confidence)
    for name, matcher in (("StereoSGBM", semi_global_matching), ("StereoBM", block_matching)):
        disparity = matcher(*pair)
        methods[name] = Found(disparity, np.isfinite(disparity).astype(float))
    agreed = ours["ours, filtered"].support
    return methods, true, float((agreed > 0).float().mean()) if agreed is not None else 0.0


def curve(method: Found, true: np.ndarray) -> tuple[list[float], list[float]]:
    """Densities, of all pixels, and the fraction of wrong pixels at each; one density where confidence has no order."""
    most = float(np.isfinite(method.value).mean())
    levels = [density for density in DENSITIES if density < most] + [most]
    if len(np.unique(method.confidence)) <= 2:
        levels = [most]
    return levels, [bad_at(method, true, density, THRESHOLD) for density in levels]


def rows(root: Path | None) -> list[Row]:
    """Curves are compared at all densities that both reach; with a rival, the pixels that both call valid."""
    if root is None:
        return []
    return measure(root)[0]


def measure(root: Path) -> tuple[list[Row], dict[str, Any]]:
    """The rows, and the curves as numbers."""
    methods, true, agreed = found(root)
    curves = {name: dict(zip(("density", "bad"), curve(method, true), strict=True)) for name, method in methods.items()}
    ours, plain, rival = (methods[name] for name in ("ours, filtered", "plain ZNCC", "StereoSGBM"))
    table = []
    for name in methods:
        for density, bad in zip(curves[name]["density"], curves[name]["bad"], strict=True):
            if density in (0.4, 0.7, curves[name]["density"][-1]):
                table.append(
                    Row(SECTION, f"bad-2 at {100 * density:.0f} % density, {name}", f"{100 * bad:.1f} %", "", None)
                )
    # Our valid pixels are those on which both directions agree.
    density = min(agreed, float(np.isfinite(ours.value).mean()))
    both = winners(ours, density) & np.isfinite(rival.value) & np.isfinite(true)
    mine, theirs = (float((np.abs(method.value - true)[both] > THRESHOLD).mean()) for method in (ours, rival))
    table.append(
        Row(
            SECTION,
            f"bad-2 on pixels valid in both, ours at {100 * density:.0f} % density, over StereoSGBM's",
            f"{100 * mine:.2f} % : {100 * theirs:.2f} % = {mine / theirs:.2f}",
            f"at most {MOST_TIMES_RIVAL} at {100 * LEAST_DENSITY:.0f} % or more",
            density >= LEAST_DENSITY and mine <= MOST_TIMES_RIVAL * theirs,
        )
    )
    lead = [bad_at(plain, true, density, THRESHOLD) - bad_at(ours, true, density, THRESHOLD) for density in DENSITIES]
    table.append(
        Row(
            SECTION,
            "densities of 10 at which ours has fewer bad pixels than plain ZNCC",
            str(sum(gain > 0 for gain in lead)),
            "all 10",
            min(lead) > 0,
        )
    )
    return table, {"bad_pixel_curves": curves, "threshold_px": THRESHOLD}
