"""Middlebury multi-view scenes: a folder of photographs and one ``*_par.txt`` with their cameras."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.assembling import assemble, check_intrinsics, check_rotation, make_cameras
from lsmgeo.data.files import child, one_file, parse_floats, parse_ints, plain_files, read_text, refuse_unreadable
from lsmgeo.data.images import image_size
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from lsmgeo.data.posed import PosedImages

__all__ = ["is_middlebury", "read_middlebury"]

PARAMETERS = "*_par.txt"
MAX_PARAMETER_BYTES = 1 << 24


def is_middlebury(path: Path) -> bool:
    """Whether a folder holds a file of parameters, or a file is one by its name."""
    return path.match(PARAMETERS) if path.is_file() else bool(plain_files(path, PARAMETERS))


@refuse_unreadable
def read_middlebury(path: str | Path) -> PosedImages:
    """Read a Middlebury multi-view scene.

    The file's first line counts the photographs; every other line is ``name K (9) R (9) t (3)`` with the projection
    ``K [R | t]``. (Seitz, Curless, Diebel, Scharstein, Szeliski, "A comparison and evaluation of multi-view stereo
    reconstruction algorithms", CVPR 2006.)

    Convention:
        The source has our own convention (world-to-camera, OpenCV axes, integer pixel centres); nothing is changed.

    Args:
        path: the scene's folder, or its ``*_par.txt``.

    Returns:
        The photographs with their cameras, no sparse points.

    Raises:
        DataError: a file is missing, damaged, too large, names a file outside the folder, or holds no camera.
    """
    file = one_file(Path(path), PARAMETERS)
    lines = [line.split() for line in read_text(file, MAX_PARAMETER_BYTES).splitlines() if line.strip()]
    if not lines or len(lines[0]) != 1:
        raise DataError(file, "the first line must be the number of photographs")
    (count,) = parse_ints(lines[0], file, "line 1")
    if count != len(lines) - 1 or count < 1:
        raise DataError(file, f"announces {count} photographs and holds {len(lines) - 1} lines of cameras")

    names, paths, sizes = [], [], []
    numbers = np.zeros((count, 21))
    for view, tokens in enumerate(lines[1:]):
        where = f"line {view + 2}"
        if len(tokens) != 22:
            raise DataError(file, f"{where}: expected a name and 21 numbers; got {len(tokens)} items")
        numbers[view] = parse_floats(tokens[1:], file, where)
        check_intrinsics(numbers[view, :9].reshape(3, 3), file, where)
        check_rotation(numbers[view, 9:18].reshape(3, 3), file, where)
        names.append(tokens[0])
        paths.append(child(file.parent, tokens[0], file))
        # The format does not state the size, so it comes from the picture's own header.
        sizes.append(image_size(paths[-1]))
    K, R, t = np.split(numbers, (9, 18), -1)
    cameras = make_cameras(K.reshape(-1, 3, 3), R.reshape(-1, 3, 3), t, sizes, file)
    return assemble(names, paths, cameras, "middlebury", file=file)
