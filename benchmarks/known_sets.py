"""Sets whose geometry is known: ``python -m benchmarks.known_sets [--mistakes]``.

What ``lsmgeo info`` measures on each stands beside what its publisher, or an independent measurement, says of it; with
``--mistakes``, what it names when they are planted.

The folder of sets is the one that ``LSMGEO_TEST_DATA`` names. The sets themselves cannot be distributed; the results
that are kept hold figures alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import timing
from benchmarks.mistakes import plants
from lsmgeo import diagnosis
from lsmgeo.data import detect

# The motorcycle comes without its calibration file; these are the published numbers at the size of its pictures.
FOCAL_LENGTH, CX, CY, OFFSET, BASELINE = 994.978, 311.193, 254.877, 31.086, 193.001


class Figure(NamedTuple):
    """A figure to reach: of the check so named, at most so much, or with ``at_least`` at least, in so many digits."""

    check: str
    value: str
    unit: str
    at_least: bool = False


class Known(NamedTuple):
    """A set, where to find it, and the figures known of it."""

    name: str
    place: Callable[[Path, Path], Path]  # of the folder of sets and a scratch folder
    figures: tuple[Figure, ...]


def _below(*parts: str) -> Callable[[Path, Path], Path]:
    return lambda root, scratch: root.joinpath(*parts)


def _first(pattern: str) -> Callable[[Path, Path], Path]:
    return lambda root, scratch: sorted(root.glob(pattern))[0]


def write_motorcycle(root: Path, scratch: Path) -> Path:
    """The pair in the published form: calib.txt, two pictures, disparities as a portable float map."""
    source, folder = root / "middlebury_motorcycle", scratch / "motorcycle"
    folder.mkdir(parents=True, exist_ok=True)
    for side, name in enumerate(("left", "right")):
        shutil.copyfile(source / f"motorcycle_{name}.png", folder / f"im{side}.png")
    with np.load(source / "motorcycle_disp.npz", allow_pickle=False) as arrays:
        disparity = arrays[arrays.files[0]].astype("<f4")
    height, width = disparity.shape
    unknown = ~(np.isfinite(disparity) & (disparity > 0))
    rows = np.where(unknown, np.float32(np.inf), disparity)[::-1]
    (folder / "disp0.pfm").write_bytes(f"Pf\n{width} {height}\n-1.0\n".encode() + np.ascontiguousarray(rows).tobytes())
    cameras = [
        f"cam{side}=[{FOCAL_LENGTH} 0 {CX + side * OFFSET:.3f}; 0 {FOCAL_LENGTH} {CY}; 0 0 1]" for side in (0, 1)
    ]
    entries = [*cameras, f"doffs={OFFSET}", f"baseline={BASELINE}", f"width={width}", f"height={height}"]
    (folder / "calib.txt").write_text("\n".join(entries) + "\n")
    return folder


def copy_chessboards(root: Path, scratch: Path) -> Path:
    """The chessboards with their list and the left lens; the M1 and D1 beside them are of other pictures."""
    source, folder = root / "opencv_stereo", scratch / "chessboards"
    folder.mkdir(parents=True, exist_ok=True)
    for path in (source / "left_intrinsics.yml", source / "stereo_calib.xml", *source.glob("*[0-9].jpg")):
        shutil.copyfile(path, folder / path.name)
    return folder


LSM = (
    Figure("depth points within a cell of the voxels", "99.9", "%", at_least=True),
    Figure("voxels inside the outlines", "100.0", "%", at_least=True),
)
SETS = (
    Known("temple", _below("middlebury_temple"), (Figure("epipolar error of matched features", "0.16", "px"),)),
    Known(
        "fountain", _below("strecha_fountain_quarter"), (Figure("epipolar error of matched features", "0.09", "px"),)
    ),
    Known("lego", _below("nerf_lego"), (Figure("epipolar error of matched features", "0.17", "px"),)),
    Known("COLMAP scene", _below("colmap_scene"), (Figure("reprojection error of sparse points", "0.25", "px"),)),
    Known("HoloLens", _below("hololens_rgbd"), (Figure("depth of one view in another", "0.3", "%"),)),
    Known("LSM car", _first("lsm_sample/renders/02958343/*"), LSM),
    Known("LSM chair", _first("lsm_sample/renders/03001627/*"), LSM),
    Known("R2N2 chair", _below("r2n2", "chair"), (Figure("voxels inside the outlines", "99.5", "%", at_least=True),)),
    Known("motorcycle", write_motorcycle, (Figure("picture warped by depth", "3.0", "grey levels"),)),
    Known(
        "binvox",
        _first("binvox/*.binvox"),
        (Figure("surface of the mesh in occupied voxels", "100.0", "%", at_least=True),),
    ),
    Known("chessboards", copy_chessboards, (Figure("rms of a stereo calibration from scratch", "0.217", "px"),)),
)


def reached(figure: Figure, measured: float) -> bool:
    """Whether a measurement is as good as the figure, in the digits that the figure has."""
    rounded = round(measured, len(figure.value.partition(".")[2]))
    return rounded >= float(figure.value) if figure.at_least else rounded <= float(figure.value)


def measure(known: Known, path: Path) -> list[dict[str, Any]]:
    """One row a figure."""
    start = time.perf_counter()
    content = detect(path).read(path)
    findings = diagnosis.examine(content, path)
    seconds = time.perf_counter() - start
    rows = []
    for figure in known.figures:
        check = next((check for check in findings.checks if check.name == figure.check), None)
        rows.append(
            {
                "set": known.name,
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
    return rows


def measure_mistakes(known: Known, path: Path) -> list[dict[str, Any]]:
    """One row a planted mistake."""
    content = detect(path).read(path)
    rows = []
    for name, plant in plants(content).items():
        findings = diagnosis.examine(plant(), path)
        cause = findings.cause
        rows.append(
            {
                "set": known.name,
                "planted": name,
                "verdict": findings.verdict,
                "named": None if cause is None else cause.name,
                "evidence": None if cause is None else cause.evidence,
                "failed": [check.name for check in findings.checks if not check.passed],
            }
        )
        print(f"{known.name:<14} {name:<26} {findings.verdict:<8} {rows[-1]['named'] or '-'}", flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The figures as text."""
    lines = [f"{'set':<14} {'figure':<44} {'known':>10} {'measured':>10} {'unit':<12} {'':<8} verdict"]
    for row in rows:
        known = f"{'>=' if row['at_least'] else '<='} {row['known']:g}"
        measured = "-" if row["measured"] is None else f"{row['measured']:.4g}"
        verdict = row["verdict"] + ("" if row["cause"] is None else f" ({row['cause']})")
        lines.append(
            f"{row['set']:<14} {row['figure']:<44} {known:>10} {measured:>10} {row['unit']:<12} "
            f"{'reached' if row['reached'] else 'MISSED':<8} {verdict}"
        )
    return "\n".join(lines)


def main() -> int:
    """Measure all sets, print the table, write the figures; 1 if one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("LSMGEO_TEST_DATA"), help="folder of the sets")
    parser.add_argument("--only", default="", help="sets whose name holds this")
    parser.add_argument("--mistakes", action="store_true", help="plant mistakes and see whether they are named")
    arguments = parser.parse_args()
    if arguments.data is None or not arguments.data.is_dir():
        parser.error("--data, or LSMGEO_TEST_DATA, must name the folder of sets")
    chosen = [known for known in SETS if arguments.only.lower() in known.name.lower()]
    with tempfile.TemporaryDirectory() as scratch:
        places = [(known, known.place(arguments.data, Path(scratch))) for known in chosen]
        if arguments.mistakes:
            rows = [row for known, path in places for row in measure_mistakes(known, path)]
            missed = sum(row["named"] != row["planted"] for row in rows)
            print(f"{len(rows) - missed} of {len(rows)} planted mistakes named")
        else:
            rows = [row for known, path in places for row in measure(known, path)]
            missed = sum(not row["reached"] for row in rows)
            print(table(rows))
    if not arguments.only:
        print(timing.save("planted_mistakes" if arguments.mistakes else "known_sets", timing.machine("cpu"), rows))
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
