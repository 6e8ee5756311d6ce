"""Lenses with distortion, and the undistorted images of a pinhole camera, by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lsmgeo.errors import CameraError

__all__ = ["Lens"]

# The largest change of focal length by undistortion; beyond, the coefficients are invalid.
MOST_ZOOM = 20.0
# OpenCV's remap has 16-bit sides.
MAX_SIDE = (1 << 15) - 2
# Points along each border of an image at which its field of view is measured, and the tolerance in pixels.
BORDER_POINTS = 65
TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion, as in OpenCV, and its pinhole camera.

    Equation: OpenCV's ``calib3d`` documentation. "perspective" is its rational model with k1, k2, p1, p2, then k3, then
    k4, k5, k6, then s1 to s4, then two tilts; "fisheye" that of Kannala and Brandt with k1, k2, k3, k4.

    Convention:
        Integer pixel centres, as in OpenCV: for half-integer sources 0.5 is subtracted from cx and cy.

    Attributes:
        kind: "perspective" or "fisheye".
        intrinsics: (3, 3) float64 of the distorted image, no skew.
        coefficients: 4, 5, 8, 12 or 14 numbers for "perspective", 4 for "fisheye".
        height: rows of the image, and of the undistorted one.
        width: columns.
    """

    kind: Literal["perspective", "fisheye"]
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]
    height: int
    width: int

    @cached_property
    def pinhole(self) -> np.ndarray:
        """K (3, 3) of the undistorted image of the same size: the widest view without an empty pixel.

        Raises:
            CameraError: no such view exists, or the image is too large for OpenCV.
        """
        if max(self.height, self.width) > MAX_SIDE:
            size = f"{self.width} x {self.height}"
            raise CameraError(f"Lens: images must have at most {MAX_SIDE} pixels a side; got {size}")
        borders = [self._rays(border) for border in self._borders()]
        # A ray that the model cannot invert (NaN) may be in a corner outside of the view.
        if any(np.isnan(border[:, 0]).all() for border in borders):
            raise CameraError(f"Lens: the distortion {self.coefficients} cannot be removed")
        left, right = np.nanmax(borders[0][:, 0]), np.nanmin(borders[1][:, 0])
        top, bottom = np.nanmax(borders[2][:, 1]), np.nanmin(borders[3][:, 1])
        K = np.eye(3)
        with np.errstate(divide="ignore", invalid="ignore"):
            K[[0, 1], [0, 1]] = np.array([self.width - 1, self.height - 1]) / np.array([right - left, bottom - top])
        K[:2, 2] = -K[0, 0] * left, -K[1, 1] * top
        zoom = K[[0, 1], [0, 1]] / self.intrinsics[[0, 1], [0, 1]]
        if not ((zoom > 1 / MOST_ZOOM).all() and (zoom < MOST_ZOOM).all() and self._covers(K)):
            size = f"{self.width} x {self.height}"
            raise CameraError(f"Lens: the distortion {self.coefficients} leaves no undistorted image of {size} pixels")
        return K

    def _borders(self) -> list[np.ndarray]:
        """Pixel centres (N, 2) along the left, right, top and bottom border of an image."""
        x, y = np.linspace(0, self.width - 1, BORDER_POINTS), np.linspace(0, self.height - 1, BORDER_POINTS)
        sides = [(np.full_like(y, side), y) for side in (0, self.width - 1)]
        ends = [(x, np.full_like(x, end)) for end in (0, self.height - 1)]
        return [np.stack(border, -1) for border in (*sides, *ends)]

    def _covers(self, K: np.ndarray) -> bool:
        """Whether the image contains the view of a pinhole camera with this K, and the model is invertible there."""
        border = np.concatenate(self._borders())
        rays = np.linalg.solve(K, np.column_stack((border, np.ones(len(border)))).T).T[:, :2]
        pixels = self._distort(rays)
        inside = (pixels > -TOLERANCE).all() and (
            pixels < (self.width - 1 + TOLERANCE, self.height - 1 + TOLERANCE)
        ).all()
        back = np.abs(self._rays(pixels) - rays) * K[[0, 1], [0, 1]]
        return bool(inside and (back < TOLERANCE).all())

    def straighten(self, image: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        """The image of the pinhole camera.

        Args:
            image: (H, W) or (H, W, C), taken with this lens.
            nearest: take the nearest pixel instead of interpolating; for depth.

        Returns:
            The same shape and dtype.
        """
        import cv2

        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        undistorted = cv2.remap(np.ascontiguousarray(image), *self._maps, how)
        return np.asarray(undistorted).reshape(image.shape)

    def straighten_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Undistort pixels (N, 2), x then y; NaN where that is impossible."""
        return self._rays(pixels) @ self.pinhole[:2, :2].T + self.pinhole[:2, 2]

    def _rays(self, pixels: np.ndarray) -> np.ndarray:
        """Rays x/z, y/z (N, 2) of pixels (N, 2); NaN where the model is not invertible."""
        import cv2

        if len(pixels) == 0:
            return np.zeros((0, 2))
        points = np.ascontiguousarray(pixels, np.float64)[:, None]
        if self.kind == "fisheye":
            undistorted = cv2.fisheye.undistortPoints(points, self.intrinsics, self._distortion)
        else:
            # OpenCV's default of five iterations leaves errors of pixels in the corners of a wide lens.
            iterations = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
            undistorted = cv2.undistortPoints(points, self.intrinsics, self._distortion, criteria=iterations)
        rays = np.asarray(undistorted, np.float64).reshape(-1, 2)
        # OpenCV returns numbers also where the model is not invertible.
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.abs(self._distort(rays) - pixels).max(1)
        return np.where((error < TOLERANCE)[:, None], rays, np.nan)

    def _distort(self, rays: np.ndarray) -> np.ndarray:
        """Distorted pixels (N, 2) of rays (N, 2)."""
        import cv2

        if self.kind == "fisheye":
            distorted = cv2.fisheye.distortPoints(
                np.ascontiguousarray(rays)[:, None], self.intrinsics, self._distortion
            )
        else:
            points = np.column_stack((rays, np.ones(len(rays))))
            distorted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.intrinsics, self._distortion)
        return np.asarray(distorted, np.float64).reshape(-1, 2)

    @cached_property
    def _distortion(self) -> np.ndarray:
        return np.array(self.coefficients, np.float64)

    @property
    def _maps(self) -> tuple[Any, Any]:
        import cv2

        initialise: Any = cv2.fisheye.initUndistortRectifyMap if self.kind == "fisheye" else cv2.initUndistortRectifyMap
        return initialise(
            self.intrinsics, self._distortion, np.eye(3), self.pinhole, (self.width, self.height), cv2.CV_32FC1
        )
