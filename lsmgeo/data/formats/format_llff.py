"""LLFF's ``poses_bounds.npy``: one row for each image, in the order of their names."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from lsmgeo.data.formats.scene_assembly import MAX_PARAMETER, MAX_SIDE, SceneBuilder, any_alpha
from lsmgeo.data.images import SUFFIXES, image_size
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader, path_inside
from lsmgeo.errors import DataError

__all__ = ["is_llff", "read_llff"]

NAME = "poses_bounds.npy"
COLUMNS = 17
MAX_BYTES = 1 << 24
REDUCED = ("images_2", "images_4", "images_8")


def is_llff(path: Path) -> bool:
    """Whether a folder has ``poses_bounds.npy``, or a file is such an array by its shape."""
    if path.is_dir():
        return (path / NAME).is_file()
    if path.name == NAME:
        return True
    if path.suffix != ".npy":
        return False
    try:
        return _read_array(path).shape[1:] == (COLUMNS,)
    except DataError:
        return False


@file_reader
def read_llff(path: str | Path) -> PosedImages:
    """Read a scene of LLFF, the format of NeRF's forward-facing scenes and of mip-NeRF 360.

    A row is a 3 x 5 matrix ``[R | centre | (height, width, focal length)]``, camera-to-world, then the nearest and
    farthest depth, which are not used here. (Mildenhall et al., "Local Light Field Fusion", SIGGRAPH 2019.) The
    images are in ``images``, else in ``images_2``, ``images_4`` or ``images_8``, sorted by name.

    Convention:
        The columns of R are the camera's down, right and back; they become right, down, forward, and the pose
        world-to-camera. The principal point is the centre of the image, ((width - 1) / 2, (height - 1) / 2) in integer
        pixel centres. If an image has another size than its row, K is resized: ``f' = f w' / w``.

    Args:
        path: the scene's folder, or its ``poses_bounds.npy``.

    Returns:
        The images with their cameras, no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, a row is invalid, the numbers of images and rows
            differ, or an image has another shape than its row.
    """
    path = Path(path)
    file = path / NAME if path.is_dir() else path
    rows = _read_array(file)
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or len(rows) == 0:
        raise DataError(file, f"must hold rows of {COLUMNS} numbers; got an array of {rows.shape}")
    if not (np.abs(rows) < 1e12).all():
        raise DataError(file, "holds a number that is not finite, or beyond 1e12")
    paths = _images(file)
    if len(paths) != len(rows):
        found = f"{len(paths)} images are in {paths[0].parent.name!r}" if paths else "no folder images holds an image"
        raise DataError(file, f"has {len(rows)} rows, and {found}")

    matrices = rows[:, :15].reshape(-1, 3, 5)
    down, right, back = (matrices[:, :, column] for column in range(3))
    R = np.stack((right, down, -back), -1).transpose(0, 2, 1)
    t = -(R @ matrices[:, :, 3:4])[..., 0]
    builder = SceneBuilder("llff", file, pixel_center="half")
    for view, path in enumerate(paths):
        K = _intrinsics(matrices[view, :, 4], image_size(path), file, f"row {view} ({path.name!r})")
        builder.add(path.name, path, K, R[view], t[view], f"row {view}")
    return builder.scene(cut_out=any_alpha(paths))


def _read_array(file: Path) -> np.ndarray:
    """The array as float64; the stated shape is compared with the size of the file before anything is allocated."""
    if not file.is_file() or (size := file.stat().st_size) > MAX_BYTES:
        raise DataError(file, f"no such file, or larger than the limit of {MAX_BYTES} bytes")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            array = np.lib.format.open_memmap(file, mode="r")
    # NumPy parses the header as a Python literal, which raises many kinds of errors.
    except Exception as error:
        raise DataError(file, f"is not a .npy array ({str(error)[:120]})") from error
    if array.dtype.newbyteorder("=") not in (np.float32, np.float64):
        raise DataError(file, f"must hold float32 or float64; got {str(array.dtype)[:80]}")
    if array.offset + array.nbytes != size:
        raise DataError(file, f"states an array of {array.shape}, but holds more")
    return np.array(array, np.float64)


def _images(file: Path) -> list[Path]:
    """The images of the first folder that exists, sorted by name."""
    for name in ("images", *REDUCED):
        folder = file.parent / name
        if folder.is_dir():
            # macOS leaves a file with a leading dot beside each image.
            seen = (path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
            found = sorted(name for name in seen if not name.startswith("."))
            return [path_inside(file.parent, f"{name}/{image}", file) for image in found]
    return []


def _intrinsics(stated: np.ndarray, size: tuple[int, int], file: Path, where: str) -> np.ndarray:
    """K of an image, half-integer pixel centres, scaled from the resolution of its row."""
    height, width, focal = (float(value) for value in stated)
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE and 0 < focal <= MAX_PARAMETER):
        reason = f"{width:g} x {height:g} pixels (width x height) with a focal length of {focal:g} is no valid camera"
        raise DataError(file, f"{where}: {reason}")
    down, across = size[0] / height, size[1] / width
    # The sides of a reduced image are rounded to integers, so the aspect ratio may differ by one pixel.
    if abs(size[1] - down * width) > 1 + width / height:
        reason = f"the row is for {width:g} x {height:g} pixels and the image has {size[1]} x {size[0]}"
        raise DataError(file, f"{where}: {reason} (width x height): another shape")
    return np.array([[focal * across, 0, size[1] / 2], [0, focal * down, size[0] / 2], [0, 0, 1]])
