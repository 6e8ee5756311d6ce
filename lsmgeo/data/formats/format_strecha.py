"""Strecha's multi-view scenes: a ``.camera`` file beside every image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lsmgeo.data.formats.scene_assembly import SceneBuilder
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader, parse_floats, path_inside, plain_files, read_text
from lsmgeo.errors import DataError

__all__ = ["is_strecha", "read_strecha"]

SUFFIX = ".camera"
# In the folder, else in its subfolders.
PATTERNS = ("*.camera", "*/*.camera")
MAX_CAMERA_BYTES = 1 << 16
# Numbers in a file: K, three of radial distortion, R, the camera centre, width and height.
PARTS = (9, 3, 9, 3, 2)


def is_strecha(path: Path) -> bool:
    """Whether a folder has ``.camera`` files, or a file is one by its name."""
    return bool(plain_files(path, *PATTERNS)) if path.is_dir() else path.suffix == SUFFIX


@file_reader
def read_strecha(path: str | Path) -> PosedImages:
    """Read a scene of the form of Strecha's multi-view benchmark.

    ``0000.png.camera`` belongs to ``0000.png``, with K (3 lines), three numbers of radial distortion, R (3 lines),
    the camera's centre C, then width and height; the projection is ``K [R^T | -R^T C]``. (Strecha, von Hansen, Van
    Gool, Fua, Thoennessen, "On benchmarking camera calibration and multi-view stereo for high resolution imagery", CVPR
    2008.) The images are beside these files, in their folder ``images``, or in ``images`` beside their folder; ``.P``
    and ``.bounding`` files are not read.

    Convention:
        R is camera-to-world with OpenCV axes, and is transposed. Pixel centres are integer, as in lsmgeo.

    Args:
        path: the folder of the ``.camera`` files, or its parent; or one of these files, for all of its folder.

    Returns:
        The images with their cameras, ordered by name; no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, several folders have such files, or a camera has
            distortion, is invalid, or is of another size than its image.
    """
    path = Path(path)
    files = plain_files(path if path.is_dir() else path.parent, *PATTERNS)
    folders = sorted({file.parent for file in files})
    if len(folders) != 1:
        found = ", ".join(folder.name for folder in folders[:5]) or "none"
        raise DataError(path, f"expected *{SUFFIX} files in one folder; found {found}")
    builder = SceneBuilder("strecha", folders[0])
    for file in files:
        numbers = parse_floats(read_text(file, MAX_CAMERA_BYTES).split(), file, "camera")
        if len(numbers) != sum(PARTS):
            raise DataError(file, f"expected {sum(PARTS)} numbers (K, distortion, R, centre, size); got {len(numbers)}")
        matrix, radial, rotation, center, (width, height) = np.split(np.array(numbers), np.cumsum(PARTS)[:-1])
        if radial.any():
            raise DataError(file, "has radial distortion, whose model the format does not define; undistort first")
        if np.abs(center).max() > 1e12:
            raise DataError(file, "the camera centre is beyond 1e12")
        name, R = file.name.removesuffix(SUFFIX), rotation.reshape(3, 3).T
        size = (height, width)
        builder.add(name, _image(file, name), matrix.reshape(3, 3), R, -R @ center, "camera", size=size, file=file)
    return builder.scene()


def _image(file: Path, name: str) -> Path:
    for root in (file.parent, file.parent / "images", file.parent.parent / "images"):
        if root.is_dir():
            image = path_inside(root, name, file)
            if image.is_file():
                return image
    raise DataError(file, f"has no image {name[:80]!r} beside it, in images or in ../images")
