"""Detecting the format of a file or folder; `FORMATS` is the one table of formats."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

from lsmgeo.data.formats.format_binvox import is_binvox, read_binvox
from lsmgeo.data.formats.format_cameras_json import is_cameras_json, read_cameras_json
from lsmgeo.data.formats.format_colmap import is_colmap, read_colmap
from lsmgeo.data.formats.format_llff import is_llff, read_llff
from lsmgeo.data.formats.format_lsm import is_lsm, read_lsm
from lsmgeo.data.formats.format_middlebury import is_middlebury, is_stereo_pair, read_middlebury, read_stereo_pair
from lsmgeo.data.formats.format_opencv import is_calibration, read_calibration
from lsmgeo.data.formats.format_r2n2 import is_r2n2, read_r2n2
from lsmgeo.data.formats.format_rgbd import is_rgbd, is_seven_scenes, read_rgbd, read_seven_scenes
from lsmgeo.data.formats.format_strecha import is_strecha, read_strecha
from lsmgeo.data.formats.format_transforms import is_transforms, read_transforms
from lsmgeo.data.images import SUFFIXES
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FORMATS", "Format", "detect", "open_scene"]


MOST_LISTED = 1000
# A file of an object, below a folder of many objects of the LSM release or of 3D-R2N2.
TREES = (
    "renders/*/*/camera_0.mat",
    "*/*/camera_0.mat",
    "*/rendering/rendering_metadata.txt",
    "*/*/rendering/rendering_metadata.txt",
    "*/*/*/rendering/rendering_metadata.txt",
)


class Format(NamedTuple):
    """A format, its detection and its reader.

    Attributes:
        name: the value of `PosedImages.source`.
        kind: its content: posed images, only voxels, or a calibration of cameras.
        needs: the files of a folder of this format, for error messages.
        is_here: whether a path, file or folder, is of this format. Looks at names and, if these do not suffice, at the
            beginning of a file; raises only OSError and DataError.
        read: the reader.
    """

    name: str
    kind: Literal["images", "voxels", "calibration"]
    needs: str
    is_here: Callable[[Path], bool]
    read: Callable[[Path], Any]


def _is_only_binvox(path: Path) -> bool:
    # 3D-R2N2 has the voxels of an object beside its renderings.
    return is_binvox(path) and not (path.is_dir() and is_r2n2(path))


FORMATS = (
    Format("middlebury", "images", "a Middlebury *_par.txt", is_middlebury, read_middlebury),
    Format("colmap", "images", "a COLMAP model (cameras and images, .bin or .txt)", is_colmap, read_colmap),
    Format("rgbd", "images", "K.txt, poses.txt and frame_index.txt of an RGB-D set", is_rgbd, read_rgbd),
    Format("7-scenes", "images", "frame-*.pose.txt of 7-Scenes", is_seven_scenes, read_seven_scenes),
    Format("middlebury-stereo", "images", "calib.txt and im0.png of a pair", is_stereo_pair, read_stereo_pair),
    Format("transforms", "images", "a transforms.json (or transforms_*.json)", is_transforms, read_transforms),
    Format("llff", "images", "an LLFF poses_bounds.npy", is_llff, read_llff),
    Format("cameras", "images", "a cameras.json of lsmgeo", is_cameras_json, read_cameras_json),
    Format("strecha", "images", "Strecha's *.camera files", is_strecha, read_strecha),
    Format("opencv", "calibration", "calibration files of OpenCV's FileStorage", is_calibration, read_calibration),
    Format("lsm", "images", "render_*.png and camera_*.mat of the LSM release", is_lsm, read_lsm),
    Format("r2n2", "images", "rendering_metadata.txt of 3D-R2N2", is_r2n2, read_r2n2),
    Format("binvox", "voxels", "a *.binvox file", _is_only_binvox, read_binvox),
)


@file_reader
def detect(path: str | Path) -> Format:
    """Detect the format of a folder, or of a file.

    Raises:
        DataError: the path does not exist, or is of no known format or of several.
    """
    path = Path(path)
    if not path.is_file() and not path.is_dir():
        raise DataError(path, "no such file or folder")
    found = [candidate for candidate in FORMATS if candidate.is_here(path)]
    if len(found) > 1:
        several = " and ".join(candidate.needs for candidate in found)
        raise DataError(path, f"holds {several}; pass the path of one file or folder")
    if not found:
        raise DataError(path, _why_nothing(path))
    return found[0]


def _why_nothing(path: Path) -> str:
    """The reason for a path without a format, the likely mistake first."""
    images, others = [], False
    for item in islice(path.iterdir(), MOST_LISTED) if path.is_dir() else [path]:
        if item.suffix.lower() in SUFFIXES:
            images.append(item)
        others = others or item not in images
    if path.is_file() and images:
        return "is an image; pass the folder of its cameras"
    if not images and not others:
        return "is empty"
    for pattern in TREES:
        inside = next(path.glob(pattern), None) if path.is_dir() else None
        if inside is not None:
            return f"is a tree of many objects; pass one of them, such as {inside.parent}, or convert it to shards"
    known = f"cameras are read from {', '.join(candidate.needs for candidate in FORMATS)}"
    if images and not others:
        return f"holds images but no file of cameras; {known}"
    return f"holds no known format; {known}"


def open_scene(path: str | Path) -> PosedImages:
    """Open posed images of any format; it is detected from the files of a folder, or from the file.

    Convention:
        Cameras are world-to-camera, OpenCV axes, integer pixel centres, whatever the source's convention.

    Args:
        path: the scene's folder; or its file of cameras, if a folder has several.

    Returns:
        The images with cameras, and the points, depth and voxels of the source.

    Raises:
        DataError: the path does not exist, is of no known format or of several, or cannot be read.
    """
    found = detect(path)
    if found.kind != "images":
        raise DataError(path, f"holds {found.needs}, but no posed images")
    return cast("PosedImages", found.read(Path(path)))
