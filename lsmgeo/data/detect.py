"""Which reader a folder needs, told from what lies in it."""

from __future__ import annotations

from pathlib import Path

from lsmgeo.data.colmap import model_folder, read_colmap
from lsmgeo.data.middlebury import parameter_files, read_middlebury
from lsmgeo.data.posed import PosedImages
from lsmgeo.errors import DataError

__all__ = ["open_scene"]


def open_scene(path: str | Path) -> PosedImages:
    """Open a folder of posed photographs; the format is told from the files that it holds.

    A folder with a ``*_par.txt`` is a Middlebury multi-view scene; one with ``cameras`` and ``images`` (``.bin`` or
    ``.txt``, also in ``sparse`` or ``sparse/0``) is a COLMAP reconstruction.

    Convention:
        Whatever the source's, the cameras come world-to-camera, OpenCV axes, integer pixel centres.

    Args:
        path: the scene's folder, or a ``*_par.txt`` file.

    Raises:
        DataError: there is no such folder, it holds neither format or both, or its reader refuses it.
    """
    path = Path(path)
    try:
        if path.is_file() and path.name.endswith("_par.txt"):
            return read_middlebury(path)
        if not path.is_dir():
            raise DataError(path, "no such folder")
        is_middlebury = bool(parameter_files(path))
        is_colmap = model_folder(path) is not None
    except (OSError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, f"cannot be read ({error})") from error
    if is_middlebury and is_colmap:
        raise DataError(path, "holds a COLMAP model and a *_par.txt; name the *_par.txt or the model's folder")
    if is_middlebury:
        return read_middlebury(path)
    if is_colmap:
        return read_colmap(path)
    raise DataError(path, "holds neither a Middlebury *_par.txt nor a COLMAP model (cameras and images, .bin or .txt)")
