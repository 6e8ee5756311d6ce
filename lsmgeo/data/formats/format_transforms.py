"""``transforms.json`` of NeRF and Blender, instant-ngp and nerfstudio."""

from __future__ import annotations

import math
from collections import ChainMap
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from lsmgeo._checks import describe
from lsmgeo.cameras import from_opengl
from lsmgeo.data.formats.depth_files import DepthFile, DepthPng
from lsmgeo.data.formats.lenses import Lens
from lsmgeo.data.formats.scene_assembly import (
    MAX_PARAMETER,
    MAX_SIDE,
    any_alpha,
    assemble,
    camera_errors_as_data_errors,
    check_image_size,
    check_last_row,
    check_rotation,
)
from lsmgeo.data.images import SUFFIXES, image_size
from lsmgeo.data.json_files import read_array, read_json, read_number, read_string, sniff_json
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader, one_file, path_inside, plain_files
from lsmgeo.errors import DataError

__all__ = ["is_transforms", "read_transforms"]

# The first of these patterns with a match.
NAMES = ("transforms.json", "transforms_*.json")
MOST_FRAMES = 100_000
# nerfstudio's depth is in millimetres by default.
DEPTH_STEP = 1e-3

# Camera models of nerfstudio, and the coefficients of each kind.
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FISHEYE")
COEFFICIENTS = {"perspective": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
WITHOUT_MEANING = {"perspective": ("k4", "k5", "k6"), "fisheye": ("p1", "p2")}
# Other cameras and axes of instant-ngp.
REFUSED = ("ftheta_p0", "latlong", "equirectangular", "from_na")


def is_transforms(path: Path) -> bool:
    """Whether a folder has such files, or a JSON file has frames."""
    if path.is_dir():
        return bool(plain_files(path, *NAMES))
    return path.suffix.lower() == ".json" and isinstance(sniff_json(path).get("frames"), list)


@file_reader
def read_transforms(path: str | Path) -> PosedImages:
    """Read a ``transforms.json`` of NeRF's Blender scenes, of instant-ngp or of nerfstudio.

    A frame's ``transform_matrix`` is camera-to-world, 4 x 4 or its first three rows. The camera is given by ``fl_x``,
    ``fl_y``, ``cx``, ``cy``, ``w``, ``h`` or by ``camera_angle_x`` (radians, across the image), its distortion by
    ``k1``, ``k2``, ``p1``, ``p2``, ``k3`` or, for a fisheye, by ``k1`` to ``k4``; for all frames, or in a frame.
    (Format: Mildenhall et al., "NeRF", ECCV 2020, and the documentation of instant-ngp and nerfstudio.)

    Convention:
        OpenGL axes (x right, y up, z backwards) become OpenCV's, and camera-to-world becomes world-to-camera. Pixel
        centres are half-integer: 0.5 is subtracted from principal points. The size and the principal point default to
        those of the image and its centre. A rotation with a scale is refused. ``depth_file_path`` is a 16-bit PNG of
        camera z, in millimetres or ``depth_unit_scale_factor``; if it has the image's aspect ratio but another
        resolution, its nearest pixels are used. Masks are not read.

    Args:
        path: the file, or a folder with ``transforms.json`` or with one ``transforms_*.json``.

    Returns:
        The images with their cameras, cut out if any of them has alpha, undistorted if they have distortion; no sparse
        points.

    Raises:
        DataError: a file is missing, damaged or too large, names a file outside its folder, or states a camera that
            is invalid or of another size than its image; or the folder has several files.
    """
    file = one_file(Path(path), *NAMES)
    values = read_json(file)
    frames = values.get("frames")
    if not isinstance(frames, list) or not 1 <= len(frames) <= MOST_FRAMES:
        raise DataError(file, f"frames must be a list of 1 to {MOST_FRAMES} frames; got {describe(frames)}")

    names, paths, sizes, intrinsics, poses = [], [], [], [], []
    lenses: list[Lens | None] = []
    depths: list[DepthFile | None] = []
    shared: dict[tuple[Any, ...], Lens] = {}
    for index, frame in enumerate(frames):
        where = f"frame {index}"
        if not isinstance(frame, dict):
            raise DataError(file, f"{where}: expected an object; got {describe(frame)}")
        names.append(_read_name(frame, "file_path", file, where))
        paths.append(_image(file, names[-1]))
        size = image_size(paths[-1])
        stated = _FrameCamera(file, where, values, frame)
        check_image_size(stated.size(size), size, paths[-1], file, where)
        sizes.append(size)
        intrinsics.append(stated.intrinsics(size))
        poses.append(_pose(frame, file, where))
        lens = stated.lens(intrinsics[-1], size)
        # Frames of one camera share one lens, whose maps are computed once.
        key = None if lens is None else (lens.kind, lens.intrinsics.tobytes(), lens.coefficients, size)
        lenses.append(None if lens is None or key is None else shared.setdefault(key, lens))
        depths.append(stated.depth())
    height, width = torch.tensor(sizes).unbind(-1)
    with camera_errors_as_data_errors(file):
        cameras = from_opengl(torch.from_numpy(np.stack(intrinsics)), torch.from_numpy(np.stack(poses)), height, width)
    cut_out = any_alpha(paths)
    return assemble(names, paths, cameras, "transforms", file=file, lenses=lenses, depths=depths, cut_out=cut_out)


def _read_name(frame: dict[str, Any], key: str, file: Path, where: str) -> str:
    # Files from Windows have backslashes between folders.
    return read_string(frame, key, file, where).replace("\\", "/")


def _image(file: Path, name: str) -> Path:
    """The image of a frame, whose name may lack its suffix."""
    path = path_inside(file.parent, name, file)
    if path.is_file():
        return path
    for suffix in (*SUFFIXES, *(suffix.upper() for suffix in SUFFIXES)):
        longer = path_inside(file.parent, name + suffix, file)
        if longer.is_file():
            return longer
    raise DataError(path, "no such image, also not with .png, .jpg or .jpeg added")


def _pose(frame: dict[str, Any], file: Path, where: str) -> np.ndarray:
    rows = frame.get("transform_matrix")
    short = isinstance(rows, list) and len(rows) == 3
    pose = np.eye(4)
    pose[: 3 if short else 4] = read_array(frame, "transform_matrix", (3 if short else 4, 4), file, where)
    check_last_row(pose, file, f"{where}: transform_matrix")
    check_rotation(pose[:3, :3], file, where)
    return pose


class _FrameCamera:
    """The camera of one frame: its own values, else those for all frames."""

    def __init__(self, file: Path, where: str, values: dict[str, Any], frame: dict[str, Any]):
        self.file, self.where, self.frame, self.all = file, where, frame, ChainMap(frame, values)
        for key in REFUSED:
            if self.all.get(key, False) is not False:
                raise DataError(file, f"{where}: {key} is of a camera that is neither a pinhole nor a model of OpenCV")

    def number(self, key: str, default: float | None = None, beyond: float = MAX_PARAMETER) -> float:
        """A number, or the default if there is none."""
        if default is not None and key not in self.all:
            return default
        return read_number(self.all, key, self.file, self.where, beyond=beyond)

    def size(self, image: tuple[int, int]) -> tuple[int, int]:
        """(height, width), by default that of the image."""
        sides = []
        for key, side in zip(("h", "w"), image, strict=True):
            stated = self.number(key, side)
            if not 1 <= stated <= MAX_SIDE or stated != round(stated):
                raise DataError(self.file, f"{self.where}: {key} must be a whole number of pixels; got {stated:g}")
            sides.append(int(stated))
        return sides[0], sides[1]

    def intrinsics(self, size: tuple[int, int]) -> np.ndarray:
        """K with half-integer pixel centres, (3, 3)."""
        height, width = size
        fx, fy = self._focal("x", width), self._focal("y", height)
        if fx is None and fy is None:
            raise DataError(self.file, f"{self.where}: no focal length (fl_x or camera_angle_x)")
        fx, fy = fx or fy, fy or fx
        cx, cy = self.number("cx", width / 2), self.number("cy", height / 2)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)

    def _focal(self, axis: str, side: int) -> float | None:
        length, across = f"fl_{axis}", f"camera_angle_{axis}"
        # A frame's own focal length takes precedence over that for all frames, under either key.
        scope = self.frame if length in self.frame or across in self.frame else self.all
        if length in scope:
            focal = read_number(scope, length, self.file, self.where, beyond=MAX_PARAMETER)
        elif across in scope:
            angle = read_number(scope, across, self.file, self.where)
            if not 1e-6 < angle < math.pi:
                reason = f"{across} must lie between 0 and pi (radians); got {angle:g}"
                raise DataError(self.file, f"{self.where}: {reason}")
            focal = 0.5 * side / math.tan(0.5 * angle)
        else:
            return None
        if not focal > 0:
            raise DataError(self.file, f"{self.where}: focal lengths must be positive; got {focal:g}")
        return focal

    def lens(self, intrinsics: np.ndarray, size: tuple[int, int]) -> Lens | None:
        """The lens, None without distortion."""
        kind = self._kind()
        coefficients = tuple(self.number(key, 0.0) for key in COEFFICIENTS[kind])
        for key in WITHOUT_MEANING[kind]:
            if self.number(key, 0.0):
                raise DataError(self.file, f"{self.where}: {key} has no defined meaning for a {kind} camera")
        if kind == "perspective" and not any(coefficients):
            return None
        K = intrinsics.copy()
        K[:2, 2] -= 0.5
        return Lens(kind, K, coefficients, *size)

    def _kind(self) -> Literal["perspective", "fisheye"]:
        model, is_fisheye = self.all.get("camera_model"), self.all.get("is_fisheye") is True
        if model is None:
            return "fisheye" if is_fisheye else "perspective"
        if model in PERSPECTIVE and not is_fisheye:
            return "perspective"
        if model in FISHEYE:
            return "fisheye"
        raise DataError(self.file, f"{self.where}: camera_model {describe(model)} cannot be undistorted")

    def depth(self) -> DepthFile | None:
        """The depth of the frame."""
        if "depth_file_path" not in self.frame:
            return None
        name = _read_name(self.frame, "depth_file_path", self.file, self.where)
        step = self.number("depth_unit_scale_factor", DEPTH_STEP)
        if not step > 0:
            raise DataError(self.file, f"{self.where}: depth_unit_scale_factor must be positive; got {step:g}")
        # Exports of phones have depth of lower resolution than their images.
        return DepthPng(path_inside(self.file.parent, name, self.file), step, any_size=True)
