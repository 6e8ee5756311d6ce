"""The plain JSON format of lsmgeo, whose conventions are those of the library."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.cameras import CameraTensors
from lsmgeo.data.formats.depth_files import DepthPng
from lsmgeo.data.formats.scene_assembly import SceneBuilder, any_alpha, check_last_row
from lsmgeo.data.json_files import read_array, read_json, read_number, read_string, sniff_json
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader, path_inside
from lsmgeo.errors import DataError

__all__ = ["NAME", "camera_entry", "encode_cameras", "is_cameras_json", "read_cameras_json"]

NAME = "cameras.json"
FORMAT = "lsmgeo cameras"
VERSION = 1
PIXEL_CENTERS = ("integer", "half")
MOST_CAMERAS = 100_000


def is_cameras_json(path: Path) -> bool:
    """Whether a JSON file, or the ``cameras.json`` of a folder, is of this format."""
    file = path / NAME if path.is_dir() else path
    if file.suffix.lower() != ".json" or not file.is_file():
        return False
    values = sniff_json(file)
    cameras = values.get("cameras")
    return values.get("format") == FORMAT or (
        isinstance(cameras, list) and bool(cameras) and isinstance(cameras[0], dict) and "K" in cameras[0]
    )


@file_reader
def read_cameras_json(path: str | Path) -> PosedImages:
    """Read cameras from a plain JSON file.

    ::

        {
            "format": "lsmgeo cameras",
            "version": 1,
            "pixel_center": "integer",
            "cameras": [
                {
                    "file": "images/a.png",
                    "width": 640,
                    "height": 480,
                    "K": [[...], [...], [...]],
                    "cam_from_world": [[...], [...], [...], [...]],
                    "depth": "depth/a.png",
                    "depth_step": 0.001,
                },
                ...,
            ],
        }

    ``format`` and ``version`` are optional; ``name`` may replace ``file``, and ``R`` (3 x 3) with ``t`` (3)
    ``cam_from_world``. The optional ``depth`` is a 16-bit PNG of the image's size: camera z in steps of ``depth_step``
    world units, 0 for no depth.

    Convention:
        World-to-camera, OpenCV axes; K may have skew. ``pixel_center`` is "integer" (the default) or "half": the first
        pixel is centred at (0.5, 0.5).

    Args:
        path: the file, or a folder with ``cameras.json``.

    Returns:
        The images with their cameras and depth, cut out if any of them has alpha; no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, names a file outside its folder, is of another version, or
            states a camera that is invalid or of another size than its image.
    """
    path = Path(path)
    file = path / NAME if path.is_dir() else path
    values = read_json(file)
    stated = (values.get("format", FORMAT), values.get("version", VERSION))
    if stated != (FORMAT, VERSION) or isinstance(stated[1], bool):
        reason = f"format {describe(stated[0])}, version {describe(stated[1])}"
        raise DataError(file, f"has {reason}; expected {FORMAT!r}, version {VERSION}")
    center = values.get("pixel_center", "integer")
    if center not in PIXEL_CENTERS:
        raise DataError(file, f"pixel_center must be one of {', '.join(PIXEL_CENTERS)}; got {describe(center)}")
    entries = values.get("cameras")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_CAMERAS:
        raise DataError(file, f"cameras must be a list of 1 to {MOST_CAMERAS} cameras; got {describe(entries)}")

    builder = SceneBuilder("cameras", file, pixel_center=center)
    for view, entry in enumerate(entries):
        where = f"camera {view}"
        if not isinstance(entry, dict):
            raise DataError(file, f"{where}: expected an object; got {describe(entry)}")
        name = read_string(entry, "file" if "file" in entry else "name", file, where)
        K, pose = read_array(entry, "K", (3, 3), file, where), _pose(entry, file, where)
        path, size, depth = path_inside(file.parent, name, file), _size(entry, file, where), _depth(entry, file, where)
        builder.add(name, path, K, pose[:, :3], pose[:, 3], where, size=size, depth=depth)
    return builder.scene(cut_out=any_alpha(builder.paths))


def _depth(entry: dict[str, Any], file: Path, where: str) -> DepthPng | None:
    if "depth" not in entry:
        return None
    step = read_number(entry, "depth_step", file, where)
    if not step > 0:
        raise DataError(file, f"{where}: depth_step must be positive; got {step:g}")
    return DepthPng(path_inside(file.parent, read_string(entry, "depth", file, where), file), step)


def _size(entry: dict[str, Any], file: Path, where: str) -> tuple[int, int]:
    height, width = (read_number(entry, key, file, where) for key in ("height", "width"))
    if height != round(height) or width != round(width):
        raise DataError(file, f"{where}: height and width must be whole numbers of pixels")
    return int(height), int(width)


def _pose(entry: dict[str, Any], file: Path, where: str) -> np.ndarray:
    """World-to-camera, (3, 4)."""
    if "cam_from_world" not in entry and "R" in entry:
        R, t = read_array(entry, "R", (3, 3), file, where), read_array(entry, "t", (3,), file, where)
        return np.column_stack((R, t))
    pose = read_array(entry, "cam_from_world", (4, 4), file, where)
    check_last_row(pose, file, f"{where}: cam_from_world")
    return pose[:3]


def camera_entry(camera: CameraTensors) -> dict[str, Any]:
    """The JSON object of one camera, leading shape (); nothing is rounded."""
    K, E = (part.double().tolist() for part in camera[:2])
    return {"width": int(camera.width), "height": int(camera.height), "K": K, "cam_from_world": E}


def encode_cameras(entries: Sequence[Mapping[str, Any]]) -> bytes:
    """The content of a file of cameras with integer pixel centres."""
    values = {"format": FORMAT, "version": VERSION, "pixel_center": "integer", "cameras": entries}
    return json.dumps(values, indent=1, allow_nan=False).encode()
