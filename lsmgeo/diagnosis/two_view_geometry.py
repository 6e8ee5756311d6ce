"""Cameras as plain matrices, hypotheses about them, and the epipolar geometry of two views."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages

__all__ = [
    "Geometry", "Hypothesis", "evenly", "fundamental", "homogeneous", "project", "relative", "scaling",
    "stated_hypothesis",
]  # fmt: skip

# A baseline shorter than this fraction of the cameras' distance from the origin is rounding error.
NO_BASELINE = 1e-9


class Geometry(NamedTuple):
    """V cameras ``x ~ K (R X + t)``, integer pixel centres; R is any invertible matrix: hypotheses include mirrors."""

    K: np.ndarray  # (V, 3, 3)
    R: np.ndarray  # (V, 3, 3)
    t: np.ndarray  # (V, 3)

    @property
    def centers(self) -> np.ndarray:
        """Camera centres, (V, 3)."""
        return -np.linalg.solve(self.R, self.t[..., None])[..., 0]

    def select(self, index: np.ndarray) -> Geometry:
        """The cameras with these indices, in this order."""
        return Geometry(self.K[index], self.R[index], self.t[index])

    def shifted(self, x: float, y: float) -> Geometry:
        """The cameras with their principal points moved by (x, y) px."""
        return self._replace(K=self.K + np.array([[0, 0, x], [0, 0, y], [0, 0, 0]]))


class Hypothesis(NamedTuple):
    """Cameras, and a reading of the depth, to be tested."""

    cameras: Geometry  # of the V images
    depth_cameras: Geometry  # of depth maps and sparse points; equal unless only the images are out of order
    depth_scale: float = 1.0  # factor on the depth
    along_ray: bool = False  # whether depth is the distance from the camera centre


def stated_hypothesis(scene: PosedImages) -> Hypothesis:
    """The cameras that the scene states, float64."""
    K, E = (np.array(torch.as_tensor(value).double()) for value in scene.cameras[:2])
    geometry = Geometry(K, E[:, :3, :3].copy(), E[:, :3, 3].copy())
    return Hypothesis(geometry, geometry)


def evenly(count: int, most: int) -> np.ndarray:
    """At most ``most`` of ``count`` indices, evenly spaced."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def scaling(x: float, y: float) -> np.ndarray:
    """S (3, 3): ``S K`` is for images x times as wide and y times as high, see `lsmgeo.cameras.resize`."""
    return np.array([[x, 0, 0.5 * x - 0.5], [0, y, 0.5 * y - 0.5], [0, 0, 1]])


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    """Homogeneous coordinates: (..., 2) with a third coordinate 1."""
    return np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], -1)


def relative(geometry: Geometry, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A (P, 3, 3) and b (P, 3) with ``X2 = A X1 + b``, from the first camera's coordinates to the second camera's.

    Without a baseline, b is exactly zero.
    """
    inverse = np.linalg.inv(geometry.R)
    A = geometry.R[second] @ inverse[first]
    b = geometry.t[second] - np.einsum("pij,pj->pi", A, geometry.t[first])
    sizes = np.maximum(np.linalg.norm(geometry.t[first], axis=1), np.linalg.norm(geometry.t[second], axis=1))
    b[np.linalg.norm(b, axis=1) <= NO_BASELINE * sizes] = 0.0
    return A, b


def fundamental(geometry: Geometry, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """F (P, 3, 3) with ``x2^T F x1 = 0``; zero without a baseline.

    Equation: F = K2^-T [b]x A K1^-1 (Hartley and Zisserman, "Multiple View Geometry", equation 9.2).
    """
    from kornia.geometry.epipolar import cross_product_matrix, fundamental_from_essential

    A, b, K = (torch.from_numpy(value) for value in (*relative(geometry, first, second), geometry.K))
    return fundamental_from_essential(cross_product_matrix(b) @ A, K[first], K[second]).numpy()


def project(geometry: Geometry, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depth (N,) of world points (N, 3) in one view; pixels are NaN at depth zero."""
    camera = points @ geometry.R[view].T + geometry.t[view]
    image = camera @ geometry.K[view].T
    depth = image[:, 2]
    return image[:, :2] / np.where(depth == 0, np.nan, depth)[:, None], depth
