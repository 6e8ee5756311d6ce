"""What ``lsmgeo info`` measures on sets of known geometry, and what it reports when errors are planted in them.

The figures are compared with those of the set's publisher or of an independent measurement.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks.measuring import Settings
from benchmarks.mistakes import plants
from lsmgeo import diagnosis
from lsmgeo.data import detect

# The motorcycle has no calibration file; these are the published numbers at the size of its images.
FOCAL_LENGTH, CX, CY, OFFSET, BASELINE = 994.978, 311.193, 254.877, 31.086, 193.001


class Figure(NamedTuple):
    """A goal for a check: an upper limit, or with ``at_least`` a lower one, compared with its number of digits."""

    check: str
    value: str
    unit: str
    at_least: bool = False


def write_motorcycle(root: Path, scratch: Path) -> Path:
    """The pair in the published form: calib.txt, two images, disparities as a portable float map."""
    source, folder = root / "middlebury_motorcycle", scratch / "motorcycle"
    folder.mkdir(parents=True, exist_ok=True)
    for side, name in enumerate(("left", "right")):
        shutil.copyfile(source / f"motorcycle_{name}.png", folder / f"im{side}.png")
    with np.load(source / "motorcycle_disp.npz", allow_pickle=False) as arrays:
        disparity = arrays[arrays.files[0]].astype("<f4")
    height, width = disparity.shape
    cv2.imwrite(str(folder / "disp0.pfm"), np.where(disparity > 0, disparity, np.float32(np.inf)))
    cameras = [
        f"cam{side}=[{FOCAL_LENGTH} 0 {CX + side * OFFSET:.3f}; 0 {FOCAL_LENGTH} {CY}; 0 0 1]" for side in (0, 1)
    ]
    entries = [*cameras, f"doffs={OFFSET}", f"baseline={BASELINE}", f"width={width}", f"height={height}"]
    (folder / "calib.txt").write_text("\n".join(entries) + "\n")
    return folder


def copy_chessboards(root: Path, scratch: Path) -> Path:
    """The chessboards with their list and the left lens; the M1 and D1 in the same folder are of other images."""
    source, folder = root / "opencv_stereo", scratch / "chessboards"
    folder.mkdir(parents=True, exist_ok=True)
    for path in (source / "left_intrinsics.yml", source / "stereo_calib.xml", *source.glob("*[0-9].jpg")):
        shutil.copyfile(path, folder / path.name)
    return folder


EPIPOLAR, SILHOUETTES = "epipolar error of matched features", "voxels inside the silhouettes"
LSM = (Figure("depth points within a cell of the voxels", "99.9", "%", True), Figure(SILHOUETTES, "100.0", "%", True))
# Name, path in the folder of sets or a function that makes it in a scratch folder, and the known figures.
SETS: tuple[tuple[str, str | Callable[[Path, Path], Path], tuple[Figure, ...]], ...] = (
    ("temple", "middlebury_temple", (Figure(EPIPOLAR, "0.16", "px"),)),
    ("fountain", "strecha_fountain_quarter", (Figure(EPIPOLAR, "0.09", "px"),)),
    ("lego", "nerf_lego", (Figure(EPIPOLAR, "0.17", "px"),)),
    ("COLMAP scene", "colmap_scene", (Figure("reprojection error of sparse points", "0.25", "px"),)),
    ("HoloLens", "hololens_rgbd", (Figure("depth of one view in another", "0.3", "%"),)),
    ("LSM car", "lsm_sample/renders/02958343/*", LSM),
    ("LSM chair", "lsm_sample/renders/03001627/*", LSM),
    ("R2N2 chair", "r2n2/chair", (Figure(SILHOUETTES, "99.5", "%", True),)),
    ("motorcycle", write_motorcycle, (Figure("image warped by depth", "3.0", "grey levels"),)),
    ("binvox", "binvox/*.binvox", (Figure("surface of the mesh in occupied voxels", "100.0", "%", True),)),
    ("chessboards", copy_chessboards, (Figure("rms of a stereo calibration from scratch", "0.217", "px"),)),
)


def chosen(settings: Settings) -> Iterator[tuple[str, Path, Any, tuple[Figure, ...]]]:
    """Name, place, content and known figures of each set."""
    if settings.data is None:
        print("no folder of sets: use --data or LSMGEO_TEST_DATA")
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name, place, known in SETS:
            if settings.only.lower() in name.lower():
                is_path = isinstance(place, str)
                path = sorted(settings.data.glob(place))[0] if is_path else place(settings.data, Path(scratch))
                yield name, path, detect(path).read(path), known


def reached(figure: Figure, measured: float) -> bool:
    """Whether a measurement is as good as the figure, rounded to the digits of the figure."""
    rounded = round(measured, len(figure.value.partition(".")[2]))
    return rounded >= float(figure.value) if figure.at_least else rounded <= float(figure.value)


def figures(settings: Settings) -> list[dict[str, Any]]:
    """One case per figure."""
    cases = []
    for name, path, content, known in chosen(settings):
        start = time.perf_counter()
        findings = diagnosis.examine(content, path)
        seconds = time.perf_counter() - start
        checks = {check.name: check for check in reversed(findings.checks)}
        for figure in known:
            check = checks.get(figure.check)
            cases.append(
                {
                    "set": name,
                    "figure": figure.check,
                    "unit": figure.unit,
                    "known": float(figure.value),
                    "at_least": figure.at_least,
                    "measured": None if check is None or not np.isfinite(check.value) else check.value,
                    "count": 0 if check is None else check.measured,
                    "reached": check is not None and reached(figure, check.value),
                    "verdict": findings.verdict,
                    "cause": None if findings.cause is None else findings.cause.name,
                    "seconds": seconds,
                }
            )
    return cases


def mistakes(settings: Settings) -> list[dict[str, Any]]:
    """One case per planted error."""
    cases = []
    for name, path, content, _ in chosen(settings):
        for planted, plant in plants(content).items():
            findings = diagnosis.examine(plant(), path)
            cause = findings.cause
            failed = [check.name for check in findings.checks if not check.passed]
            named = {"named": cause and cause.name, "evidence": cause and cause.evidence, "failed": failed}
            cases.append({"set": name, "planted": planted, "verdict": findings.verdict, **named})
            print(f"{name:<14} {planted:<26} {findings.verdict:<8} {cases[-1]['named'] or '-'}", flush=True)
    return cases
