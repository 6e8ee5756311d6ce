"""Random scenes for the library and for the oracle, made from the same numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import assume
from hypothesis import strategies as st

from lsmgeo import scenes
from lsmgeo.cameras import CameraTensors
from tests import oracle
from tests.oracle import primitives as truth

KINDS = ("half_space", "sphere", "ellipsoid", "box", "sheared", "cylinder", "cone", "pointed")


@dataclass(frozen=True)
class Drawn:
    """One scene, and cameras that look at it from outside."""

    scene: scenes.Scene
    parts: list[truth.Part]
    cameras: CameraTensors  # (1, V) float64
    size: tuple[int, int]

    def rays(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (N, 3) of a view's pixels, with camera z of 1."""
        K, E = self.cameras.intrinsics[0, view].numpy(), self.cameras.cam_from_world[0, view].numpy()
        pixels = oracle.pixel_lattice(self.size)
        through = oracle.backproject(K, E[:3, :3], E[:3, 3], pixels, np.ones(len(pixels)))
        center = oracle.camera_center(E[:3, :3], E[:3, 3])
        return np.broadcast_to(center, through.shape), through - center


def make(kind: str, rng: np.random.Generator, up: np.ndarray, scale: float) -> tuple[scenes.Solid, truth.Shape]:
    """A solid near the origin, and the same for the oracle; a half-space faces ``up``, more or less."""
    center, rotation = rng.uniform(-0.4, 0.4, 3), oracle.rotation(rng.normal(size=3) * 2)
    size = rng.uniform(0.15, 0.6, 3) * scale
    if kind == "half_space":
        normal = up + rng.normal(size=3) * 0.2
        return scenes.half_space(center, normal), truth.HalfSpace(center, normal)
    if kind == "sphere":
        return scenes.sphere(center, size[0]), truth.Ellipsoid(center, np.full(3, size[0]), np.eye(3))
    if kind in ("ellipsoid", "box", "sheared"):
        matrix = np.c_[rotation, center]
        if kind == "ellipsoid":
            return scenes.ellipsoid((0, 0, 0), size).transformed(matrix), truth.Ellipsoid(center, size, rotation)
        if kind == "sheared":
            matrix[:, 1] += 0.7 * matrix[:, 0]
        edges = (matrix[:, :3] * size).T
        return scenes.box((0, 0, 0), size).transformed(matrix), truth.Faces(center - edges.sum(0) / 2, edges)
    start, end = center, center + rotation[:, 0] * size[0] * 2
    radii = {"cylinder": (size[1], size[1]), "cone": (size[1], size[2]), "pointed": (size[1], 0.0)}[kind]
    shape = truth.Frustum(start, end, *radii)
    if kind == "cylinder":
        return scenes.cylinder(start, end, radii[0]), shape
    return scenes.cone(start, end, *radii), shape


Names = list[tuple[str, list[str]]]  # of each solid: its kind, and the kinds of its cuts


def build(names: Names, seed: int, size: tuple[int, int] = (15, 20)) -> Drawn | None:
    """A scene of these kinds, seen from two random cameras with skew; None if a solid would contain a camera."""
    rng = np.random.default_rng(seed)
    up = rng.normal(size=3)
    up /= np.linalg.norm(up)
    ours, theirs = [], []
    for kind, cuts in names:
        solid, shape = make(kind, rng, up, 1.0)
        away = [make(cut, rng, rng.normal(size=3), 0.7) for cut in cuts]
        ours.append(solid.minus(*(cut for cut, _ in away)))
        theirs.append(truth.Part(shape, tuple(cut for _, cut in away)))
    views = cameras(rng, size, up)
    eyes = -(views.cam_from_world[0, :, :3, :3].mT @ views.cam_from_world[0, :, :3, 3:])[..., 0].numpy()
    if any(part.shape.holds(eyes).any() for part in theirs):
        return None
    return Drawn(scenes.Scene(ours), theirs, views, size)


@st.composite
def drawn(draw, size=(15, 20)) -> Drawn:
    """Up to four solids with up to two cuts each."""
    solid = st.tuples(st.sampled_from(KINDS), st.lists(st.sampled_from(KINDS), max_size=2))
    found = build(draw(st.lists(solid, min_size=1, max_size=4)), draw(st.integers(0, 2**20)), size)
    assume(found is not None)
    assert found is not None
    return found


def cameras(rng: np.random.Generator, size: tuple[int, int], up: np.ndarray, views: int = 2) -> CameraTensors:
    """Cameras with skew above the scene, far away or close by."""
    K, E = [], []
    for _ in range(views):
        eye = up * rng.uniform(0.7, 4) + rng.normal(size=3) * 0.3
        rotation, translation = oracle.look_at(eye, rng.uniform(-0.2, 0.2, 3), rng.normal(size=3))
        f = rng.uniform(1.2, 2.2, 2) * size[1]
        K.append([[f[0], 0.1 * f[0], size[1] * 0.45], [0, f[1], size[0] * 0.55], [0, 0, 1]])
        E.append(np.r_[np.c_[rotation, translation], [[0, 0, 0, 1]]])
    return CameraTensors(torch.tensor(np.array(K))[None], torch.tensor(np.array(E))[None], *size)
