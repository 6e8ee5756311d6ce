"""Common errors in cameras and depth, each with its correction: pose conventions, resolution of K, units of depth."""

from __future__ import annotations

import itertools
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.two_view_geometry import Geometry, Hypothesis, scaling

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "FLIP", "OPENGL", "Candidate", "camera_candidates", "depth_candidates", "depth_scaled", "focal_scaled",
    "resolution_candidates", "scaled",
]  # fmt: skip

DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "back"))
OPENGL = np.diag([1.0, -1.0, -1.0])
FLIP = np.diag([1.0, -1.0, 1.0])
# Scales of K that are searched; the best one is refined.
SCALES = np.geomspace(1 / 8, 8, 31)
UNITS = (1000.0, 100.0, 10.0, 5.0, 25.4, 2.54, 4.0, 2.0, 256.0)


class Candidate(NamedTuple):
    """A possible error."""

    name: str
    correction: str  # in words, such as "inverted"
    remedy: str  # what to do, one sentence
    hypothesis: Hypothesis  # the corrected geometry


def camera_candidates(stated: Hypothesis, sizes: np.ndarray) -> list[Candidate]:
    """Errors that affect all cameras alike, common ones first; sizes (V, 2) are height and width of the images."""
    found: list[Candidate] = []

    def add(name: str, correction: str, remedy: str, change: Callable[[Geometry], Geometry]) -> None:
        found.append(Candidate(name, correction, remedy, _both(stated, change)))

    inverse = (
        "The poses are camera-to-world and are used as world-to-camera: invert the 4 x 4 matrices "
        "(R^T and -R^T t), or read them as camera-to-world."
    )
    add("poses inverted", "inverted", inverse, _inverted)
    opengl = (
        "The cameras' axes are OpenGL's (y up, z backwards): negate the second and third row of world-to-camera, "
        "or use lsmgeo.cameras.from_opengl."
    )
    add("OpenGL axes", "with y and z negated", opengl, lambda c: _rotated(c, OPENGL))
    remedy = "y points the other way: negate it in the cameras and in the world, which is left-handed here."
    both = "with the cameras' and the world's y negated"
    add("y flipped", both, remedy, lambda c: _rotated(c._replace(R=c.R @ FLIP), FLIP))
    remedy = "y points the other way: the rows of the images are stored from the bottom up; flip them."
    add("y flipped", "with the images upside down", remedy, lambda c: _flipped(c, sizes, 1))
    remedy = "y points the other way: negate the second row of world-to-camera."
    add("y flipped", "with the cameras' y negated", remedy, lambda c: _rotated(c, FLIP))
    name = "poses inverted and OpenGL axes"
    add(name, "inverted, then with y and z negated", f"{inverse} {opengl}", lambda c: _rotated(_inverted(c), OPENGL))
    add(name, "with y and z negated, then inverted", f"{opengl} {inverse}", lambda c: _inverted(_rotated(c, OPENGL)))
    remedy = "The rotations are camera-to-world and the translations are not: transpose the rotations."
    add("rotation transposed", "with every rotation transposed", remedy, lambda c: c._replace(R=np.linalg.inv(c.R)))
    remedy = "The camera centre C is used as the translation: t is -R C."
    name, correction = "centre taken as translation", "with t = -R C"
    add(name, correction, remedy, lambda c: c._replace(t=-np.einsum("vij,vj->vi", c.R, c.t)))
    remedy = "The translations have the wrong sign: negate them."
    add("translation negated", "with t negated", remedy, lambda c: c._replace(t=-c.t))
    remedy = "The images are mirrored left to right, or the cameras' x points left: mirror them back."
    add("x flipped", "with the images mirrored", remedy, lambda c: _flipped(c, sizes, 0))
    for rotation, words in _other_axes():
        remedy = f"The cameras' x, y, z axes point {words}: bring them to right, down, forward."
        add("other camera axes", f"with axes {words}", remedy, partial(_rotated, rotation=rotation))
        correction, remedy = f"inverted, with axes {words}", f"{inverse} {remedy}"
        add("other camera axes", correction, remedy, lambda c, R=rotation: _rotated(_inverted(c), R))  # type: ignore[misc]
    return found


