"""Scenes written to disk by code that shares nothing with the readers, and images traced in numpy."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image


class Scene(NamedTuple):
    """V views of a textured, slanted plane: what is written, and the exact depth."""

    names: list[str]
    K: np.ndarray  # (V, 3, 3), integer pixel centres
    R: np.ndarray  # (V, 3, 3), world-to-camera
    t: np.ndarray  # (V, 3)
    size: tuple[int, int]  # (H, W)
    images: np.ndarray  # (V, H, W, 3) uint8
    depth: np.ndarray  # (V, H, W)
    points: np.ndarray  # (N, 3), on the plane
    colours: np.ndarray  # (N, 3) uint8


NORMAL = np.array([0.25, -0.15, 1.0]) / np.linalg.norm([0.25, -0.15, 1.0])


def _look_at(center: np.ndarray, roll: float) -> tuple[np.ndarray, np.ndarray]:
    forward = -center / np.linalg.norm(center)
    right = np.cross([np.sin(roll), np.cos(roll), 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ center


def _texture(points: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    waves = [
        np.sin(a * x + b * y + p) for a, b, p in ((31, 7, 0), (-9, 27, 1), (19, -23, 2), (47, 35, 3), (-41, 52, 4))
    ]
    grey = 0.5 + 0.12 * np.sum(waves, 0)
    return np.clip(np.stack([grey, 0.9 * grey + 0.05, 1 - grey], -1), 0, 1)


def make_scene(height: int = 72, width: int = 96) -> Scene:
    """Five views of the plane ``NORMAL . X = 0``, one of them held upside down, all K different, with skew 0."""
    K, R, t, images, depths = [], [], [], [], []
    for view, (x, y) in enumerate([(0.0, 0.0), (0.35, 0.05), (-0.3, 0.12), (0.1, -0.33), (-0.12, 0.3)]):
        focal = 150.0 + 4 * view
        K.append([[focal, 0, width / 2 - 2.3], [0, focal + 3, height / 2 + 1.2], [0, 0, 1]])
        rotation, translation = _look_at(np.array([x, y, -2.0]), np.pi if view == 2 else 0.02 * view)
        R.append(rotation)
        t.append(translation)
        v, u = np.mgrid[:height, :width]
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K[-1]).T  # camera z = 1
        directions = rays @ rotation  # R^T applied to each
        center = -rotation.T @ translation
        depth = -(center @ NORMAL) / (directions @ NORMAL)
        depths.append(depth)
        images.append(np.round(255 * _texture(center + depth[..., None] * directions)).astype(np.uint8))
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 6)), -1).reshape(-1, 2)
    points = np.concatenate([grid, -(grid @ NORMAL[:2])[:, None] / NORMAL[2]], 1)
    colours = (np.arange(points.size).reshape(-1, 3) * 37 % 256).astype(np.uint8)
    names = [f"view {index}.png" if index == 3 else f"v{index}.png" for index in range(5)]
    return Scene(
        sorted(names), *map(np.array, (K, R, t)), (height, width), np.array(images), np.array(depths), points, colours
    )


def project(scene: Scene, view: int) -> np.ndarray:
    """Pixels (N, 2) of the points, integer centres."""
    pixels = (scene.points @ scene.R[view].T + scene.t[view]) @ scene.K[view].T
    return pixels[:, :2] / pixels[:, 2:]


def write_images(scene: Scene, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(scene.names, scene.images, strict=True):
        Image.fromarray(image).save(folder / name)


def write_middlebury(scene: Scene, folder: Path) -> Path:
    """The Middlebury form; its names hold no blanks."""
    scene = scene._replace(names=[name.replace(" ", "_") for name in scene.names])
    write_images(scene, folder)
    lines = [str(len(scene.names))]
    for name, K, R, t in zip(scene.names, scene.K, scene.R, scene.t, strict=True):
        lines.append(" ".join([name, *(repr(float(x)) for x in (*K.ravel(), *R.ravel(), *t))]))
    (folder / "scene_par.txt").write_text("\n".join(lines) + "\n")
    return folder


def _quaternion(R: np.ndarray) -> np.ndarray:
    # The eigenvector of Bar-Itzhack's symmetric matrix: stable for every rotation, also by half a turn.
    (a, b, c), (d, e, f), (g, h, i) = R
    q = np.array(
        [[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0], [h - f, c - g, d - b, a + e + i]]
    )
    vector = np.linalg.eigh(q / 3)[1][:, -1]
    return vector[[3, 0, 1, 2]]


def _records(scene: Scene) -> list[tuple[int, np.ndarray, np.ndarray, int, str, np.ndarray, np.ndarray]]:
    """Image id, quaternion, t, camera id, name, observations in half-integer pixels, point ids (-1: none)."""
    records = []
    for view, name in enumerate(scene.names):
        pixels = np.concatenate([project(scene, view), [[3.25, 4.5]]]) + 0.5
        ids = np.concatenate([np.arange(len(scene.points)) * 3 + 10, [-1]])
        order = np.random.default_rng(view).permutation(len(ids))
        records.append((view + 5, _quaternion(scene.R[view]), scene.t[view], view + 1, name, pixels[order], ids[order]))
    return records[::-1]


def write_colmap(scene: Scene, folder: Path, *, form: str, sparse: str = "sparse/0") -> Path:
    """The COLMAP form, "text" or "binary"."""
    write_images(scene, folder / "images")
    model = folder / sparse
    model.mkdir(parents=True, exist_ok=True)
    (_write_text if form == "text" else _write_binary)(scene, model)
    return folder


def _write_text(scene: Scene, model: Path) -> None:
    height, width = scene.size
    lines = ["# Camera list with one line of data per camera:"]
    for view, K in enumerate(scene.K):
        values = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
        lines.append(f"{view + 1} PINHOLE {width} {height} " + " ".join(repr(float(x)) for x in values))
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for image_id, q, t, camera_id, name, pixels, ids in _records(scene):
        lines.append(" ".join([str(image_id), *(repr(float(x)) for x in (*q, *t)), str(camera_id), name]))
        lines.append(" ".join(f"{float(x)!r} {float(y)!r} {point}" for (x, y), point in zip(pixels, ids, strict=True)))
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for index, (point, colour) in enumerate(zip(scene.points, scene.colours, strict=True)):
        numbers = " ".join(repr(float(x)) for x in point)
        lines.append(f"{index * 3 + 10} {numbers} {' '.join(map(str, colour))} 0.25 5 0 6 1")
    (model / "points3D.txt").write_text("\n".join(lines) + "\n")


def _write_binary(scene: Scene, model: Path) -> None:
    height, width = scene.size
    content = struct.pack("<Q", len(scene.K))
    for view, K in enumerate(scene.K):
        content += struct.pack("<iiQQ4d", view + 1, 1, width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    (model / "cameras.bin").write_bytes(content)
    records = _records(scene)
    content = struct.pack("<Q", len(records))
    for image_id, q, t, camera_id, name, pixels, ids in records:
        content += struct.pack("<i7di", image_id, *q, *t, camera_id) + name.encode() + b"\0"
        content += struct.pack("<Q", len(ids))
        for (x, y), point in zip(pixels, ids, strict=True):
            content += struct.pack("<ddq", x, y, point)
    (model / "images.bin").write_bytes(content)
    content = struct.pack("<Q", len(scene.points))
    for index, (point, colour) in enumerate(zip(scene.points, scene.colours, strict=True)):
        content += struct.pack("<Q3d3BdQ", index * 3 + 10, *point, *colour.tolist(), 0.25, 2)
        content += struct.pack("<iiii", 5, 0, 6, 1)
    (model / "points3D.bin").write_bytes(content)
