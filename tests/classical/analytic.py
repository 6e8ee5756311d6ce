"""Textured surfaces traced in NumPy, with the depth of every pixel: nothing here comes from the library.

A texture fills space: a sum of plane waves, a few pixels long, whatever surface cuts it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tests.oracle import hit_box, hit_plane, hit_sphere, look_at

SIZE = (72, 96)
NEAR, FAR = 1.2, 3.6
# The surfaces are about two units before the cameras, which are the reference and four around it.
EYES = ((0.0, 0.0, -2.0), (0.32, 0.04, -2.0), (-0.28, 0.11, -1.95), (0.08, -0.3, -2.05), (-0.04, 0.3, -2.0))
# The box is turned: a little, and so that a corner is ahead.
BOX, CORNER = (0.15, -0.1, -1.0), (0.7, -0.5, -1.0)
SURFACES = ("fronto-parallel", "slanted", "sphere", "box")
BORDER = 3


class Pictures(NamedTuple):
    """What V cameras see; of the first camera also depth."""

    images: np.ndarray  # (V, 1, h, w) float32 in [0, 1]
    K: np.ndarray  # (V, 3, 3)
    E: np.ndarray  # (V, 4, 4) world-to-camera
    depth: np.ndarray  # (h, w)
    mask: np.ndarray  # (h, w) bool: on the surface, and at least `BORDER` pixels from where it ends


def texture(points: np.ndarray, seed: int, wavelength: float) -> np.ndarray:
    """Grey values in [0, 1] of points (..., 3)."""
    generator = np.random.default_rng(seed)
    waves = generator.normal(size=(20, 3))
    waves *= 2 * np.pi / wavelength * generator.uniform(0.6, 1.4, (20, 1)) / np.linalg.norm(waves, axis=1)[:, None]
    phases = generator.uniform(0, 2 * np.pi, 20)
    total = np.zeros(points.shape[:-1])
    for wave, phase in zip(waves, phases, strict=True):
        total += np.sin(points @ wave + phase)
    return np.clip(0.5 + 0.15 * total / np.sqrt(10), 0, 1)


def hit(surface: str, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ray parameters at the surface, infinite beside it."""
    if surface == "fronto-parallel":
        return hit_plane(origins, directions, np.array([0.0, 0.0, 1.0]), 0.05)
    if surface == "slanted":
        return hit_plane(origins, directions, np.array([0.45, -0.25, 1.0]), 0.0)
    if surface == "sphere":
        return hit_sphere(origins, directions, np.array([0.01, -0.01, 0.15]), 0.35)
    turn = CORNER if surface == "corner" else BOX
    turned = look_at(np.array(turn), np.zeros(3), np.array([0.0, 1.0, 0.0]))[0]
    side = np.full(3, 0.15)
    return hit_box(origins @ turned.T, directions @ turned.T, -side, side)


def render(
    surface: str,
    *,
    views: int = 4,
    size: tuple[int, int] = SIZE,
    focal: float = 260.0,
    seed: int = 0,
    wavelength: float = 0.045,
) -> Pictures:
    """Trace one surface from all cameras at the pixels' centres.

    Args:
        surface: one of `SURFACES`, or "corner".
        views: V, 5 at most.
        size: (h, w).
        focal: pixels.
        seed: of the texture.
        wavelength: world units; a pixel is about ``2 / focal`` of them wide.
    """
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float64)
    K = np.array([[focal, 0.0, width / 2 - 1.3], [0.0, 1.03 * focal, height / 2 + 0.4], [0.0, 0.0, 1.0]])
    rays = np.stack((u, v, np.ones_like(u)), -1) @ np.linalg.inv(K).T  # camera z = 1, so that s is depth
    images, extrinsics, depths = [], [], []
    for eye in np.array(EYES[:views]):
        rotation, translation = look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]))
        directions = (rays @ rotation).reshape(-1, 3)
        depth = hit(surface, np.broadcast_to(eye, directions.shape), directions)
        meets = np.isfinite(depth)
        grey = np.full(len(depth), 0.5)
        grey[meets] = texture(eye + depth[meets, None] * directions[meets], seed, wavelength)
        images.append(grey.reshape(1, height, width).astype(np.float32))
        extrinsics.append(np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
        depths.append(depth.reshape(height, width))
    mask = np.isfinite(depths[0])
    padded = np.pad(mask, BORDER)
    inner = np.ones_like(mask)
    for y in range(2 * BORDER + 1):
        for x in range(2 * BORDER + 1):
            inner &= padded[y : y + height, x : x + width]
    return Pictures(np.stack(images), np.stack([K] * views), np.stack(extrinsics), depths[0], inner)
