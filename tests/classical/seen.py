"""Solids seen by cameras all round, in NumPy: exact depth and silhouettes that share no code with the library."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from lsmgeo.cameras import CameraTensors
from tests import oracle
from tests.oracle.primitives import Part, first_hit

Array = npt.NDArray[np.float64]


class Cameras(NamedTuple):
    """V cameras; images of one size (h, w)."""

    intrinsics: Array  # (V, 3, 3)
    rotations: Array  # (V, 3, 3)
    translations: Array  # (V, 3)
    size: tuple[int, int]

    def tensors(self, dtype: torch.dtype = torch.float64) -> CameraTensors:
        """As the library takes them."""
        E = np.tile(np.eye(4), (len(self.intrinsics), 1, 1))
        E[:, :3, :3], E[:, :3, 3] = self.rotations, self.translations
        return CameraTensors(torch.tensor(self.intrinsics, dtype=dtype), torch.tensor(E, dtype=dtype), *self.size)

    def rays(self, view: int) -> tuple[Array, Array]:
        """Centres and directions (h*w, 3) of the pixels; directions reach to camera z 1."""
        pixels = oracle.pixel_lattice(self.size)
        camera = self.intrinsics[view], self.rotations[view], self.translations[view]
        ends = oracle.backproject(*camera, pixels, np.ones(len(pixels)))
        center = oracle.camera_center(*camera[1:])
        return np.broadcast_to(center, ends.shape), ends - center

    def see(self, parts: list[Part]) -> tuple[Array, Array]:
        """Camera z (V, h, w) of the first surface, 0 where there is none, and where it is, (V, h, w, 3)."""
        depths, points = [], []
        for view in range(len(self.intrinsics)):
            origins, directions = self.rays(view)
            depth = first_hit(parts, origins, directions)[0]
            depth = np.where(np.isfinite(depth), depth, 0.0)
            depths.append(depth.reshape(self.size))
            points.append((origins + depth[:, None] * directions).reshape(*self.size, 3))
        return np.stack(depths), np.stack(points)


def all_round(views: int = 20, size: tuple[int, int] = (60, 72), distance: float = 2.0) -> Cameras:
    """Cameras on a spiral over a sphere, looking past the origin a little; pixels are sheared and not square."""
    generator = np.random.default_rng(views)
    turn = np.arange(views) + 0.5
    height, around = 1 - 2 * turn / views, np.pi * (3 - np.sqrt(5)) * turn
    flat = np.sqrt(1 - height**2)
    eyes = distance * np.stack((flat * np.cos(around), height, flat * np.sin(around)), -1)
    poses = [oracle.look_at(eye, generator.normal(size=3) * 0.02, generator.normal(size=3)) for eye in eyes]
    focal = 0.72 * min(size) * distance
    K = np.array([[focal * 1.07, 0.9, size[1] / 2 + 0.3], [0.0, focal, size[0] / 2 - 0.8], [0.0, 0.0, 1.0]])
    rotations, translations = (np.stack(items) for items in zip(*poses, strict=True))
    return Cameras(np.tile(K, (views, 1, 1)), rotations, translations, size)


def edges_of(faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Directed edges (3 M, 2) of triangles."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def is_closed(faces: npt.NDArray[np.int64]) -> bool:
    """Whether every directed edge is there once, and its reverse too."""
    edges = {tuple(edge) for edge in edges_of(faces).tolist()}
    return len(edges) == 3 * len(faces) and all((b, a) in edges for a, b in edges)


def volume(vertices: Array, faces: npt.NDArray[np.int64]) -> float:
    """Volume inside a closed mesh, positive where its triangles run counter-clockwise seen from outside."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
