"""RGB-D folders: photographs, 16-bit depth of the same size, one K, and a table of camera-to-world poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.data.assembling import assemble, check_intrinsics, check_last_row, check_rotation, make_cameras
from lsmgeo.data.depth_files import DepthPng
from lsmgeo.data.files import child, parse_floats, read_text, refuse_unreadable
from lsmgeo.data.images import image_size
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.data.posed import PosedImages

__all__ = ["frames_of", "is_rgbd", "parse_pose", "read_rgbd"]

MAX_TABLE_BYTES = 1 << 26
MAX_MATRIX_BYTES = 1 << 14
# Metres or millimetres: no camera of a room or a city is further from the origin.
FARTHEST = 1e9
MILLIMETRE = 0.001
TABLES = ("K.txt", "poses.txt", "frame_index.txt")


def is_rgbd(path: Path) -> bool:
    """Whether a folder, or a ``poses.txt``, is of the form that `read_rgbd` reads."""
    if path.is_file():
        return path.name == "poses.txt" and is_rgbd(path.parent)
    return all((path / name).is_file() for name in TABLES)


@refuse_unreadable
def read_rgbd(path: str | Path) -> PosedImages:
    """Read an RGB-D folder with one table of poses, as HoloLens recordings are kept.

    ``K.txt`` holds K (3 x 3), ``poses.txt`` 16 numbers a line, the 4 x 4 pose of one frame row by row,
    ``frame_index.txt`` the name of that frame on the same line; ``images/`` and ``depth/`` the pictures of these names.
    (The form of HoloLens sets in DeepVideoMVS: Duzceker et al., "DeepVideoMVS: Multi-view stereo on video with
    recurrent spatio-temporal fusion", CVPR 2021.)

    Convention:
        The source has camera-to-world poses, OpenCV axes, integer pixel centres, no distortion, and depth as
        millimetres of camera z with 0 where there is none; the poses are inverted, and depth comes in metres.

    Frames are matched by name. A frame whose picture is not there is left out, and so is one whose pose holds a number
    that is not finite, which is how trackers write that they were lost. A frame without a file of depth has none.

    Args:
        path: the folder, or its ``poses.txt``.

    Returns:
        The photographs with cameras and depth, no sparse points.

    Raises:
        DataError: a file is missing, damaged, too large, or names a file outside the folder; or no frame is left.

    Example:
        >>> from lsmgeo import data
        >>> scene = data.read_rgbd("hololens")  # doctest: +SKIP
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
        raise DataError(index, "names a frame twice")
    kept, poses, paths, depths = [], [], [], []
    for number, (name, row) in enumerate(zip(names, rows, strict=True), 1):
        pose = parse_pose(row, table, f"line {number}")
        picture = child(folder / "images", name, index)
        if pose is None or not picture.is_file():
            continue
        depth = child(folder / "depth", str(Path(name).with_suffix(".png")), index)
        kept.append(name)
        poses.append(pose)
        paths.append(picture)
        depths.append(DepthPng(depth, MILLIMETRE) if depth.is_file() else None)
    return frames_of(kept, paths, poses, K, depths, table, "rgbd")


def parse_pose(text: str, path: Path, where: str) -> np.ndarray | None:
    """A 4 x 4 pose from 16 numbers; None where one of them is not finite.

    Raises:
        DataError: not 16 numbers, or a last row that is not 0 0 0 1, or a position beyond all measure.
    """
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


def frames_of(
    names: Sequence[str],
    paths: Sequence[Path],
    poses: Sequence[np.ndarray],
    intrinsics: np.ndarray,
    depths: Sequence[DepthPng | None],
    file: Path,
    source: str,
) -> PosedImages:
    """Photographs of one K with camera-to-world poses.

    Args:
        names: of the photographs.
        paths: their files.
        poses: camera-to-world, OpenCV axes, (4, 4) each.
        intrinsics: (3, 3), integer pixel centres.
        depths: of each photograph.
        file: where the poses are written, for errors.
        source: the name of the format.

    Raises:
        DataError: there is no frame, a pose is not rigid, or a picture is not readable.
    """
    if not names:
        raise DataError(file, "leaves no frame: every picture is missing or its pose is not finite")
    for name, pose in zip(names, poses, strict=True):
        check_rotation(pose[:3, :3], file, name)
    world_from_cam = np.stack(poses)
    R = world_from_cam[:, :3, :3].transpose(0, 2, 1)
    # -R C and not the inverse: rotations are rounded in these files, and the camera's place should not be.
    t = -(R * world_from_cam[:, None, :3, 3]).sum(-1)
    cameras = make_cameras([intrinsics] * len(names), R, t, [image_size(path) for path in paths], file)
    return assemble(names, paths, cameras, source, file=file, depths=depths)


def _read_intrinsics(file: Path) -> np.ndarray:
    tokens = read_text(file, MAX_MATRIX_BYTES).split()
    if len(tokens) != 9:
        raise DataError(file, f"expected the 9 numbers of K; got {len(tokens)} items")
    K = np.array(parse_floats(tokens, file, "K")).reshape(3, 3)
    check_intrinsics(K, file, "line 1 to 3")
    return K
