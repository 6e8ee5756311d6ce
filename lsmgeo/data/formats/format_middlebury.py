"""Middlebury: multi-view scenes with one ``*_par.txt``, and the stereo pairs of 2014 and 2021 with disparities."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.formats.depth_files import DepthFile, read_pfm
from lsmgeo.data.formats.scene_assembly import SceneBuilder, check_intrinsics
from lsmgeo.data.read_files import file_reader, one_file, parse_floats, parse_ints, path_inside, plain_files, read_text
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from lsmgeo.data.posed_images import PosedImages

__all__ = ["Disparity", "is_middlebury", "is_stereo_pair", "read_middlebury", "read_stereo_pair"]

PARAMETERS = "*_par.txt"
MAX_PARAMETER_BYTES = 1 << 24
MAX_CALIBRATION_BYTES = 1 << 16
MOST = 1e7
# Files are rounded to three decimals.
ROUNDING = 0.01
NAME = re.compile(r"\w{1,32}")
MATRIX = re.compile(r"\[([^;\[\]]*);([^;\[\]]*);([^;\[\]]*)\]")
# The second name is that of version 3 of the benchmark.
DISPARITIES = (("disp0.pfm", "disp0GT.pfm"), ("disp1.pfm", "disp1GT.pfm"))


def is_middlebury(path: Path) -> bool:
    """Whether a folder has a ``*_par.txt``, or a file is one by its name."""
    return path.match(PARAMETERS) if path.is_file() else bool(plain_files(path, PARAMETERS))


@file_reader
def read_middlebury(path: str | Path) -> PosedImages:
    """Read a Middlebury multi-view scene.

    The file's first line counts the images; every other line is ``name K (9) R (9) t (3)`` with the projection
    ``K [R | t]``. (Seitz, Curless, Diebel, Scharstein, Szeliski, "A comparison and evaluation of multi-view stereo
    reconstruction algorithms", CVPR 2006.)

    Convention:
        World-to-camera, OpenCV axes, integer pixel centres, as in lsmgeo; nothing is converted.

    Args:
        path: the scene's folder, or its ``*_par.txt``.

    Returns:
        The images with their cameras; no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, names a file outside the folder, or has an invalid camera.
    """
    file = one_file(Path(path), PARAMETERS)
    lines = [line.split() for line in read_text(file, MAX_PARAMETER_BYTES).splitlines() if line.strip()]
    if not lines or len(lines[0]) != 1:
        raise DataError(file, "the first line must be the number of images")
    (count,) = parse_ints(lines[0], file, "line 1")
    if count != len(lines) - 1 or count < 1:
        raise DataError(file, f"announces {count} images but has {len(lines) - 1} lines of cameras")

    builder = SceneBuilder("middlebury", file)
    for number, (name, *tokens) in enumerate(lines[1:], 2):
        where = f"line {number}"
        if len(tokens) != 21:
            raise DataError(file, f"{where}: expected a name and 21 numbers; got {len(tokens) + 1} items")
        K, R, t = np.split(np.array(parse_floats(tokens, file, where)), (9, 18))
        # The format does not state sizes; they are those of the images.
        path = path_inside(file.parent, name, file)
        builder.add(name, path, K.reshape(3, 3), R.reshape(3, 3), t, where)
    return builder.scene()


@dataclass(frozen=True)
class Disparity(DepthFile):
    """Depth from the disparity of a rectified pair: Z = f B / (d + doffs).

    Attributes:
        path: a portable float map of positive disparities d in pixels, infinite if unknown.
        focal_length: f in pixels.
        baseline: B in world units.
        offset: doffs, cx of the right camera minus cx of the left one, in pixels.
    """

    path: Path
    focal_length: float
    baseline: float
    offset: float

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 camera z, 0 if the disparity is unknown, or of no point in front of the camera."""
        shift = read_pfm(self.path, size).astype(np.float64) + self.offset
        known = np.isfinite(shift) & (shift > 0)
        depth = self.focal_length * self.baseline / np.where(known, shift, 1.0)
        # A disparity close to -doffs is a depth beyond float32, and not a measurement.
        known &= depth < np.finfo(np.float32).max
        return np.where(known, depth, 0.0).astype(np.float32)


def is_stereo_pair(path: Path) -> bool:
    """Whether `read_stereo_pair` can read a folder or a ``calib.txt``."""
    if path.is_file():
        return path.name == "calib.txt" and is_stereo_pair(path.parent)
    return (path / "calib.txt").is_file() and (path / "im0.png").is_file()


@file_reader
def read_stereo_pair(path: str | Path) -> PosedImages:
    """Read a stereo pair of the Middlebury sets of 2014 and 2021.

    ``calib.txt`` holds ``cam0=[f 0 cx; 0 f cy; 0 0 1]``, ``cam1``, ``doffs``, ``baseline``, ``width``, ``height`` and
    more; ``im0.png`` and ``im1.png`` are the left and the right image, ``disp0.pfm`` and ``disp1.pfm`` their
    disparities. (Scharstein et al., "High-resolution stereo datasets with subpixel-accurate ground truth", GCPR 2014.)

    Equation: a left pixel (x, y) with disparity d is the right pixel (x - d, y), and Z = f B / (d + doffs).

    Convention:
        Integer pixel centres and OpenCV axes, as in lsmgeo. The world frame is the left camera, in the unit of
        ``baseline``: millimetres in the published sets.

    Args:
        path: the folder, or its ``calib.txt``.

    Returns:
        The left image, then the right one, with cameras and their depth, if any; no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, or leads outside the folder; or the cameras are not a
            rectified pair.
    """
    path = Path(path)
    folder = path.parent if path.is_file() else path
    file = folder / "calib.txt"
    entries = _entries(file)
    first, second = (_camera(entries, name, file) for name in ("cam0", "cam1"))
    offset, baseline = (_number(entries, name, file) for name in ("doffs", "baseline"))
    if baseline <= 0:
        raise DataError(file, "baseline must be positive")
    focal_length = float(first[0, 0])
    if np.abs(first - second)[[0, 1, 1], [0, 1, 2]].max() > ROUNDING:
        raise DataError(file, "cam0 and cam1 must have the same focal length and cy: this is not a rectified pair")
    if abs(second[0, 2] - first[0, 2] - offset) > ROUNDING:
        raise DataError(file, f"doffs is {offset:g}, but cx of cam1 minus cx of cam0 is {second[0, 2] - first[0, 2]:g}")
    size = None
    if "height" in entries and "width" in entries:
        height, width = parse_ints([entries["height"], entries["width"]], file, "height and width")
        size = (height, width)
    builder = SceneBuilder("middlebury-stereo", file)
    for name, K, x, maps in zip(("im0.png", "im1.png"), (first, second), (0.0, -baseline), DISPARITIES, strict=True):
        here = [path_inside(folder, disparity, file) for disparity in maps if (folder / disparity).exists()]
        depth = Disparity(here[0], focal_length, baseline, offset) if here else None
        t = np.array([x, 0.0, 0.0])
        builder.add(name, path_inside(folder, name, file), K, np.eye(3), t, "width and height", size=size, depth=depth)
    return builder.scene()


def _entries(file: Path) -> dict[str, str]:
    entries: dict[str, str] = {}
    for number, line in enumerate(read_text(file, MAX_CALIBRATION_BYTES).splitlines(), 1):
        if not line.strip():
            continue
        name, equals, value = (part.strip() for part in line.partition("="))
        if not equals or NAME.fullmatch(name) is None:
            raise DataError(file, f"line {number}: expected name=value")
        if name in entries:
            raise DataError(file, f"line {number}: states {name} twice")
        entries[name] = value
    return entries


def _stated(entries: dict[str, str], name: str, file: Path) -> str:
    if name not in entries:
        raise DataError(file, f"does not state {name}")
    return entries[name]


def _number(entries: dict[str, str], name: str, file: Path) -> float:
    (value,) = parse_floats([_stated(entries, name, file)], file, name)
    if abs(value) > MOST:
        raise DataError(file, f"{name} is beyond {MOST:g}")
    return value


def _camera(entries: dict[str, str], name: str, file: Path) -> np.ndarray:
    match = MATRIX.fullmatch(_stated(entries, name, file))
    rows = [] if match is None else [row.split() for row in match.groups()]
    if [len(row) for row in rows] != [3, 3, 3]:
        raise DataError(file, f"{name} must be a 3 x 3 matrix [a b c; d e f; g h i]")
    K = np.array([parse_floats(row, file, name) for row in rows])
    check_intrinsics(K, file, name)
    if K[0, 1] != 0 or abs(K[1, 1] - K[0, 0]) > ROUNDING:
        raise DataError(file, f"{name} must have one focal length and no skew")
    return K
