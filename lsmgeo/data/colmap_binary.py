"""The binary form of a COLMAP model. Little-endian; every count is compared with the bytes left before it is used."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo.data.colmap_model import (
    CAMERA_MODELS,
    MAX_CAMERA_BYTES,
    MAX_MODEL_BYTES,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    check_model,
    check_points,
    refuse_model,
)
from lsmgeo.data.files import read_bytes
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read_model"]

_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_TRACK_ELEMENT = np.dtype([("image", "<u4"), ("observation", "<u4")])


class _Cursor:
    """A position in a file's bytes that refuses to run past their end."""

    def __init__(self, path: Path, limit: int):
        self.path = path
        self.content = read_bytes(path, limit)
        self.offset = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The next values in the given layout."""
        if self.offset + layout.size > len(self.content):
            raise DataError(self.path, f"ends inside a record at byte {self.offset}")
        values = layout.unpack_from(self.content, self.offset)
        self.offset += layout.size
        return values

    def count(self, least: int) -> int:
        """A count of records of at least ``least`` bytes each, refused where the file is too short for them."""
        (number,) = self.take(struct.Struct("<Q"))
        if number * least > len(self.content) - self.offset:
            raise DataError(self.path, f"announces {number} records at byte {self.offset - 8}, more than it can hold")
        return int(number)

    def array(self, dtype: np.dtype, number: int) -> np.ndarray:
        """The next ``number`` items; the caller has compared the number with the size."""
        values = np.frombuffer(self.content, dtype, number, self.offset)
        self.offset += number * dtype.itemsize
        return values

    def text(self) -> str:
        """A zero-terminated UTF-8 name."""
        end = self.content.find(b"\0", self.offset, self.offset + 513)
        if end < 0:
            raise DataError(self.path, f"holds a name without end at byte {self.offset}")
        try:
            name = self.content[self.offset : end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(self.path, f"holds a name that is not text at byte {self.offset}") from error
        self.offset = end + 1
        return name

    def finish(self) -> None:
        """Refuse trailing bytes."""
        if self.offset != len(self.content):
            raise DataError(self.path, f"holds {len(self.content) - self.offset} bytes after its last record")


def read_model(folder: Path) -> ColmapModel:
    """Read ``cameras.bin``, ``images.bin`` and, where it exists, ``points3D.bin``.

    Raises:
        DataError: a file is damaged, too large, or its values make no sense.
    """
    cameras = _read_cameras(folder / "cameras.bin")
    images = _read_images(folder / "images.bin")
    check_model(cameras, images, folder, "bin")
    points_file = folder / "points3D.bin"
    return ColmapModel(cameras, images, _read_points(points_file) if points_file.is_file() else None)


def _read_cameras(path: Path) -> dict[int, ColmapCamera]:
    cursor = _Cursor(path, MAX_CAMERA_BYTES)
    cameras: dict[int, ColmapCamera] = {}
    head = struct.Struct("<IiQQ")
    for _ in range(cursor.count(head.size + 24)):
        camera_id, model, width, height = cursor.take(head)
        if model not in CAMERA_MODELS:
            raise refuse_model(model, path)
        if camera_id in cameras:
            raise DataError(path, f"uses camera id {camera_id} twice")
        name, number = CAMERA_MODELS[model]
        parameters = cursor.take(struct.Struct(f"<{number}d"))
        cameras[camera_id] = ColmapCamera(name, width, height, parameters)
    cursor.finish()
    return cameras


def _read_images(path: Path) -> list[ColmapImage]:
    cursor = _Cursor(path, MAX_MODEL_BYTES)
    images = []
    head = struct.Struct("<I7dI")
    for _ in range(cursor.count(head.size + 1 + 8)):
        image_id, *pose, camera_id = cursor.take(head)
        name = cursor.text()
        observed = cursor.array(_OBSERVATION, cursor.count(_OBSERVATION.itemsize))
        images.append(
            ColmapImage(
                image_id,
                camera_id,
                name,
                np.array(pose[:4]),
                np.array(pose[4:]),
                observed["pixel"].astype(np.float64),
                observed["point"].astype(np.int64),
            )
        )
    cursor.finish()
    return images


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cursor = _Cursor(path, MAX_MODEL_BYTES)
    head = struct.Struct("<q3d3Bd")
    number = cursor.count(head.size + 8)
    identifiers = np.empty(number, np.int64)
    positions = np.empty((number, 3))
    colours = np.empty((number, 3), np.uint8)
    for row in range(number):
        identifiers[row], *values, _ = cursor.take(head)
        positions[row], colours[row] = values[:3], values[3:]
        # The track repeats what the photographs' own observations say; it is stepped over.
        cursor.array(_TRACK_ELEMENT, cursor.count(_TRACK_ELEMENT.itemsize))
    cursor.finish()
    check_points(identifiers, positions, path)
    return identifiers, positions, colours
