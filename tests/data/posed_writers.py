"""Scenes on disk in the forms of NeRF, LLFF and Strecha, by code that shares nothing with the readers.

The scene is that of `tests.data.writers`; where images should differ in size, each is cut to one of its own.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lsmgeo.data import PosedImages
from tests.data.writers import Scene

# Rows and columns taken off the bottom and the right, which leaves K as it is.
TRIMS = ((0, 0), (3, 5), (0, 8), (7, 0), (2, 2))


def trimmed(scene: Scene) -> list[np.ndarray]:
    """The images, each of another size."""
    height, width = scene.size
    return [
        image[: height - rows, : width - columns] for image, (rows, columns) in zip(scene.images, TRIMS, strict=False)
    ]


def check_scene(read: PosedImages, scene: Scene, images: Sequence[np.ndarray]) -> None:
    """Cameras and images are those that were written."""
    np.testing.assert_allclose(read.cameras.intrinsics.numpy(), scene.K, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, :3].numpy(), scene.R, atol=1e-12)
    np.testing.assert_allclose(read.cameras.cam_from_world[:, :3, 3].numpy(), scene.t, atol=1e-12)
    for view, image in enumerate(images):
        assert read.size(view) == image.shape[:2]
        expected = torch.from_numpy(image.copy()).permute(2, 0, 1).to(torch.float32) / 255
        torch.testing.assert_close(read.load(view), expected, rtol=0, atol=0)


def save(images: list[np.ndarray], names: list[str], folder: Path) -> None:
    for name, image in zip(names, images, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(folder / name)


def camera_to_world(scene: Scene, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns right, down, forward, and the centre, found by solving ``R C = -t``."""
    return np.linalg.inv(scene.R[view]), np.linalg.solve(scene.R[view], -scene.t[view])


def transforms(scene: Scene, images: list[np.ndarray], names: list[str]) -> dict:
    """Nerfstudio's form, everything stated in every frame."""
    frames = []
    for view, (name, image) in enumerate(zip(names, images, strict=True)):
        axes, center = camera_to_world(scene, view)
        right, down, forward = axes.T
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, center], 1)
        K = scene.K[view]
        frames.append(
            {
                "file_path": name, "w": image.shape[1], "h": image.shape[0],
                "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5,
                "transform_matrix": matrix.tolist(),
            }
        )  # fmt: skip
    return {"camera_model": "PINHOLE", "frames": frames}


def write_transforms(scene: Scene, folder: Path, change=None, images=None) -> Path:
    """The file, after ``change(values)``; images of different sizes unless given."""
    images = trimmed(scene) if images is None else images
    names = [f"images/{name}" for name in scene.names]
    save(images, names, folder)
    values = transforms(scene, images, names)
    if change is not None:
        change(values)
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder


def llff_rows(scene: Scene, focal: float) -> np.ndarray:
    """(V, 17) as LLFF's own script makes them."""
    rows = []
    for view in range(len(scene.names)):
        axes, center = camera_to_world(scene, view)
        right, down, forward = axes.T
        pose = np.stack([down, right, -forward, center, [*scene.size, focal]], 1)  # (3, 5)
        rows.append([*pose.ravel(), 1.0, 9.0])
    return np.array(rows)


def strecha_text(scene: Scene, view: int, image: np.ndarray) -> str:
    """``P = K [R^T | -R^T C]``."""
    axes, center = camera_to_world(scene, view)
    lines = [*scene.K[view], np.zeros(3), *axes, center]
    text = "\n".join(" ".join(repr(float(value)) for value in line) for line in lines)
    return f"{text}\n{image.shape[1]} {image.shape[0]}\n"


def write_strecha(scene: Scene, cameras: Path, images: Path, names: list[str]) -> Path:
    cropped = trimmed(scene)
    save(cropped, names, images)
    cameras.mkdir(parents=True, exist_ok=True)
    for view, name in enumerate(names):
        (cameras / f"{name}.camera").write_text(strecha_text(scene, view, cropped[view]))
        (cameras / f"{name}.P").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    return cameras


def plain_cameras(scene: Scene, images: list[np.ndarray]) -> dict:
    entries = []
    for view, (name, image) in enumerate(zip(scene.names, images, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = scene.R[view], scene.t[view]
        entries.append(
            {"file": f"images/{name}", "width": image.shape[1], "height": image.shape[0],
             "K": scene.K[view].tolist(), "cam_from_world": pose.tolist()}
        )  # fmt: skip
    return {"format": "lsmgeo cameras", "version": 1, "pixel_center": "integer", "cameras": entries}


def write_plain_cameras(scene: Scene, folder: Path, change=None) -> Path:
    images = trimmed(scene)
    save(images, scene.names, folder / "images")
    values = plain_cameras(scene, images)
    if change is not None:
        change(values)
    (folder / "cameras.json").write_text(json.dumps(values))
    return folder


def sky(rays: np.ndarray) -> np.ndarray:
    """A smooth texture of directions (..., 3), as 0..255 in three channels."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return np.stack([128 + 100 * np.sin(a * x + b * y) for a, b in ((9, 4), (-5, 8), (3, -7))], -1)


def see_perspective(x: np.ndarray, y: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's rational model of x/z and y/z, as its documentation states it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *[0.0] * (8 - len(k)))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return bent_x, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def see_fisheye(x: np.ndarray, y: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Kannala's and Brandt's model as OpenCV states it."""
    r = np.hypot(x, y)
    angle = np.arctan(r)
    bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
    ratio = np.where(r > 0, bent / np.maximum(r, 1e-300), 1.0)
    return x * ratio, y * ratio


def render_sky(see, K: np.ndarray, k: tuple[float, ...], size: tuple[int, int], R: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the texture at infinity through a lens, each pixel's ray found by Newton's method."""
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    target_x, target_y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    x, y = target_x.copy(), target_y.copy()
    step = 1e-6
    for _ in range(30):
        found_x, found_y = see(x, y, k)
        right, down = see(x + step, y, k), see(x, y + step, k)
        a, c = (right[0] - found_x) / step, (right[1] - found_y) / step
        b, d = (down[0] - found_x) / step, (down[1] - found_y) / step
        miss_x, miss_y = target_x - found_x, target_y - found_y
        x, y = x + (d * miss_x - b * miss_y) / (a * d - b * c), y + (a * miss_y - c * miss_x) / (a * d - b * c)
    assert np.abs(np.stack(see(x, y, k)) - np.stack([target_x, target_y])).max() < 1e-9
    return np.round(sky(np.stack([x, y, np.ones_like(x)], -1) @ R)).astype(np.uint8)
