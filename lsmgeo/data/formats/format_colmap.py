"""COLMAP reconstructions, text or binary: cameras, poses, and sparse points with their observations.

Binary files are little-endian; every count is compared with the remaining bytes before it is used.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from lsmgeo.cameras import from_colmap
from lsmgeo.data.formats.lenses import Lens
from lsmgeo.data.formats.scene_assembly import MAX_PARAMETER, MAX_SIDE, assemble, camera_errors_as_data_errors
from lsmgeo.data.posed_images import Observations, PosedImages, SparsePoints
from lsmgeo.data.read_files import (
    MAX_TEXT_BYTES,
    file_reader,
    parse_floats,
    parse_ints,
    path_inside,
    read_bytes,
    read_text,
)
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["is_colmap", "read_colmap"]

MAX_CAMERA_BYTES = 1 << 24
MAX_MODEL_BYTES = 1 << 31

# Binary id -> (name, number of parameters), by COLMAP's numbers; None for models that OpenCV does not have.
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", None),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", None),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", None),
    12: ("SIMPLE_DIVISION", None),
    13: ("DIVISION", None),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", None),
    17: ("EQUIRECTANGULAR", None),
}
POINT = np.dtype([("id", "<i8"), ("position", "<f8", 3), ("colour", "u1", 3)])
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
TRACK_ELEMENT = np.dtype([("image", "<u4"), ("observation", "<u4")])


def model_folder(path: Path) -> tuple[Path, str] | None:
    """The folder of a COLMAP model in or below ``path``, and its form ("bin" or "txt"); None if there is none."""
    for folder in (path, path / "sparse", path / "sparse" / "0", path / "0"):
        for form in ("bin", "txt"):
            if (folder / f"cameras.{form}").is_file() and (folder / f"images.{form}").is_file():
                return folder, form
    return None


def is_colmap(path: Path) -> bool:
    """Whether a folder holds a COLMAP model."""
    return path.is_dir() and model_folder(path) is not None


@file_reader
def read_colmap(path: str | Path, images: str | Path | None = None) -> PosedImages:
    """Read a COLMAP model; distortion is removed.

    The model (``cameras``, ``images`` and, if it exists, ``points3D``, binary or text) is searched in the folder, in
    ``sparse``, ``sparse/0`` and ``0``; the images in ``images`` in it or in up to three folders above, else in the
    folder itself. Images are ordered by name. Files of rigs and frames repeat the poses of the images and are not read.

    Convention:
        COLMAP's poses are world-to-camera with OpenCV axes, as in lsmgeo. Its pixel centres are half-integer: 0.5 is
        subtracted from principal points and observations. Camera models of OpenCV become a `Lens`, and observations
        are undistorted; those outside of the undistorted image are left out.

    Args:
        path: the scene's folder or the model's.
        images: folder of the images, if it is elsewhere.

    Returns:
        The images with cameras and sparse points.

    Raises:
        DataError: no model, a damaged or inconsistent one, a camera model that OpenCV does not have, or a name that
            leads outside the folder of images.
    """
    path = Path(path)
    found = model_folder(path)
    if found is None:
        raise DataError(path, "holds no COLMAP model (cameras and images, .bin or .txt)")
    folder, form = found
    model = _read_model(folder, form)
    file = folder / f"images.{form}"
    if not model.images:
        raise DataError(file, "holds no image")
    entries = sorted(model.images, key=lambda entry: entry.name)
    root = Path(images) if images is not None else _image_folder(path, folder)

    lenses = {camera_id: camera.lens() for camera_id, camera in model.cameras.items()}
    paths, used = [], []
    for entry in entries:
        camera = model.cameras.get(entry.camera_id)
        if camera is None:
            raise DataError(file, f"{entry.name[:80]!r} refers to camera {entry.camera_id}, which does not exist")
        paths.append(path_inside(root, entry.name, file))
        used.append(camera)
    with camera_errors_as_data_errors(file):
        cameras = from_colmap(
            torch.from_numpy(np.stack([camera.intrinsics() for camera in used])),
            torch.from_numpy(np.stack([entry.quaternion for entry in entries])),
            torch.from_numpy(np.stack([entry.translation for entry in entries])),
            torch.tensor([camera.height for camera in used]),
            torch.tensor([camera.width for camera in used]),
        )
        points = _sparse_points(model, entries, lenses, file)
    return assemble(
        [entry.name for entry in entries],
        paths,
        cameras,
        "colmap",
        file=file,
        lenses=[lenses[entry.camera_id] for entry in entries],
        points=points,
    )


def _image_folder(path: Path, model: Path) -> Path:
    # The third parent is for nerfstudio, whose models are in colmap/sparse/0.
    for folder in (path, model, *model.absolute().parents[:3]):
        if (folder / "images").is_dir():
            return folder / "images"
    return path


def _sparse_points(
    model: ColmapModel, entries: list[ColmapImage], lenses: dict[int, Lens | None], file: Path
) -> SparsePoints | None:
    if model.points is None:
        return None
    ranks = np.argsort(model.points["id"], kind="stable")
    ordered = model.points["id"][ranks]
    observations = []
    for entry in entries:
        known = entry.point_ids != -1
        slots = np.searchsorted(ordered, entry.point_ids[known])
        if len(ordered) == 0 and known.any():
            raise DataError(file, f"{entry.name!r} observes points, but the model holds none")
        slots = np.minimum(slots, max(len(ordered) - 1, 0))
        if (ordered[slots] != entry.point_ids[known]).any():
            raise DataError(file, f"{entry.name!r} observes a point that does not exist")
        pixels = entry.pixels[known] - 0.5
        lens = lenses[entry.camera_id]
        if lens is not None:
            pixels = lens.straighten_pixels(pixels)
        shown = np.isfinite(pixels).all(1)
        observations.append(Observations(ranks[slots][shown], pixels[shown]))
    return SparsePoints(model.points["position"].copy(), model.points["colour"].copy(), tuple(observations))


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of COLMAP: f cx cy or fx fy cx cy with half-integer pixel centres, then distortion."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Along x and y."""
        return self.parameters[0], self.parameters[self._fy_index]

    @property
    def _fy_index(self) -> int:
        """The index of fy: 0 if x and y share one focal length, else 1."""
        return 0 if self.model.startswith(("SIMPLE_", "RADIAL")) else 1

    def intrinsics(self) -> np.ndarray:
        """K (3, 3) with half-integer pixel centres."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.parameters[self._fy_index + 1 : self._fy_index + 3]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)

    def lens(self) -> Lens | None:
        """The camera with distortion as in OpenCV; None without distortion."""
        coefficients = self.parameters[self._fy_index + 3 :]
        fisheye = self.model.endswith("FISHEYE")
        if not fisheye and not any(coefficients):
            return None
        K = self.intrinsics()
        K[:2, 2] -= 0.5
        # COLMAP's order is that of OpenCV, and the parameters that shorter models omit are zero.
        whole = coefficients + (0.0,) * (4 - len(coefficients))
        return Lens("fisheye" if fisheye else "perspective", K, whole, self.height, self.width)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """An image of COLMAP; a point id of -1 means no point."""

    image_id: int
    camera_id: int
    name: str
    quaternion: np.ndarray  # (4,), w x y z, world-to-camera
    translation: np.ndarray  # (3,)
    pixels: np.ndarray  # (M, 2), half-integer centres
    point_ids: np.ndarray  # (M,) int64


class ColmapModel(NamedTuple):
    """The three files of a model; points are an array of `POINT`, each id once, or None."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: np.ndarray | None


