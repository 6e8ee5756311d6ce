"""Images of textured spheres, ray-traced in numpy with cameras made here, and errors planted in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lsmgeo.cameras import CameraTensors
from lsmgeo.data import PosedImages
from lsmgeo.data.formats.depth_files import DepthFile
from lsmgeo.data.posed_images import Observations, SparsePoints, Voxels
from lsmgeo.grids import VoxelGrid

HEIGHT, WIDTH = 240, 320
# Centre and radius; the wall is a sphere around them, seen from inside.
SPHERES = ((np.array([0.25, 0.1, 0.0]), 0.45), (np.array([-0.4, -0.15, 0.2]), 0.35), (np.array([0.05, 0.0, -0.3]), 0.3))
WALL = 3.5


@dataclass(frozen=True)
class Traced:
    """V views: K, E (V, 4, 4) world-to-camera, images (V, H, W, 3) uint8, camera z and mask (V, H, W)."""

    K: np.ndarray
    E: np.ndarray
    images: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class DepthInMemory(DepthFile):
    path: Path
    depth: np.ndarray

    def read(self, size):
        assert self.depth.shape == tuple(size)
        return self.depth


def noise(points: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in 0..1: a lattice of 64^3 random numbers, interpolated."""
    table = np.random.default_rng(seed).random((64, 64, 64))
    base = np.floor(points).astype(int)
    part = points - base
    part = part * part * (3 - 2 * part)
    total = np.zeros(points.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part), axis=-1)
        i, j, k = np.moveaxis((base + corner) % 64, -1, 0)
        total += weight * table[i, j, k]
    return total


def look_at(eye, roll):
    forward = np.array([0.03, -0.02, 0.05]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    E = np.eye(4)
    E[:3, :3] = np.stack([right, down, forward])
    E[:3, 3] = -E[:3, :3] @ eye
    return E


def trace(eyes, rolls, *, texture=True, focal=330.0) -> Traced:
    Ks, Es, images, depths, masks = [], [], [], [], []
    for view, (eye, roll) in enumerate(zip(eyes, rolls, strict=True)):
        eye = np.array(eye, float)
        K = np.array([[focal + 2 * view, 0, 166.3], [0, focal + 3 + 2 * view, 113.8], [0, 0, 1]])
        E = look_at(eye, roll)
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ E[:3, :3]
        z = np.full((HEIGHT, WIDTH), np.inf)
        mask = np.zeros((HEIGHT, WIDTH), bool)
        for index, (center, radius) in enumerate([*SPHERES, (np.zeros(3), WALL)]):
            a, b = (rays**2).sum(-1), rays @ (eye - center)
            c = ((eye - center) ** 2).sum() - radius**2
            root = b**2 - a * c
            is_wall = index == len(SPHERES)
            hit = (-b + np.sqrt(np.maximum(root, 0)) * (1 if is_wall else -1)) / a
            nearer = (root > 0) & (hit > 0) & (hit < z)
            z = np.where(nearer, hit, z)
            mask |= nearer & (not is_wall)
        points = eye + z[..., None] * rays
        grey = 0.55 * noise(points * 14 + 7, 1) + 0.45 * noise(points * 31 + 3, 2) if texture else np.full(z.shape, 0.5)
        colour = np.stack([grey, 0.8 * grey + 0.1, 1 - grey], -1) if texture else np.repeat(grey[..., None], 3, -1)
        Ks.append(K)
        Es.append(E)
        images.append(np.round(255 * colour).astype(np.uint8))
        depths.append(z)
        masks.append(mask)
    return Traced(*map(np.array, (Ks, Es, images, depths, masks)))


def on_an_arc(count, step=11.0, distance=2.2):
    """Camera centres on an arc that also rises and falls, and the roll of each camera."""
    angles = np.radians(step) * (np.arange(count) - count / 2)
    heights = 0.35 * np.sin(1.7 * np.arange(count))
    eyes = [(distance * np.sin(a), h, -distance * np.cos(a)) for a, h in zip(angles, heights, strict=True)]
    return eyes, [0.0, 0.9, -0.5, 0.35, 1.2, -0.2, 0.7, -0.9, 0.1, 0.5][:count]


def write(traced: Traced, folder: Path, *, cut_out=False) -> PosedImages:
    """Write the images; the scene has only their cameras."""
    folder.mkdir(parents=True, exist_ok=True)
    count = len(traced.K)
    names = tuple(f"frame_{index}.png" for index in range(count))
    for name, image, mask in zip(names, traced.images, traced.mask, strict=True):
        alpha = (255 * mask[..., None]).astype(np.uint8)
        Image.fromarray(np.concatenate([image, alpha], -1) if cut_out else image).save(folder / name)
    sizes = torch.full((count,), HEIGHT), torch.full((count,), WIDTH)
    cameras = CameraTensors(torch.from_numpy(traced.K.copy()), torch.from_numpy(traced.E.copy()), *sizes)
    return PosedImages(names, tuple(folder / name for name in names), cameras, None, "test", cut_out=cut_out)


def with_depth(scene, traced, maps=None):
    maps = traced.depth if maps is None else maps
    files = tuple(DepthInMemory(path, z.astype(np.float32)) for path, z in zip(scene.paths, maps, strict=True))
    return replace(scene, depths=files)


def with_points(scene, traced, *, noise_px=0.2):
    """Points on the surfaces in the first view, observed wherever they are not occluded."""
    rng = np.random.default_rng(0)
    v, u = rng.integers(5, HEIGHT - 5, 400), rng.integers(5, WIDTH - 5, 400)
    rays = np.stack([u, v, np.ones(400)], -1) @ np.linalg.inv(traced.K[0]).T * traced.depth[0, v, u][:, None]
    E = traced.E[0]
    points = (rays - E[:3, 3]) @ E[:3, :3]
    observed = []
    for K, E, depth in zip(traced.K, traced.E, traced.depth, strict=True):
        camera = points @ E[:3, :3].T + E[:3, 3]
        pixels = (camera @ K.T)[:, :2] / camera[:, 2:]
        x, y = np.round(pixels).astype(int).T
        inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT) & (camera[:, 2] > 0)
        inside[inside] = np.abs(depth[y[inside], x[inside]] / camera[inside, 2] - 1) < 0.02
        rows = np.flatnonzero(inside)
        observed.append(Observations(rows, pixels[rows] + noise_px * rng.standard_normal((len(rows), 2))))
    return replace(scene, points=SparsePoints(points, np.zeros((400, 3), np.uint8), tuple(observed)))


