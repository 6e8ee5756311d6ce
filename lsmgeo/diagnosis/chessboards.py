"""Corners of a chessboard in its pictures, its poses, errors of its corners, and calibrations of what was seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lsmgeo.data.formats.format_opencv import CalibratedLens
from lsmgeo.data.images import read_image

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = [
    "Pose", "Seen", "board_errors", "board_points", "calibrate", "calibrate_stereo", "distortion_at_corners",
    "find_corners", "find_pairs", "look_at", "pose_of", "project", "rms", "transfer_errors",
]  # fmt: skip

# Half the side of the square in which a corner is refined, in pixels: larger ones reach the neighbours of a far board.
WINDOW = 5
# Fewer pictures of a board leave a camera undetermined.
FEWEST = 3
# How much two ways to the same pose may differ: radians, and parts of the distance of the board.
ANGLE, SHIFT = 0.02, 0.02


class Seen(NamedTuple):
    """What one camera saw of the board."""

    corners: tuple[np.ndarray | None, ...]  # a picture each, (N, 2) pixels, None where the board was not found
    size: tuple[int, int]  # (height, width) of the first picture; others are not looked at

    @property
    def found(self) -> list[np.ndarray]:
        """The corners of those pictures in which the board was found."""
        return [corners for corners in self.corners if corners is not None]


def board_points(corners: tuple[int, int]) -> np.ndarray:
    """(N, 3) places of a board's corners in squares, row by row, z = 0."""
    columns, rows = corners
    grid = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    return np.column_stack((grid, np.zeros(len(grid))))


def look_at(paths: Sequence[Path], corners: tuple[int, int]) -> Seen:
    """Find the board in all pictures of one camera.

    Raises:
        DataError: a picture is damaged.
    """
    size, seen = None, []
    for path in paths:
        picture = read_image(path)
        size = size or (picture.shape[0], picture.shape[1])
        seen.append(find_corners(picture, corners) if picture.shape[:2] == size else None)
    return Seen(tuple(seen), size or (0, 0))


def find_corners(picture: np.ndarray, corners: tuple[int, int]) -> np.ndarray | None:
    """Find a chessboard's inner corners to a fraction of a pixel.

    The finder may begin at either end of a board. Where the two ends differ in colour, which they do when the numbers
    of corners along the sides are one even and one odd, the order is made the same in all pictures.

    Args:
        picture: (H, W, 3) uint8.
        corners: how many along a row and along a column.

    Returns:
        (N, 2) float64 pixels, integer centres, row by row; None where the board is not there.
    """
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    try:
        there, rough = cv2.findChessboardCorners(grey, corners)
        if not there:
            return None
        rough = rough.reshape(-1, 1, 2)
        grid = rough.reshape(corners[1], corners[0], 2)
        gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
        window = max(1, min(WINDOW, int(0.4 * min(gaps))))
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
        fine = cv2.cornerSubPix(grey, rough, (window, window), (-1, -1), stop)
    except cv2.error:
        return None
    places = np.asarray(fine, np.float64).reshape(corners[1], corners[0], 2)
    first, last = (_grey_within(grey, places[part, part]) for part in (slice(None, 2), slice(-2, None)))
    if sum(corners) % 2 == 1 and first > last:
        places = places[::-1, ::-1]
    return places.reshape(-1, 2)


def _grey_within(grey: np.ndarray, cell: np.ndarray) -> float:
    """The mean grey in the middle of a square, given its four corners."""
    x, y = np.round(cell.reshape(4, 2).mean(0)).astype(int)
    return float(grey[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].mean())


class Pose(NamedTuple):
    """X_to = R X_from + t."""

    R: np.ndarray  # (3, 3)
    t: np.ndarray  # (3,)

    def applied(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the other coordinates."""
        return np.asarray(points @ self.R.T + self.t)

    def after(self, other: Pose) -> Pose:
        """The other pose, then this one."""
        return Pose(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> Pose:
        """The way back."""
        return Pose(self.R.T, -self.R.T @ self.t)


def rms(errors: np.ndarray) -> float:
    """The root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else float("nan")


def pose_of(lens: CalibratedLens, points: np.ndarray, corners: np.ndarray) -> Pose | None:
    """Board-to-camera of one picture, None where there is none.

    Args:
        lens: of the camera.
        points: (N, 3) of the board.
        corners: (N, 2) pixels.
    """
    import cv2

    K, bent = lens.intrinsics, np.array(lens.coefficients)
    try:
        if lens.kind == "fisheye":
            corners, K, bent = cv2.fisheye.undistortPoints(corners[:, None], K, bent)[:, 0], np.eye(3), np.zeros(4)
        found, turn, t = cv2.solvePnP(points, corners, K, bent)
    except cv2.error:
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(t).all()):
        return None
    return Pose(np.asarray(cv2.Rodrigues(turn)[0]), t.ravel())


