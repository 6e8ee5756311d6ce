"""Lenses that bend straight lines, and the straight images that OpenCV makes of what they saw."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lsmgeo.errors import CameraError

__all__ = ["Lens"]

# What a camera sees may shrink or grow by so much when it is straightened; beyond, the coefficients are nonsense.
MOST_ZOOM = 20.0
# OpenCV's remap counts pixels along a side in 16 bits.
MAX_SIDE = (1 << 15) - 2
# Points along each side of an image at which its view is measured, and pixels by which these may miss.
RIM_STEPS = 65
RIM_SLACK = 0.01


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion, in OpenCV's own terms, and the pinhole camera that stands in for it.

    Equation: OpenCV's ``calib3d`` documentation. "perspective" is its rational model with k1, k2, p1, p2, then k3, then
    k4, k5, k6, then s1 to s4, then two tilts; "fisheye" that of Kannala and Brandt with k1, k2, k3, k4.

    Convention:
        Integer pixel centres, as in all of OpenCV: half-integer sources subtract 0.5 from cx and cy first.

    Attributes:
        kind: "perspective" or "fisheye".
        intrinsics: (3, 3) float64 of the image as it was taken, no skew.
        coefficients: 4, 5, 8, 12 or 14 numbers for "perspective", 4 for "fisheye".
        height: rows of the image, and of the straightened one.
        width: columns.
    """

    kind: Literal["perspective", "fisheye"]
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]
    height: int
    width: int

    @cached_property
    def pinhole(self) -> np.ndarray:
        """K of the straightened image, (3, 3): as wide a view as has no empty pixel, at the same size.

        Raises:
            CameraError: the coefficients straighten nothing: no such view exists; or the image is too long for
                OpenCV.
        """
        if max(self.height, self.width) > MAX_SIDE:
            size = f"{self.width} x {self.height}"
            raise CameraError(f"Lens: images of at most {MAX_SIDE} pixels a side are straightened; got {size}")
        rims = [self._rays(rim) for rim in self._borders()]
        # A ray that the model cannot trace back (NaN) may lie in a corner that the view need not reach.
        if any(np.isnan(rim[:, 0]).all() for rim in rims):
            raise CameraError(f"Lens: the distortion {self.coefficients} cannot be undone")
        left, right = np.nanmax(rims[0][:, 0]), np.nanmin(rims[1][:, 0])
        top, bottom = np.nanmax(rims[2][:, 1]), np.nanmin(rims[3][:, 1])
        K = np.eye(3)
        with np.errstate(divide="ignore", invalid="ignore"):
            K[[0, 1], [0, 1]] = np.array([self.width - 1, self.height - 1]) / np.array([right - left, bottom - top])
        K[:2, 2] = -K[0, 0] * left, -K[1, 1] * top
        zoom = K[[0, 1], [0, 1]] / self.intrinsics[[0, 1], [0, 1]]
        if not ((zoom > 1 / MOST_ZOOM).all() and (zoom < MOST_ZOOM).all() and self._covers(K)):
            size = f"{self.width} x {self.height}"
            raise CameraError(f"Lens: the distortion {self.coefficients} leaves no straight image of {size} pixels")
        return K

    def _borders(self) -> list[np.ndarray]:
        """Pixel centres (N, 2) along the left, right, top and bottom of an image."""
        x, y = np.linspace(0, self.width - 1, RIM_STEPS), np.linspace(0, self.height - 1, RIM_STEPS)
        sides = [(np.full_like(y, side), y) for side in (0, self.width - 1)]
        ends = [(x, np.full_like(x, end)) for end in (0, self.height - 1)]
        return [np.stack(rim, -1) for rim in (*sides, *ends)]

    def _covers(self, K: np.ndarray) -> bool:
        """Whether the image shows all that a pinhole camera with this K sees, and there and back is the same."""
        rim = np.concatenate(self._borders())
        rays = np.linalg.solve(K, np.column_stack((rim, np.ones(len(rim)))).T).T[:, :2]
        pixels = self._distort(rays)
        inside = (pixels > -RIM_SLACK).all() and (
            pixels < (self.width - 1 + RIM_SLACK, self.height - 1 + RIM_SLACK)
        ).all()
        back = np.abs(self._rays(pixels) - rays) * K[[0, 1], [0, 1]]
        return bool(inside and (back < RIM_SLACK).all())

    def straighten(self, image: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        """The image that the pinhole camera would have taken.

        Args:
            image: (H, W) or (H, W, C), of this lens.
            nearest: take the nearest pixel instead of mixing four: for depth, where a mean of two surfaces is neither.

        Returns:
            The same shape and dtype.
        """
        import cv2

        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        straight = cv2.remap(np.ascontiguousarray(image), *self._maps, how)
        return np.asarray(straight).reshape(image.shape)

    def straighten_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where the pinhole camera sees what this one sees at ``pixels``, (N, 2), x then y; NaN where it cannot."""
        return self._rays(pixels) @ self.pinhole[:2, :2].T + self.pinhole[:2, 2]

    def _rays(self, pixels: np.ndarray) -> np.ndarray:
        """(N, 2) x/z and y/z of what is seen at pixels (N, 2); NaN where the model leads to no ray or to another."""
        import cv2

        if len(pixels) == 0:
            return np.zeros((0, 2))
        points = np.ascontiguousarray(pixels, np.float64)[:, None]
        if self.kind == "fisheye":
            straight = cv2.fisheye.undistortPoints(points, self.intrinsics, self._distortion)
        else:
            # OpenCV's default of five rounds leaves pixels of error in the corners of a wide lens.
            rounds = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
            straight = cv2.undistortPoints(points, self.intrinsics, self._distortion, criteria=rounds)
        rays = np.asarray(straight, np.float64).reshape(-1, 2)
        # Beyond what the model can undo, OpenCV gives numbers all the same.
        with np.errstate(invalid="ignore", over="ignore"):
            missed = np.abs(self._distort(rays) - pixels).max(1)
        return np.where((missed < RIM_SLACK)[:, None], rays, np.nan)

    def _distort(self, rays: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) at which this camera sees rays (N, 2)."""
        import cv2

        if self.kind == "fisheye":
            bent = cv2.fisheye.distortPoints(np.ascontiguousarray(rays)[:, None], self.intrinsics, self._distortion)
        else:
            points = np.column_stack((rays, np.ones(len(rays))))
            bent, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.intrinsics, self._distortion)
        return np.asarray(bent, np.float64).reshape(-1, 2)

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
