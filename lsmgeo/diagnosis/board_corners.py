"""Where the corners of a chessboard are in its pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.data.images import read_image

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["Seen", "board_points", "find_corners", "look_at"]

# Half the side of the square in which a corner is refined, in pixels: larger ones reach the neighbours of a far board.
WINDOW = 5


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
