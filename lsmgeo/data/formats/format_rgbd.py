"""RGB-D recordings: images with 16-bit depth, one K, and poses in one table or in a file for each frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.data.formats.depth_files import DepthPng
from lsmgeo.data.formats.scene_assembly import MAX_PARAMETER, SceneBuilder, check_intrinsics, check_last_row
from lsmgeo.data.read_files import file_reader, parse_floats, path_inside, read_text
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from lsmgeo.data.posed_images import PosedImages

__all__ = ["is_rgbd", "is_seven_scenes", "read_rgbd", "read_seven_scenes"]

MAX_TABLE_BYTES = 1 << 26
MAX_MATRIX_BYTES = 1 << 14
# In metres or millimetres, farther than any camera of a room or a city.
FARTHEST = 1e9
MILLIMETRE = 0.001
TABLES = ("K.txt", "poses.txt", "frame_index.txt")
POSES = "frame-*.pose.txt"
# A sequence has 500 or 1,000 frames; this is an hour at 30 frames a second.
MAX_FRAMES = 108_000
MAX_POSE_BYTES = 4096
# Of the depth camera, as the authors state.
KINECT = (585.0, 585.0, 320.0, 240.0)
# No depth: 65535 in the set itself, 0 from other writers of its form.
NO_DEPTH = (0, 65535)


def is_rgbd(path: Path) -> bool:
    """Whether `read_rgbd` can read a folder or a ``poses.txt``."""
    if path.is_file():
        return path.name == "poses.txt" and is_rgbd(path.parent)
    return all((path / name).is_file() for name in TABLES)


@file_reader
def read_rgbd(path: str | Path) -> PosedImages:
    """Read an RGB-D folder with one table of poses, the form of HoloLens recordings.

    ``K.txt`` contains K (3 x 3), ``poses.txt`` 16 numbers a line, the 4 x 4 pose of one frame row by row,
    ``frame_index.txt`` the name of that frame on the same line; ``images/`` and ``depth/`` the files of these names.
    (The form of HoloLens sets in DeepVideoMVS: Duzceker et al., "DeepVideoMVS: Multi-view stereo on video with
    recurrent spatio-temporal fusion", CVPR 2021.)

    Convention:
        The source has camera-to-world poses, OpenCV axes, integer pixel centres, no distortion, and depth in
        millimetres of camera z, 0 for no depth. The poses are inverted, and depth is returned in metres.

    Frames are matched by name. Frames without an image are left out, and so are frames whose pose is not finite (the
    tracker was lost). A frame without a depth file has no depth.

    Args:
        path: the folder, or its ``poses.txt``.

    Returns:
        The images with cameras and depth; no sparse points.

    Raises:
        DataError: a file is missing, damaged or too large, or names a file outside the folder; or no frame is left.
    """
    path = Path(path)
    folder = path.parent if path.is_file() else path
    K = _read_intrinsics(folder / "K.txt")
    index, table = folder / "frame_index.txt", folder / "poses.txt"
    names = [line.strip() for line in read_text(index, MAX_TABLE_BYTES).splitlines() if line.strip()]
    rows = [line for line in read_text(table, MAX_TABLE_BYTES).splitlines() if line.strip()]
    if len(names) != len(rows):
        raise DataError(table, f"holds {len(rows)} poses; frame_index.txt names {len(names)} frames")
    if len(set(names)) != len(names):
        raise DataError(index, "uses the name of a frame twice")
    frames = (
        (
            name,
            path_inside(folder / "images", name, index),
            _parse_pose(row, table, f"line {number}"),
            path_inside(folder / "depth", str(Path(name).with_suffix(".png")), index),
        )
        for number, (name, row) in enumerate(zip(names, rows, strict=True), 1)
    )
    return _scene(frames, K, (0,), table, "rgbd")


def _parse_pose(text: str, path: Path, where: str) -> np.ndarray | None:
    """A 4 x 4 pose from 16 numbers; None if one of them is not finite."""
    tokens = text.split(maxsplit=16)
    if len(tokens) != 16:
        raise DataError(path, f"{where}: expected the 16 numbers of a pose")
    pose = np.array(parse_floats(tokens, path, where, finite=False)).reshape(4, 4)
    if not np.isfinite(pose).all():
        return None
    check_last_row(pose, path, f"{where}: a pose")
    if np.abs(pose).max() > FARTHEST:
        raise DataError(path, f"{where}: a pose holds a number beyond {FARTHEST:g}")
    return pose


def _scene(
    frames: Iterable[tuple[str, Path, np.ndarray | None, Path]],
    intrinsics: np.ndarray,
    no_depth: tuple[int, ...],
    file: Path,
    source: str,
) -> PosedImages:
    """The scene of frames (name, image, camera-to-world pose, depth); those without image or pose are left out."""
    builder = SceneBuilder(source, file)
    for name, image, pose, depth in frames:
        if pose is not None and image.is_file():
            R = pose[:3, :3].T
            # -R C, not the inverse: rotations are rounded in these files, and the camera centre should be exact.
            t = -(R * pose[:3, 3]).sum(-1)
            stored = DepthPng(depth, MILLIMETRE, no_depth) if depth.is_file() else None
            builder.add(name, image, intrinsics, R, t, name, depth=stored)
    if not builder.names:
        raise DataError(file, "has no usable frame: each has no image or a pose that is not finite")
    return builder.scene()


def _read_intrinsics(file: Path) -> np.ndarray:
    tokens = read_text(file, MAX_MATRIX_BYTES).split()
    if len(tokens) != 9:
        raise DataError(file, f"expected the 9 numbers of K; got {len(tokens)} items")
    K = np.array(parse_floats(tokens, file, "K")).reshape(3, 3)
    check_intrinsics(K, file, "line 1 to 3")
    return K


def is_seven_scenes(path: Path) -> bool:
    """Whether `read_seven_scenes` can read a folder."""
    return path.is_dir() and next(path.glob(POSES), None) is not None


@file_reader
def read_seven_scenes(path: str | Path, *, intrinsics: tuple[float, float, float, float] = KINECT) -> PosedImages:
    """Read one sequence of 7-Scenes, or of a set of its form.

    For each frame ``frame-000000.color.png``, ``.depth.png`` (16-bit millimetres, 0 and 65535 for no depth) and
    ``.pose.txt`` (4 x 4). (Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D
    images", CVPR 2013.)

    Convention:
        The source has camera-to-world poses and OpenCV axes. The poses are inverted, and depth is returned in metres.

    In the set itself colour and depth are *not registered*: they are images of two cameras side by side, and only K of
    the depth camera is published. It is customary to use its K and poses for both; the depth at a pixel of the colour
    image is then off by some pixels, which shows near edges. The published principal point is the centre of the image,
    so half a pixel in it has no meaning.

    Frames without a colour image, or with a pose that is not finite (tracking lost), are left out. A frame without a
    depth image has no depth.

    Args:
        path: the folder of one sequence, such as ``chess/seq-01``.
        intrinsics: fx, fy, cx, cy in pixels, integer pixel centres, of all frames.

    Returns:
        The colour images with cameras and depth, ordered by name; no sparse points.

    Raises:
        DataError: a file is damaged or too large, or leads outside the folder; or no frame is left.
        OptionError: intrinsics are not four numbers with positive focal lengths.
    """
    K = _matrix(intrinsics)
    folder = Path(path)
    files = sorted(folder.glob(POSES)) if folder.is_dir() else []
    if not 0 < len(files) <= MAX_FRAMES:
        raise DataError(folder, f"expected 1 to {MAX_FRAMES} files {POSES}; found {len(files)}")
    stems = [file.name.removesuffix(".pose.txt") for file in files]
    frames = (
        (
            f"{stem}.color.png",
            path_inside(folder, f"{stem}.color.png", folder),
            _parse_pose(read_text(path_inside(folder, file.name, folder), MAX_POSE_BYTES), file, "the pose"),
            path_inside(folder, f"{stem}.depth.png", folder),
        )
        for file, stem in zip(files, stems, strict=True)
    )
    return _scene(frames, K, NO_DEPTH, folder, "7-scenes")


def _matrix(intrinsics: tuple[float, float, float, float]) -> np.ndarray:
    try:
        fx, fy, cx, cy = (float(value) for value in intrinsics)
    except (TypeError, ValueError):
        fx = fy = cx = cy = np.nan
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if not (np.isfinite(K).all() and min(fx, fy) > 0 and np.abs(K).max() <= MAX_PARAMETER):
        raise OptionError(
            "read_seven_scenes: intrinsics must be fx, fy, cx, cy in pixels, focal lengths above 0; "
            f"got {describe(intrinsics)}"
        )
    return K