def project(lens: CalibratedLens, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in camera coordinates."""
    import cv2

    camera: Any = cv2.fisheye if lens.kind == "fisheye" else cv2
    still = np.zeros(3)
    pixels, _ = camera.projectPoints(points[:, None], still, still, lens.intrinsics, np.array(lens.coefficients))
    return np.asarray(pixels).reshape(-1, 2)


def board_errors(lens: CalibratedLens, points: np.ndarray, seen: Sequence[np.ndarray]) -> np.ndarray:
    """Distances in pixels of all corners from where the lens sees the board at its best pose."""
    same = Pose(np.eye(3), np.zeros(3))
    return transfer_errors(same, points, (lens, lens), [(corners, corners) for corners in seen])


def distortion_at_corners(lens: CalibratedLens, size: tuple[int, int]) -> float:
    """How far, in pixels, distortion moves what a pinhole camera would see in a corner of the picture; the largest."""
    height, width = size
    corners = np.array([[x, y, 1.0] for x in (0, width - 1) for y in (0, height - 1)])
    rays = np.linalg.solve(lens.intrinsics, corners.T).T
    return float(np.linalg.norm(project(lens, rays) - corners[:, :2], axis=1).max())


def calibrate(points: np.ndarray, seen: Seen, file: Path) -> tuple[float, CalibratedLens] | None:
    """Calibrate one camera: its rms in pixels, and its lens with five coefficients; None where that cannot be done."""
    import cv2

    found = [corners.astype(np.float32)[:, None] for corners in seen.found]
    if len(found) < FEWEST:
        return None
    board = [points.astype(np.float32)] * len(found)
    try:
        error, K, bent, *_ = cv2.calibrateCamera(board, found, seen.size[::-1], np.eye(3), np.zeros(5))
    except cv2.error:
        return None
    if not (np.isfinite(error) and np.isfinite(K).all() and np.isfinite(bent).all()):
        return None
    return error, CalibratedLens("perspective", K, tuple(map(float, bent.ravel())), seen.size, None, file)


def calibrate_stereo(
    points: np.ndarray,
    lenses: tuple[CalibratedLens, CalibratedLens],
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    size: tuple[int, int],
) -> tuple[float, Pose] | None:
    """The error in pixels, and how the second camera stands to the first, their lenses held; None if it cannot be told.

    Args:
        points: (N, 3) of the board.
        lenses: of both cameras, "perspective".
        pairs: corners in both pictures of each pair, (N, 2) pixels each.
        size: (height, width) of the pictures.
    """
    import cv2

    if len(pairs) < FEWEST:
        return None
    board = [points.astype(np.float32)] * len(pairs)
    first, second = ([pair[side].astype(np.float32)[:, None] for pair in pairs] for side in (0, 1))
    stereo_calibrate: Any = cv2.stereoCalibrate
    held = [value for lens in lenses for value in (lens.intrinsics, np.array(lens.coefficients))]
    try:
        found = stereo_calibrate(board, first, second, *held, size[::-1], flags=cv2.CALIB_FIX_INTRINSIC)
    except cv2.error:
        return None
    error, *_, R, t, _, _ = found
    return (float(error), Pose(np.asarray(R), t.ravel())) if np.isfinite(error) else None


def transfer_errors(
    rig: Pose,
    points: np.ndarray,
    lenses: tuple[CalibratedLens, CalibratedLens],
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Distances in pixels, in the second picture, of corners from where the first picture and the rig put them.

    Args:
        rig: first to second camera, in squares.
        points: (N, 3) of the board.
        lenses: of both cameras.
        pairs: corners in both pictures of each pair, (N, 2) pixels each.
    """
    errors = []
    for first, second in pairs:
        pose = pose_of(lenses[0], points, first)
        if pose is not None:
            errors.append(np.linalg.norm(project(lenses[1], rig.after(pose).applied(points)) - second, axis=1))
    return np.concatenate(errors) if errors else np.zeros(0)


def find_pairs(
    points: np.ndarray,
    lenses: tuple[CalibratedLens, CalibratedLens],
    first: Sequence[np.ndarray],
    second: Sequence[np.ndarray],
) -> list[tuple[int, int]]:
    """Which picture of the second camera belongs to which of the first, by the rig that most of them agree on.

    Each pair of pictures, one of either camera, says how the cameras would stand if the two were taken at once; true
    pairs all say the same.

    Returns:
        Pairs of indices, each picture once at most.
    """
    poses = [
        [pose_of(lens, points, corners) for corners in side] for lens, side in zip(lenses, (first, second), strict=True)
    ]
    choices = [
        (a, b, second_pose.after(first_pose.inverse()))
        for a, first_pose in enumerate(poses[0]) if first_pose is not None
        for b, second_pose in enumerate(poses[1]) if second_pose is not None
    ]  # fmt: skip
    if not choices:
        return []
    R, t = np.stack([rig.R for *_, rig in choices]), np.stack([rig.t for *_, rig in choices])
    distance = np.median([np.linalg.norm(pose.t) for side in poses for pose in side if pose is not None])
    best: list[tuple[int, int]] = []
    for _, _, rig in choices:
        # The angle of a small rotation is |R - R'| / sqrt 2.
        angle = np.linalg.norm(R - rig.R, axis=(1, 2)) / np.sqrt(2)
        shift = np.linalg.norm(t - rig.t, axis=1) / distance
        misfit = angle / ANGLE + shift / SHIFT
        taken: dict[int, int] = {}
        for index in np.argsort(misfit):
            a, b, _ = choices[index]
            if misfit[index] > 1:
                break
            if a not in taken and b not in taken.values():
                taken[a] = b
        if len(taken) > len(best):
            best = sorted(taken.items())
    return best
