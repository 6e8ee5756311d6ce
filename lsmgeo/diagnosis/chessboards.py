"""Chessboards: corners in images, board poses, reprojection errors, and calibration of cameras and rigs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lsmgeo.data.formats.format_opencv import CalibratedLens
from lsmgeo.data.images import read_image

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = [
    "Detections", "Pose", "board_errors", "board_points", "calibrate", "calibrate_stereo", "detect_boards",
    "distortion_at_corners", "find_corners", "find_pairs", "pose_of", "project", "rms", "transfer_errors",
]  # fmt: skip

# Half the side of the window in which a corner is refined, px: larger ones reach the next corner of a distant board.
WINDOW = 5
# Fewer images of a board do not determine a camera.
FEWEST = 3
# Largest difference between two estimates of a rig: radians, and relative to the distance of the board.
ANGLE, SHIFT = 0.02, 0.02


class Detections(NamedTuple):
    """The board in the images of one camera."""

    corners: tuple[np.ndarray | None, ...]  # of each image, (N, 2) pixels, None without a board
    size: tuple[int, int]  # (height, width) of the first image; images of other sizes are skipped

    @property
    def found(self) -> list[np.ndarray]:
        """The corners in the images that show the board."""
        return [corners for corners in self.corners if corners is not None]


def board_points(corners: tuple[int, int]) -> np.ndarray:
    """(N, 3) corners of a board in squares, row by row, z = 0."""
    columns, rows = corners
    grid = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    return np.column_stack((grid, np.zeros(len(grid))))


def detect_boards(paths: Sequence[Path], corners: tuple[int, int]) -> Detections:
    """Find the board in all images of one camera.

    Raises:
        DataError: an image is damaged.
    """
    size, found = None, []
    for path in paths:
        image = read_image(path)
        size = size or (image.shape[0], image.shape[1])
        found.append(find_corners(image, corners) if image.shape[:2] == size else None)
    return Detections(tuple(found), size or (0, 0))


def find_corners(image: np.ndarray, corners: tuple[int, int]) -> np.ndarray | None:
    """Find a chessboard's inner corners with subpixel accuracy.

    The detector may start at either end of a board. If one number of corners is even and the other odd, the ends
    differ in colour, and the order is made the same in all images.

    Args:
        image: (H, W, 3) uint8.
        corners: how many along a row and along a column.

    Returns:
        (N, 2) float64 pixels, integer centres, row by row; None without a board.
    """
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    try:
        success, rough = cv2.findChessboardCorners(grey, corners)
        if not success:
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
    first, last = (_mean_grey(grey, places[part, part]) for part in (slice(None, 2), slice(-2, None)))
    if sum(corners) % 2 == 1 and first > last:
        places = places[::-1, ::-1]
    return places.reshape(-1, 2)


def _mean_grey(grey: np.ndarray, cell: np.ndarray) -> float:
    """The mean grey level at the centre of a square, given its four corners."""
    x, y = np.round(cell.reshape(4, 2).mean(0)).astype(int)
    return float(grey[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].mean())


class Pose(NamedTuple):
    """X_to = R X_from + t."""

    R: np.ndarray  # (3, 3)
    t: np.ndarray  # (3,)

    def transform(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the other coordinates."""
        return np.asarray(points @ self.R.T + self.t)

    def compose(self, other: Pose) -> Pose:
        """The other pose, followed by this one."""
        return Pose(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> Pose:
        """The inverse pose."""
        return Pose(self.R.T, -self.R.T @ self.t)


def rms(errors: np.ndarray) -> float:
    """The root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else float("nan")


def pose_of(lens: CalibratedLens, points: np.ndarray, corners: np.ndarray) -> Pose | None:
    """Board-to-camera pose from board corners (N, 3) and their pixels (N, 2) in one image, None without a solution."""
    import cv2

    K, distortion = lens.intrinsics, np.array(lens.coefficients)
    try:
        if lens.kind == "fisheye":
            corners = cv2.fisheye.undistortPoints(corners[:, None], K, distortion)[:, 0]
            K, distortion = np.eye(3), np.zeros(4)
        found, rotation, t = cv2.solvePnP(points, corners, K, distortion)
    except cv2.error:
        return None
    if not found or not (np.isfinite(rotation).all() and np.isfinite(t).all()):
        return None
    return Pose(np.asarray(cv2.Rodrigues(rotation)[0]), t.ravel())


def project(lens: CalibratedLens, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in camera coordinates."""
    import cv2

    camera: Any = cv2.fisheye if lens.kind == "fisheye" else cv2
    zero = np.zeros(3)
    pixels, _ = camera.projectPoints(points[:, None], zero, zero, lens.intrinsics, np.array(lens.coefficients))
    return np.asarray(pixels).reshape(-1, 2)


def board_errors(lens: CalibratedLens, points: np.ndarray, found: Sequence[np.ndarray]) -> np.ndarray:
    """Reprojection errors in pixels of all corners, with each board at its best pose."""
    identity = Pose(np.eye(3), np.zeros(3))
    return transfer_errors(identity, points, (lens, lens), [(corners, corners) for corners in found])


def distortion_at_corners(lens: CalibratedLens, size: tuple[int, int]) -> float:
    """The largest distortion in the corners of the image, in pixels."""
    height, width = size
    corners = np.array([[x, y, 1.0] for x in (0, width - 1) for y in (0, height - 1)])
    rays = np.linalg.solve(lens.intrinsics, corners.T).T
    return float(np.linalg.norm(project(lens, rays) - corners[:, :2], axis=1).max())


def calibrate(points: np.ndarray, detections: Detections, file: Path) -> tuple[float, CalibratedLens] | None:
    """Calibrate one camera: its rms in pixels, and its lens with five coefficients; None if that fails."""
    import cv2

    found = [corners.astype(np.float32)[:, None] for corners in detections.found]
    if len(found) < FEWEST:
        return None
    board = [points.astype(np.float32)] * len(found)
    try:
        error, K, distortion, *_ = cv2.calibrateCamera(board, found, detections.size[::-1], np.eye(3), np.zeros(5))
    except cv2.error:
        return None
    if not (np.isfinite(error) and np.isfinite(K).all() and np.isfinite(distortion).all()):
        return None
    return error, CalibratedLens("perspective", K, tuple(map(float, distortion.ravel())), detections.size, None, file)


def calibrate_stereo(
    points: np.ndarray,
    lenses: tuple[CalibratedLens, CalibratedLens],
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    size: tuple[int, int],
) -> tuple[float, Pose] | None:
    """The rms in pixels and the pose of the second camera relative to the first, with fixed lenses; None if that fails.

    Both lenses are "perspective", and the images have one size; for the rest see `transfer_errors`.
    """
    import cv2

    if len(pairs) < FEWEST:
        return None
    board = [points.astype(np.float32)] * len(pairs)
    first, second = ([pair[side].astype(np.float32)[:, None] for pair in pairs] for side in (0, 1))
    stereo_calibrate: Any = cv2.stereoCalibrate
    fixed = [value for lens in lenses for value in (lens.intrinsics, np.array(lens.coefficients))]
    try:
        found = stereo_calibrate(board, first, second, *fixed, size[::-1], flags=cv2.CALIB_FIX_INTRINSIC)
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
    """Errors in pixels of corners that the rig transfers from the first image to the second.

    Args:
        rig: first to second camera, in squares.
        points: (N, 3) corners of the board.
        lenses: of both cameras.
        pairs: corners in both images of each pair, (N, 2) pixels each.
    """
    errors = []
    for first, second in pairs:
        pose = pose_of(lenses[0], points, first)
        if pose is not None:
            errors.append(np.linalg.norm(project(lenses[1], rig.compose(pose).transform(points)) - second, axis=1))
    return np.concatenate(errors) if errors else np.zeros(0)


def find_pairs(
    points: np.ndarray,
    lenses: tuple[CalibratedLens, CalibratedLens],
    first: Sequence[np.ndarray],
    second: Sequence[np.ndarray],
) -> list[tuple[int, int]]:
    """Pair the images of two cameras by the rig pose that most pairs agree on.

    Each pair of images gives the pose of one camera relative to the other, as if taken at the same time; it is the same
    for all correct pairs.

    Returns:
        Pairs of indices, each image once at most.
    """
    poses = [
        [pose_of(lens, points, corners) for corners in side] for lens, side in zip(lenses, (first, second), strict=True)
    ]
    choices = [
        (a, b, second_pose.compose(first_pose.inverse()))
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
