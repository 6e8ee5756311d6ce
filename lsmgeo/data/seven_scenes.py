"""7-Scenes sequences: a colour picture, a depth picture and a pose file for each frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.data.assembling import MAX_PARAMETER
from lsmgeo.data.depth_files import DepthPng
from lsmgeo.data.files import child, read_text, refuse_unreadable
from lsmgeo.data.rgbd import MILLIMETRE, frames_of, parse_pose
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from lsmgeo.data.posed import PosedImages

__all__ = ["is_seven_scenes", "read_seven_scenes"]

POSES = "frame-*.pose.txt"
# A sequence has 500 or 1,000 frames; this is an hour of thirty a second.
MAX_FRAMES = 108_000
MAX_POSE_BYTES = 4096
# What the set's authors state, for the camera of depth.
KINECT = (585.0, 585.0, 320.0, 240.0)
# Zero is where other writers of this form put no depth, 65535 where the set itself does.
NO_DEPTH = (0, 65535)


def is_seven_scenes(path: Path) -> bool:
    """Whether a folder is a sequence that `read_seven_scenes` reads."""
    return path.is_dir() and next(path.glob(POSES), None) is not None


@refuse_unreadable
def read_seven_scenes(path: str | Path, *, intrinsics: tuple[float, float, float, float] = KINECT) -> PosedImages:
    """Read one sequence of 7-Scenes, or of a set kept in its form.

    For each frame ``frame-000000.color.png``, ``.depth.png`` (16-bit millimetres, 0 and 65535 where there is none) and
    ``.pose.txt`` (4 x 4). (Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D
    images", CVPR 2013.)

    Convention:
        The source has camera-to-world poses and OpenCV axes; the poses are inverted, and depth comes in metres.

    In the set itself colour and depth are *not registered*: they are pictures of two cameras side by side, with some
    pixels between them, and only the depth camera's K is stated. Its K and poses are used for both, as is customary;
    what is compared across the two (the depth at a pixel of colour) is off by that much near edges. The stated
    principal point is the middle of the picture, so half a pixel in it means nothing.

    A frame without its colour picture is left out, and so is one whose pose holds a number that is not finite (lost
    tracking). A frame without its depth picture has no depth.

    Args:
        path: the folder of one sequence, such as ``chess/seq-01``.
        intrinsics: fx, fy, cx, cy in pixels, integer pixel centres, of all frames.

    Returns:
        The colour pictures with cameras and depth, in the order of their names; no sparse points.

    Raises:
        DataError: a file is damaged, too large, or leads outside the folder; or no frame is left.
        OptionError: intrinsics that are no four numbers, or whose focal lengths are not positive.

    Example:
        >>> from lsmgeo import data
        >>> scene = data.read_seven_scenes("chess/seq-01", intrinsics=(525.0, 525.0, 320.0, 240.0))  # doctest: +SKIP
    """
    K = _matrix(intrinsics)
    folder = Path(path)
    files = sorted(folder.glob(POSES)) if folder.is_dir() else []
    if not 0 < len(files) <= MAX_FRAMES:
        raise DataError(folder, f"expected 1 to {MAX_FRAMES} files {POSES}; found {len(files)}")
    names, poses, paths, depths = [], [], [], []
    for file in files:
        frame = file.name.removesuffix(".pose.txt")
        inside = child(folder, file.name, folder)
        pose = parse_pose(read_text(inside, MAX_POSE_BYTES), file, "the pose")
        picture = child(folder, f"{frame}.color.png", folder)
        if pose is None or not picture.is_file():
            continue
        depth = child(folder, f"{frame}.depth.png", folder)
        names.append(f"{frame}.color.png")
        poses.append(pose)
        paths.append(picture)
        depths.append(DepthPng(depth, MILLIMETRE, NO_DEPTH) if depth.is_file() else None)
    return frames_of(names, paths, poses, K, depths, folder, "7-scenes")


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
