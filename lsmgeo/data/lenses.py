"""Lenses that bend straight lines, and the straight photographs that OpenCV makes of what they saw."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lsmgeo.errors import CameraError

__all__ = ["Lens"]

# What a camera sees may shrink or grow by so much when it is straightened; beyond, the coefficients are nonsense.
MOST_ZOOM = 20.0


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion, in OpenCV's own terms, and the pinhole camera that stands in for it.

    Equation: OpenCV's ``calib3d`` documentation. "perspective" is its rational model with k1, k2, p1, p2, then k3, then
    k4, k5, k6, then s1 to s4, then two tilts; "fisheye" that of Kannala and Brandt with k1, k2, k3, k4.

    Convention:
        Integer pixel centres, as in all of OpenCV: half-integer sources subtract 0.5 from cx and cy first.

    Attributes:
        kind: "perspective" or "fisheye".
        intrinsics: (3, 3) float64 of the photograph as it was taken, no skew.
        coefficients: 4, 5, 8, 12 or 14 numbers for "perspective", 4 for "fisheye".
        height: rows of the photograph, and of the straightened one.
        width: columns.
    """

    kind: Literal["perspective", "fisheye"]
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]
    height: int
    width: int

    @cached_property
    def pinhole(self) -> np.ndarray:
        """K of the straightened photograph, (3, 3): as wide a view as has no empty pixel, at the same size.

        Raises:
            CameraError: the coefficients straighten nothing: no such view exists.
        """
        import cv2

        size = (self.width, self.height)
        try:
            if self.kind == "fisheye":
                K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                    self.intrinsics, self._bent, size, np.eye(3), balance=0.0
                )
            else:
                K, _ = cv2.getOptimalNewCameraMatrix(self.intrinsics, self._bent, size, 0.0)
        except cv2.error as error:
            raise CameraError(f"Lens: the distortion {self.coefficients} cannot be undone") from error
        K = np.asarray(K, np.float64)
        zoom = K[[0, 1], [0, 1]] / self.intrinsics[[0, 1], [0, 1]]
        if not (np.isfinite(K).all() and (zoom > 1 / MOST_ZOOM).all() and (zoom < MOST_ZOOM).all()):
            raise CameraError(f"Lens: the distortion {self.coefficients} leaves no straight picture of {size}")
        return K

    def straighten(self, picture: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        """The photograph that the pinhole camera would have taken.

        Args:
            picture: (H, W) or (H, W, C), of this lens.
            nearest: take the nearest pixel instead of mixing four: for depth, where a mean of two surfaces is neither.

        Returns:
            The same shape and dtype.
        """
        import cv2

        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        straight = cv2.remap(np.ascontiguousarray(picture), *self._maps, how)
        return np.asarray(straight).reshape(picture.shape)

    def straighten_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where the pinhole camera sees what this one sees at ``pixels``, (N, 2), x then y."""
        import cv2

        if len(pixels) == 0:
            return np.zeros((0, 2))
        points = np.ascontiguousarray(pixels, np.float64)[:, None]
        if self.kind == "fisheye":
            straight = cv2.fisheye.undistortPoints(points, self.intrinsics, self._bent, P=self.pinhole)
        else:
            # OpenCV's default of five rounds leaves pixels of error in the corners of a wide lens.
            rounds = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
            straight = cv2.undistortPoints(points, self.intrinsics, self._bent, P=self.pinhole, criteria=rounds)
        return np.asarray(straight, np.float64).reshape(-1, 2)

    @cached_property
    def _bent(self) -> np.ndarray:
        return np.array(self.coefficients, np.float64)

    @property
    def _maps(self) -> tuple[Any, Any]:
        import cv2

        initialise: Any = cv2.fisheye.initUndistortRectifyMap if self.kind == "fisheye" else cv2.initUndistortRectifyMap
        return initialise(self.intrinsics, self._bent, np.eye(3), self.pinhole, (self.width, self.height), cv2.CV_32FC1)