def with_voxels(scene, side=40):
    grid = VoxelGrid(side, -1.0, 1.0)
    x, y, z = np.meshgrid(*[(np.arange(side) + 0.5) / side * 2 - 1] * 3, indexing="ij")
    points = np.stack([x, y, z], -1)
    inside = np.zeros((side, side, side), bool)
    for center, radius in SPHERES:
        inside |= ((points - center) ** 2).sum(-1) <= radius**2
    return replace(scene, voxels=Voxels(torch.from_numpy(inside.transpose(2, 1, 0).copy()), grid))


def with_cameras(scene, *, K=None, E=None):
    fields = {"intrinsics": K, "cam_from_world": E}
    changed = {
        name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in fields.items() if value is not None
    }
    return replace(scene, cameras=scene.cameras._replace(**changed))


def matrices(scene):
    return scene.cameras.intrinsics.numpy().copy(), scene.cameras.cam_from_world.numpy().copy()


def in_order(scene, order):
    """Images and their depth maps in another order than the cameras."""
    moved = replace(scene, paths=tuple(scene.paths[index] for index in order))
    return moved if scene.depths is None else replace(moved, depths=tuple(scene.depths[index] for index in order))


def erroneous(K, E, error):
    """K (V, 3, 3) and E (V, 4, 4) with an error, without the library's converters."""
    gl, mirror = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])  # (c + 1/2) / 2 - 1/2
    transposed, centred, negated = E.copy(), E.copy(), E.copy()
    transposed[:, :3, :3] = E[:, :3, :3].transpose(0, 2, 1)
    centred[:, :3, 3] = np.linalg.inv(E)[:, :3, 3]
    negated[:, :3, 3] *= -1
    changed = {
        "poses inverted": (K, np.linalg.inv(E)),
        "OpenGL axes": (K, gl @ E),
        # NeRF's camera-to-world, read as world-to-camera.
        "poses inverted and OpenGL axes": (K, np.linalg.inv(gl @ E)),
        "y flipped": (K, mirror @ E @ mirror),
        "rotation transposed": (K, transposed),
        "centre taken as translation": (K, centred),
        "translation negated": (K, negated),
        # LLFF's: down, right, back.
        "other camera axes": (K, np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]) @ E),
        "focal length off": (K * [[1.4, 1, 1], [1, 1.4, 1], [1, 1, 1]], E),
        "K of another resolution": (half @ K, E),
        "half a pixel": (K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), E),
    }
    return changed[error]


def planted(scene, error):
    if error != "frames shuffled":
        K, E = erroneous(*matrices(scene), error)
        return with_cameras(scene, K=K, E=E)
    # An image of another size is refused before anything is measured.
    sizes = np.array([scene.size(view) for view in range(len(scene))])
    order, rng = np.arange(len(scene)), np.random.default_rng(3)
    for size in np.unique(sizes, axis=0):
        alike = np.flatnonzero((sizes == size).all(1))
        order[alike] = rng.permutation(alike)
    return in_order(scene, order)