def resolution_candidates(stated: Hypothesis, sizes: np.ndarray) -> list[Candidate]:
    """K of images of another size: factors that are powers of two, and those that centre the principal points."""
    middles = (np.median(sizes[:, ::-1], axis=0) / 2) / (np.median(stated.cameras.K[:, :2, 2], axis=0) + 0.5)
    hints = [middles, np.full(2, middles.mean())] if (middles > 0.05).all() and (middles < 20).all() else []
    factors = [*(np.full(2, 2.0**power) for power in (-1, 1, -2, 2, -3, 3)), *hints]
    return [scaled(stated, factor) for factor in factors if np.abs(np.log(factor)).max() > 0.02]


def scaled(stated: Hypothesis, factor: np.ndarray) -> Candidate:
    """K resized by (2,) factors along x and y."""
    text = f"{factor[0]:.4g}"
    if not np.isclose(factor[0], factor[1], rtol=1e-3):
        text += f" along x, {factor[1]:.4g} along y"
    remedy = (
        f"K belongs to images of another size: multiply fx and cx, fy and cy by {text} "
        "(lsmgeo.cameras.resize keeps the half pixel right), or use the images of K's size."
    )
    changed = _both(stated, lambda cameras: cameras._replace(K=scaling(*factor) @ cameras.K))
    return Candidate("K of another resolution", f"with K times {text}", remedy, changed)


def focal_scaled(stated: Hypothesis, scale: float) -> Candidate:
    """Focal lengths multiplied; the principal points stay."""
    factor = np.array([[scale, scale, 1.0]] * 2 + [[1.0, 1.0, 1.0]])
    remedy = f"The focal lengths are off by a factor of {scale:.4g}: check units, and width against height"
    # Near 1, shifted principal points have nearly the same effect; far from 1 they have not.
    remedy += "." if abs(np.log(scale)) > 0.2 else "; or the principal points are off."
    changed = _both(stated, lambda cameras: cameras._replace(K=cameras.K * factor))
    return Candidate("focal length off", f"with focal lengths times {scale:.4g}", remedy, changed)


def depth_scaled(stated: Hypothesis, scale: float) -> Candidate:
    """Depth multiplied."""
    remedy = f"Depth and translations are in different units: multiply depth by {scale:.4g}."
    correction = f"with depth times {scale:.4g}"
    return Candidate("depth in other units", correction, remedy, stated._replace(depth_scale=scale))


def depth_candidates(stated: Hypothesis) -> list[Candidate]:
    """Depth along the ray, and depth in other common units."""
    along = "Depth is the distance along the ray: divide it by the length of K^-1 (x, y, 1) to get camera z."
    found = Candidate("depth along the ray", "along the ray", along, stated._replace(along_ray=True))
    return [found, *(depth_scaled(stated, scale) for scale in (*UNITS, *(1 / unit for unit in UNITS)))]


def _both(stated: Hypothesis, change: Callable[[Geometry], Geometry]) -> Hypothesis:
    cameras = change(stated.cameras)
    depth_cameras = cameras if stated.depth_cameras is stated.cameras else change(stated.depth_cameras)
    return stated._replace(cameras=cameras, depth_cameras=depth_cameras)


def _inverted(cameras: Geometry) -> Geometry:
    return cameras._replace(R=np.linalg.inv(cameras.R), t=cameras.centers)


def _rotated(cameras: Geometry, rotation: np.ndarray) -> Geometry:
    return cameras._replace(R=rotation @ cameras.R, t=cameras.t @ rotation.T)


def _flipped(cameras: Geometry, sizes: np.ndarray, axis: int) -> Geometry:
    """Cameras of images that are mirrored along x (0) or y (1)."""
    K = cameras.K.copy()
    K[:, axis] *= -1
    K[:, axis, 2] += sizes[:, 1 - axis] - 1
    return cameras._replace(K=K)


def _other_axes() -> list[tuple[np.ndarray, str]]:
    """Rotations from other right-handed camera axes to ours, except those that have a name, with the axes in words."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            # Column i is the file's axis i in our axes.
            rotation = np.zeros((3, 3))
            rotation[list(order), range(3)] = signs
            if np.linalg.det(rotation) > 0 and not any(np.array_equal(rotation, R) for R in (np.eye(3), OPENGL)):
                words = ", ".join(DIRECTIONS[axis][int(sign < 0)] for axis, sign in zip(order, signs, strict=True))
                found.append((rotation, words))
    return found