def _read_model(folder: Path, form: str) -> ColmapModel:
    """Read the three files of a form, with the checks that both forms share."""
    read_cameras, read_images, read_points = READERS[form]
    path = folder / f"cameras.{form}"
    cameras: dict[int, ColmapCamera] = {}
    for camera_id, camera in read_cameras(path):
        if camera_id in cameras:
            raise DataError(path, f"uses camera id {camera_id} twice")
        if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
            raise DataError(path, f"camera {camera_id} has an invalid size {camera.width} x {camera.height}")
        if not (np.abs(camera.parameters) < MAX_PARAMETER).all() or min(camera.focal_lengths) <= 0:
            raise DataError(path, f"camera {camera_id}: parameters must be finite and focal lengths positive")
        cameras[camera_id] = camera
    path = folder / f"images.{form}"
    images = list(read_images(path))
    if len({image.image_id for image in images}) != len(images):
        raise DataError(path, "uses the id of an image twice")
    for image in images:
        norm = float(np.linalg.norm(image.quaternion))
        if not abs(norm - 1) < 1e-2:
            raise DataError(path, f"{image.name[:80]!r}: the quaternion's norm is {norm:g}; expected 1")
        if not (np.abs(image.translation) < 1e12).all():
            raise DataError(path, f"{image.name[:80]!r}: the translation is not finite or beyond 1e12")
        if not np.isfinite(image.pixels).all():
            raise DataError(path, f"{image.name[:80]!r}: an observation is not finite")
    path = folder / f"points3D.{form}"
    if not path.is_file():
        return ColmapModel(cameras, images, None)
    points = np.fromiter(read_points(path), POINT)
    if len(np.unique(points["id"])) != len(points):
        raise DataError(path, "uses the id of a point twice")
    if not (np.abs(points["position"]) < 1e12).all():
        raise DataError(path, "a point is not finite or beyond 1e12")
    return ColmapModel(cameras, images, points)


