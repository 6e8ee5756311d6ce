"""The text form of a COLMAP model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.colmap_model import (
    CAMERA_MODELS,
    MAX_CAMERA_BYTES,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    check_model,
    check_points,
    refuse_model,
)
from lsmgeo.data.files import MAX_TEXT_BYTES, parse_floats, parse_ints, read_text
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read_model"]

_MODELS = dict(CAMERA_MODELS.values())


def read_model(folder: Path) -> ColmapModel:
    """Read ``cameras.txt``, ``images.txt`` and, where it exists, ``points3D.txt``.

    Raises:
        DataError: a file is damaged, too large, or its values make no sense.
    """
    cameras = _read_cameras(folder / "cameras.txt")
    images = _read_images(folder / "images.txt")
    check_model(cameras, images, folder, "txt")
    points_file = folder / "points3D.txt"
    return ColmapModel(cameras, images, _read_points(points_file) if points_file.is_file() else None)


def _numbered_lines(path: Path, limit: int) -> list[tuple[str, str]]:
    lines = read_text(path, limit).split("\n")
    return [(f"line {number}", line) for number, line in enumerate(lines, 1) if not line.lstrip().startswith("#")]


def _read_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for where, line in _numbered_lines(path, MAX_CAMERA_BYTES):
        tokens = line.split()
        if not tokens:
            continue
        if len(tokens) < 4:
            raise DataError(path, f"{where}: expected id, model, width, height and parameters")
        if tokens[1] not in _MODELS:
            raise refuse_model(tokens[1], path)
        camera_id, width, height = parse_ints([tokens[0], *tokens[2:4]], path, where)
        if len(tokens) - 4 != _MODELS[tokens[1]]:
            raise DataError(path, f"{where}: {tokens[1]} has {_MODELS[tokens[1]]} parameters; got {len(tokens) - 4}")
        if camera_id in cameras:
            raise DataError(path, f"{where}: camera id {camera_id} is used twice")
        cameras[camera_id] = ColmapCamera(tokens[1], width, height, tuple(parse_floats(tokens[4:], path, where)))
    return cameras


def _read_images(path: Path) -> list[ColmapImage]:
    lines = _numbered_lines(path, MAX_TEXT_BYTES)
    # A photograph takes two lines, and the second is empty where it observes nothing: only blank lines before the
    # first record and after the last may be dropped.
    while lines and not lines[0][1].strip():
        lines.pop(0)
    images = []
    for start in range(0, len(lines), 2):
        where, line = lines[start]
        tokens = line.split(maxsplit=9)
        if not tokens and all(not rest.strip() for _, rest in lines[start:]):
            break
        if len(tokens) != 10:
            raise DataError(path, f"{where}: expected id, quaternion, translation, camera id and name")
        observed = lines[start + 1][1].split() if start + 1 < len(lines) else []
        where_observed = lines[start + 1][0] if start + 1 < len(lines) else where
        if len(observed) % 3:
            raise DataError(path, f"{where_observed}: observations must come as x, y, point id")
        image_id, camera_id = parse_ints([tokens[0], tokens[8]], path, where)
        pose = parse_floats(tokens[1:8], path, where)
        pixels = parse_floats([*observed[0::3], *observed[1::3]], path, where_observed)
        images.append(
            ColmapImage(
                image_id,
                camera_id,
                tokens[9].strip(),
                np.array(pose[:4]),
                np.array(pose[4:]),
                np.array(pixels).reshape(2, -1).T,
                np.array(parse_ints(observed[2::3], path, where_observed), dtype=np.int64),
            )
        )
    return images


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    identifiers, positions, colours = [], [], []
    for where, line in _numbered_lines(path, MAX_TEXT_BYTES):
        # The track repeats what the photographs' own observations say; it is not read.
        tokens = line.split(maxsplit=8)
        if not tokens:
            continue
        if len(tokens) < 8:
            raise DataError(path, f"{where}: expected id, position, colour and error")
        identifiers += parse_ints(tokens[:1], path, where)
        positions.append(parse_floats(tokens[1:4], path, where))
        colours.append(parse_ints(tokens[4:7], path, where))
        if not all(0 <= value <= 255 for value in colours[-1]):
            raise DataError(path, f"{where}: colours must lie in 0..255")
    numbers = np.array(identifiers, dtype=np.int64)
    points = np.array(positions, dtype=np.float64).reshape(-1, 3)
    check_points(numbers, points, path)
    return numbers, points, np.array(colours, dtype=np.uint8).reshape(-1, 3)
