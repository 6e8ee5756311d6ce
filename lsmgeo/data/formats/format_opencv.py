"""Calibrations in the form of OpenCV's samples: lenses, rigs of two cameras, and the images of chessboards."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from lsmgeo.data.formats.lenses import Lens
from lsmgeo.data.formats.opencv_storage import is_storage, parse_storage
from lsmgeo.data.formats.scene_assembly import MAX_SIDE, check_intrinsics, check_rotation
from lsmgeo.data.images import SUFFIXES
from lsmgeo.data.isolated import parse_isolated
from lsmgeo.data.read_files import file_reader, path_inside
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

__all__ = ["Board", "CalibratedLens", "Calibration", "Rig", "calibration_files", "is_calibration", "read_calibration"]

MOST_FILES = 64
# Ten times a calibration with the corners of a hundred boards.
MAX_STORAGE_BYTES = 1 << 22
# Address space, most of it for OpenCV and NumPy.
MEMORY = 1 << 30
SECONDS = 30.0
BEYOND = 1e12
MOST_COEFFICIENT = 1e6
MOST_CORNERS = 100
COUNTS = {"perspective": (4, 5, 8, 12, 14), "fisheye": (4,)}
# Names are compared without underscores and in lower case: OpenCV's samples differ in both.
MATRICES = ("cameramatrix", "intrinsicmatrix", "m", "k")
DISTORTIONS = ("distortioncoefficients", "distcoeffs", "distcoeff", "d")


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """A lens of a calibration.

    Attributes:
        kind: "perspective" or "fisheye", as in `Lens`.
        intrinsics: (3, 3) float64, integer pixel centres.
        coefficients: of the distortion, as in `Lens`; zeros if none are stated.
        size: (height, width) of its images, None if not stated.
        views: (N, 6) poses of the board in N images, board-to-camera: rotation vector (radians), then translation
            (units of the square's size); None if not stated.
        file: the file that states it.
    """

    kind: Literal["perspective", "fisheye"]
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]
    size: tuple[int, int] | None
    views: np.ndarray | None
    file: Path

    def sized(self, height: int, width: int) -> Lens:
        """The lens for images of this size."""
        return Lens(self.kind, self.intrinsics, self.coefficients, height, width)


class Entries(NamedTuple):
    """The values of one file, by name in lower case and without underscores."""

    numbers: dict[str, float]
    texts: dict[str, tuple[str, ...]]
    matrices: dict[str, np.ndarray]


class Rig(NamedTuple):
    """Two cameras fixed to each other: X_second = rotation X_first + translation, of camera coordinates."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,), units of the square's size
    file: Path


class Board(NamedTuple):
    """A chessboard."""

    corners: tuple[int, int]  # inner corners along a row and along a column
    square: float | None  # side of a square, None if not stated


@dataclass(frozen=True, eq=False)
class Calibration:
    """The content of calibration files.

    Convention:
        OpenCV: x right, y down, z forward, integer pixel centres; poses are board-to-camera and first-to-second camera.

    Attributes:
        lenses: by name: "first" and "second" of a rig, otherwise the name of the file without its suffix.
        rig: the pose of the second camera relative to the first, if stated.
        board: the chessboard, if its corners are stated.
        images: files of the board's images, one tuple for each camera: two of equal length, of pairs taken at the same
            time; or one, or none.
        source: the name of the format.
    """

    lenses: dict[str, CalibratedLens]
    rig: Rig | None = None
    board: Board | None = None
    images: tuple[tuple[Path, ...], ...] = field(default=())
    source: str = "opencv"

    @property
    def pictures(self) -> tuple[tuple[Path, ...], ...]:
        """The old name of `images`, for this version."""
        warnings.warn("Calibration.pictures is now Calibration.images", DeprecationWarning, stacklevel=2)
        return self.images


def calibration_files(folder: Path) -> list[Path]:
    """The FileStorage files of a folder, sorted."""
    return sorted(path for path in folder.iterdir() if is_storage(path))


def is_calibration(path: Path) -> bool:
    """Whether `read_calibration` can read a file, or a file of a folder."""
    return bool(calibration_files(path)) if path.is_dir() else is_storage(path)


@file_reader
def read_calibration(path: str | Path) -> Calibration:
    """Read calibrations of OpenCV's FileStorage, as YAML, XML or JSON.

    Names are those of OpenCV's samples: ``camera_matrix`` and ``distortion_coefficients`` with ``image_width``,
    ``image_height``, ``board_width``, ``board_height``, ``square_size`` and ``extrinsic_parameters``; ``M1 D1 M2 D2``,
    ``K1 D1 K2 D2`` or ``cameraMatrix1 distCoeffs1`` and the like, with ``R T``, for a rig; ``fisheye_model``; and one
    list of images.
    (https://docs.opencv.org, tutorial "Camera calibration With OpenCV" and samples calibration and stereo_calib.)

    All files of a folder are read together: the lenses of a rig, its R and T and the list of its images are usually in
    three files. Nothing may be stated twice. Missing images of a list are left out, with their partner. JSON files
    without a matrix of OpenCV are ignored.

    Convention:
        OpenCV's, which is that of lsmgeo; nothing is converted.

    Args:
        path: a file, or a folder of such files.

    Returns:
        The lenses, rig, board and images that the files state.

    Raises:
        DataError: a file is damaged or too large, crashes its parser, states an invalid lens or rotation, or names an
            image outside its folder; two files state the same; or there is nothing to use.
    """
    path = Path(path)
    files = calibration_files(path) if path.is_dir() else [path]
    if not 0 < len(files) <= MOST_FILES:
        raise DataError(path, f"expected 1 to {MOST_FILES} calibration files (YAML, XML or JSON); found {len(files)}")
    lenses: dict[str, CalibratedLens] = {}
    rig = board = None
    lists: list[tuple[Path, tuple[str, ...]]] = []
    for file, entries in zip(files, read_storage_files(files), strict=True):
        if isinstance(entries, DataError):
            raise entries
        for name, lens in _lenses(entries, file):
            if name in lenses:
                raise DataError(
                    file, f"states the lens {name!r} as {lenses[name].file.name} does; pass the path of one file"
                )
            lenses[name] = lens
        if (found := _rig(entries, file)) is not None:
            if rig is not None:
                raise DataError(file, f"states R and T, and so does {rig.file.name}; pass the path of one file")
            rig = found
        if (stated := _board(entries, file)) is not None:
            if board is not None and board.corners != stated.corners:
                raise DataError(file, f"states a board of {stated.corners} corners, another file {board.corners}")
            board = stated
        lists += [(file, names) for names in entries.texts.values() if _are_images(names)]
    if len(lists) > 1:
        raise DataError(lists[1][0], f"lists images, and so does {lists[0][0].name}; pass the path of one file")
    images = _images(*lists[0]) if lists else ()
    if not lenses and rig is None and not images:
        raise DataError(path, "has no camera matrix, no R and T, and no list of images")
    return Calibration(lenses, rig, board, images)


def read_storage_files(paths: Sequence[Path]) -> list[Entries | DataError]:
    """The top-level values of each FileStorage file, matrices as float64; or the error of an unusable file."""
    results: list[Entries | DataError] = []
    found = parse_isolated(parse_storage, paths, limit=MAX_STORAGE_BYTES, memory=MEMORY, seconds=SECONDS)
    for path, arrays in zip(paths, found, strict=True):
        if isinstance(arrays, DataError):
            results.append(arrays)
            continue
        folded = {name.replace("_", "").lower(): array for name, array in arrays.items()}
        numbers = {name: array for name, array in folded.items() if array.dtype == np.float64 and array.ndim in (0, 2)}
        wrong = [name for name, array in numbers.items() if not (np.abs(array) <= BEYOND).all()]
        if len(folded) != len(arrays):
            results.append(DataError(path, "has two names that differ only in capitals or underscores"))
        elif wrong:
            results.append(DataError(path, f"{wrong[0][:80]!r} must hold finite numbers of at most {BEYOND:g}"))
        else:
            scalars = {name: float(array) for name, array in numbers.items() if array.ndim == 0}
            texts = {name: tuple(array.ravel().tolist()) for name, array in folded.items() if array.dtype.kind == "U"}
            results.append(Entries(scalars, texts, {name: numbers[name] for name in numbers if name not in scalars}))
    return results


def _lenses(entries: Entries, file: Path) -> Iterator[tuple[str, CalibratedLens]]:
    for number, name in (("", file.stem), ("1", "first"), ("2", "second")):
        matrix = _one_of(entries.matrices, MATRICES, number, file)
        distortion = _one_of(entries.matrices, DISTORTIONS, number, file)
        if matrix is None:
            continue
        if matrix.shape != (3, 3):
            raise DataError(file, f"{name}: K must be 3 x 3; got {matrix.shape[0]} x {matrix.shape[1]}")
        check_intrinsics(matrix, file, name)
        if matrix[0, 1] != 0:
            raise DataError(file, f"{name}: K has skew, which OpenCV's lens model does not support")
        kind: Literal["perspective", "fisheye"] = "fisheye" if entries.numbers.get("fisheyemodel") else "perspective"
        coefficients = np.zeros(4) if distortion is None else distortion.ravel()
        if len(coefficients) not in COUNTS[kind]:
            raise DataError(file, f"{name}: {len(coefficients)} coefficients of distortion; expected {COUNTS[kind]}")
        if np.abs(coefficients).max() > MOST_COEFFICIENT:
            raise DataError(file, f"{name}: a coefficient of distortion beyond {MOST_COEFFICIENT:g}")
        views = entries.matrices.get("extrinsicparameters") if number == "" else None
        if views is not None and views.shape[1] != 6:
            raise DataError(file, f"{name}: extrinsic_parameters must have 6 columns; got {views.shape[1]}")
        size = _whole(entries, ("imageheight", "imagewidth"), MAX_SIDE, file)
        yield name, CalibratedLens(kind, matrix, tuple(map(float, coefficients)), size, views, file)


def _one_of(matrices: dict[str, np.ndarray], names: tuple[str, ...], number: str, file: Path) -> np.ndarray | None:
    found = [name + number for name in names if name + number in matrices]
    if len(found) > 1:
        raise DataError(file, f"states {found[0]} and {found[1]}, which are synonyms")
    return matrices[found[0]] if found else None


def _whole(entries: Entries, names: tuple[str, str], most: int, file: Path) -> tuple[int, int] | None:
    if not all(name in entries.numbers for name in names):
        return None
    values = [entries.numbers[name] for name in names]
    if any(value != int(value) or not 1 <= value <= most for value in values):
        raise DataError(file, f"{names[0]} and {names[1]} must be whole numbers from 1 to {most}; got {values}")
    return int(values[0]), int(values[1])


def _board(entries: Entries, file: Path) -> Board | None:
    corners = _whole(entries, ("boardwidth", "boardheight"), MOST_CORNERS, file)
    if corners is None:
        return None
    square = entries.numbers.get("squaresize")
    if square is not None and square <= 0:
        raise DataError(file, f"square_size must be positive; got {square:g}")
    if min(corners) < 2:
        raise DataError(file, f"a board must have at least 2 corners a side; got {corners}")
    return Board(corners, square)


def _rig(entries: Entries, file: Path) -> Rig | None:
    rotation, translation = entries.matrices.get("r"), entries.matrices.get("t")
    if rotation is None or translation is None:
        return None
    if translation.size != 3 or rotation.size not in (3, 9) or (rotation.size == 9 and rotation.shape != (3, 3)):
        raise DataError(file, "R must be 3 x 3 (or a rotation vector) and T three numbers")
    if rotation.size == 3:
        import cv2

        if np.abs(rotation).max() > 2 * np.pi:
            raise DataError(file, "R is a rotation vector of more than 360 degrees")
        rotation = np.asarray(cv2.Rodrigues(rotation.reshape(3, 1))[0])
    check_rotation(rotation, file, "R")
    return Rig(rotation, translation.ravel(), file)


def _are_images(names: tuple[str, ...]) -> bool:
    return bool(names) and all(name.lower().endswith(SUFFIXES) for name in names)


def _images(file: Path, names: tuple[str, ...]) -> tuple[tuple[Path, ...], ...]:
    if len(set(names)) != len(names):
        raise DataError(file, "lists an image twice")
    paths = [path_inside(file.parent, name, file) for name in names]
    # Two cameras if names without digits alternate: left01.jpg, right01.jpg, left02.jpg, ...
    kinds = [re.sub(r"\d", "", name) for name in names]
    if len(names) % 2 == 0 and set(kinds[0::2]) != set(kinds[1::2]) and len(set(kinds)) == 2:
        pairs = [pair for pair in zip(paths[0::2], paths[1::2], strict=True) if all(path.is_file() for path in pair)]
        return tuple(zip(*pairs, strict=True))
    here = tuple(path for path in paths if path.is_file())
    return (here,) if here else ()