def _find_model(model: int | str, path: Path) -> tuple[str, int]:
    """The name and the number of parameters of a camera model, given by its id or its name."""
    for number, (name, parameters) in CAMERA_MODELS.items():
        if model in (number, name):
            if parameters is None:
                reason = f"camera model {name} does not exist in OpenCV; undistort first (colmap image_undistorter)"
                raise DataError(path, reason)
            return name, parameters
    known = ", ".join(name for name, parameters in CAMERA_MODELS.values() if parameters is not None)
    raise DataError(path, f"unknown camera model {str(model)[:40]!r}; expected one of {known}")


class _Cursor:
    """A position in the bytes of a file, checked against their end."""

    def __init__(self, path: Path, limit: int):
        self.path = path
        self.content = read_bytes(path, limit)
        self.offset = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values in a layout of `struct`."""
        size = struct.calcsize(layout)
        if self.offset + size > len(self.content):
            raise DataError(self.path, f"ends inside a record at byte {self.offset}")
        self.offset += size
        return struct.unpack_from(layout, self.content, self.offset - size)

    def count(self, least: int) -> int:
        """A count of records of at least ``least`` bytes each; an error if the file is too short for them."""
        (number,) = self.take("<Q")
        if number * least > len(self.content) - self.offset:
            raise DataError(self.path, f"announces {number} records at byte {self.offset - 8}, more than it can hold")
        return int(number)

    def array(self, dtype: np.dtype) -> np.ndarray:
        """Items after their count."""
        values = np.frombuffer(self.content, dtype, self.count(dtype.itemsize), self.offset)
        self.offset += values.nbytes
        return values

    def text(self) -> str:
        """A zero-terminated UTF-8 name."""
        end = self.content.find(b"\0", self.offset, self.offset + 513)
        if end < 0:
            raise DataError(self.path, f"holds an unterminated name at byte {self.offset}")
        try:
            name = self.content[self.offset : end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(self.path, f"holds a name that is not text at byte {self.offset}") from error
        self.offset = end + 1
        return name

    def records(self, least: int) -> Iterator[int]:
        """Count the records that the file announces; bytes after the last one are an error."""
        yield from range(self.count(least))
        if self.offset != len(self.content):
            raise DataError(self.path, f"holds {len(self.content) - self.offset} bytes after its last record")


def _binary_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    cursor = _Cursor(path, MAX_CAMERA_BYTES)
    for _ in cursor.records(24 + 24):
        camera_id, model, width, height = cursor.take("<IiQQ")
        name, number = _find_model(model, path)
        yield camera_id, ColmapCamera(name, width, height, cursor.take(f"<{number}d"))


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    cursor = _Cursor(path, MAX_MODEL_BYTES)
    for _ in cursor.records(64 + 1 + 8):
        image_id, *pose, camera_id = cursor.take("<I7dI")
        name, seen = cursor.text(), cursor.array(OBSERVATION)
        yield ColmapImage(
            image_id, camera_id, name, np.array(pose[:4]), np.array(pose[4:]), seen["pixel"], seen["point"]
        )


def _binary_points(path: Path) -> Iterator[tuple[int, tuple[float, ...], tuple[int, ...]]]:
    cursor = _Cursor(path, MAX_MODEL_BYTES)
    for _ in cursor.records(43 + 8):
        point_id, *values, _ = cursor.take("<q3d3Bd")
        # The track repeats the observations of the images; it is skipped, here and in text files.
        cursor.array(TRACK_ELEMENT)
        yield point_id, tuple(values[:3]), tuple(values[3:])


def _numbered_lines(path: Path, limit: int) -> list[tuple[str, str]]:
    lines = read_text(path, limit).split("\n")
    return [(f"line {number}", line) for number, line in enumerate(lines, 1) if not line.lstrip().startswith("#")]


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for where, line in _numbered_lines(path, MAX_CAMERA_BYTES):
        tokens = line.split()
        if not tokens:
            continue
        if len(tokens) < 4:
            raise DataError(path, f"{where}: expected id, model, width, height and parameters")
        name, number = _find_model(tokens[1], path)
        camera_id, width, height = parse_ints([tokens[0], *tokens[2:4]], path, where)
        if len(tokens) - 4 != number:
            raise DataError(path, f"{where}: {name} has {number} parameters; got {len(tokens) - 4}")
        yield camera_id, ColmapCamera(name, width, height, tuple(parse_floats(tokens[4:], path, where)))


def _text_images(path: Path) -> Iterator[ColmapImage]:
    lines = _numbered_lines(path, MAX_TEXT_BYTES)
    # An image takes two lines, the second empty if it observes nothing: only blank lines before the first record and
    # after the last may be dropped.
    while lines and not lines[0][1].strip():
        lines.pop(0)
    while lines and not lines[-1][1].strip():
        lines.pop()
    if len(lines) % 2:
        lines.append((lines[-1][0], ""))
    for (where, line), (where_points, points_line) in zip(lines[0::2], lines[1::2], strict=True):
        tokens, seen = line.split(maxsplit=9), points_line.split()
        if len(tokens) != 10:
            raise DataError(path, f"{where}: expected id, quaternion, translation, camera id and name")
        if len(seen) % 3:
            raise DataError(path, f"{where_points}: observations must be x, y, point id")
        image_id, camera_id = parse_ints([tokens[0], tokens[8]], path, where)
        pose = np.array(parse_floats(tokens[1:8], path, where))
        pixels = np.array(parse_floats([*seen[0::3], *seen[1::3]], path, where_points)).reshape(2, -1).T
        points = np.array(parse_ints(seen[2::3], path, where_points), np.int64)
        yield ColmapImage(image_id, camera_id, tokens[9].strip(), pose[:4], pose[4:], pixels, points)


def _text_points(path: Path) -> Iterator[tuple[int, tuple[float, ...], tuple[int, ...]]]:
    for where, line in _numbered_lines(path, MAX_TEXT_BYTES):
        tokens = line.split(maxsplit=8)
        if not tokens:
            continue
        if len(tokens) < 8:
            raise DataError(path, f"{where}: expected id, position, colour and error")
        position = parse_floats(tokens[1:4], path, where)
        point_id, *colour = parse_ints([tokens[0], *tokens[4:7]], path, where)
        if not all(0 <= value <= 255 for value in colour):
            raise DataError(path, f"{where}: colours must lie in 0..255")
        yield point_id, tuple(position), tuple(colour)


READERS = {
    "bin": (_binary_cameras, _binary_images, _binary_points),
    "txt": (_text_cameras, _text_images, _text_points),
}
