"""What a COLMAP model holds, as its files state it, and the checks that its text and binary forms share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.data.lenses import Lens
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = [
    "CAMERA_MODELS",
    "MAX_CAMERA_BYTES",
    "MAX_MODEL_BYTES",
    "ColmapCamera",
    "ColmapImage",
    "ColmapModel",
    "check_model",
    "check_points",
    "refuse_model",
]

MAX_CAMERA_BYTES = 1 << 24
MAX_MODEL_BYTES = 1 << 31

# Binary id -> (name, number of parameters), as COLMAP numbers them.
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
}
# Models that OpenCV does not have, named only to be refused clearly.
OTHER_MODELS = {
    7: "FOV",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    16: "EUCM",
    17: "EQUIRECTANGULAR",
}


@dataclass(frozen=True)
class ColmapCamera:
    """One camera as COLMAP states it: f cx cy or fx fy cx cy with half-integer pixel centres, then its distortion."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Along x and y."""
        return self.parameters[0], self.parameters[self._shared]

    @property
    def _shared(self) -> int:
        """1 where x and y have focal lengths of their own, 0 where they share one."""
        return 0 if self.model.startswith(("SIMPLE_", "RADIAL")) else 1

    def intrinsics(self) -> np.ndarray:
        """K with COLMAP's own half-integer pixel centres, (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.parameters[self._shared + 1 : self._shared + 3]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)

    def lens(self) -> Lens | None:
        """What the camera's distortion is to OpenCV; None where there is none."""
        coefficients = self.parameters[self._shared + 3 :]
        fisheye = self.model.endswith("FISHEYE")
        if not fisheye and not any(coefficients):
            return None
        K = self.intrinsics()
        K[:2, 2] -= 0.5
        # COLMAP's order is OpenCV's, and what its shorter models leave out is zero.
        whole = coefficients + (0.0,) * (4 - len(coefficients))
        return Lens("fisheye" if fisheye else "perspective", K, whole, self.height, self.width)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One photograph as COLMAP states it; a point id of -1 belongs to no point."""

    image_id: int
    camera_id: int
    name: str
    quaternion: np.ndarray  # (4,), w x y z, world-to-camera
    translation: np.ndarray  # (3,)
    pixels: np.ndarray  # (M, 2), half-integer centres
    point_ids: np.ndarray  # (M,) int64


class ColmapModel(NamedTuple):
    """The three files of a model; points are (ids (N,), positions (N, 3), colours (N, 3)), or None."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: tuple[np.ndarray, np.ndarray, np.ndarray] | None


def refuse_model(model: int | str, path: Path) -> DataError:
    """The error for a camera model that cannot be straightened here."""
    name = OTHER_MODELS.get(model, model) if isinstance(model, int) else model[:40]
    if name in OTHER_MODELS.values():
        reason = f"camera model {name} is none of OpenCV's; undistort first (colmap image_undistorter)"
    else:
        known = ", ".join(known for known, _ in CAMERA_MODELS.values())
        reason = f"unknown camera model {name!r}; expected one of {known}"
    return DataError(path, reason)


def check_model(cameras: dict[int, ColmapCamera], images: list[ColmapImage], folder: Path, form: str) -> None:
    """Check the values of cameras and photographs.

    Raises:
        DataError: sizes, focal lengths, rotations or observations make no sense, or an id is used twice.
    """
    path = folder / f"cameras.{form}"
    for camera_id, camera in cameras.items():
        numbers = np.array(camera.parameters)
        if not (0 < camera.width <= 1 << 17 and 0 < camera.height <= 1 << 17):
            raise DataError(path, f"camera {camera_id} has an impossible size {camera.width} x {camera.height}")
        if not (np.abs(numbers) < 1e7).all() or min(camera.focal_lengths) <= 0:
            raise DataError(path, f"camera {camera_id}: parameters must be finite and focal lengths positive")
    path = folder / f"images.{form}"
    if len({image.image_id for image in images}) != len(images):
        raise DataError(path, "uses a photograph's id twice")
    for image in images:
        norm = float(np.linalg.norm(image.quaternion))
        if not abs(norm - 1) < 1e-2:
            raise DataError(path, f"{image.name[:80]!r}: the quaternion's norm is {norm:g}; expected 1")
        if not (np.abs(image.translation) < 1e12).all():
            raise DataError(path, f"{image.name[:80]!r}: the translation is not finite or beyond 1e12")
        if not np.isfinite(image.pixels).all():
            raise DataError(path, f"{image.name[:80]!r}: an observation is not finite")


def check_points(identifiers: np.ndarray, positions: np.ndarray, path: Path) -> None:
    """Check sparse points.

    Raises:
        DataError: an id is used twice or a position is not finite.
    """
    if len(np.unique(identifiers)) != len(identifiers):
        raise DataError(path, "uses a point's id twice")
    if not (np.abs(positions) < 1e12).all():
        raise DataError(path, "a point is not finite or beyond 1e12")
