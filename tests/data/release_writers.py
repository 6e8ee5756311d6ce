"""Objects written as the LSM release and 3D-R2N2 publish theirs: a ball beside the origin, in closed form.

Rays follow each source's own description (half-integer pixel centres; Blender's turns for 3D-R2N2) and share nothing
with the readers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.io import savemat

from tests.oracle.tracing import hit_sphere

SYNSET, MODEL = "03001627", "a1b2c3"
CENTRE, RADIUS = np.array([0.13, -0.1, 0.07]), 0.21
SIZE = 56


def pixel_rays(focal: float, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal and vertical slope of the ray through each pixel's centre, that of the first at (0.5, 0.5)."""
    v, u = np.mgrid[:size, :size] + 0.5
    return (u - size / 2) / focal, (v - size / 2) / focal


def draw_image(distance: np.ndarray, directions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(H, W, 4): the ball coloured by its normal, transparent elsewhere, where the colour is noise."""
    seen = np.isfinite(distance)
    points = origin + np.where(seen, distance, 0.0)[..., None] * directions
    colour = np.where(seen[..., None], 0.5 + 0.4 * (points - CENTRE) / RADIUS, 0.3)
    return np.concatenate([np.rint(255 * colour), 255.0 * seen[..., None]], -1).astype(np.uint8)


def ball_voxels(side: int, scale: float = 1.0) -> np.ndarray:
    """(x, y, z) bool of a cube of side ``scale`` around the origin."""
    line = ((np.arange(side) + 0.5) / side - 0.5) * scale
    centres = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)
    return np.linalg.norm(centres - CENTRE, axis=-1) <= RADIUS


def lsm_pose(view: int) -> np.ndarray:
    """(4, 4) world-to-camera, x right, y down, z forward, two units from the origin."""
    rng = np.random.default_rng(view)
    forward = rng.normal(size=3)
    forward /= np.linalg.norm(forward)
    right = np.cross(rng.normal(size=3), forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[2, 3] = 2.0
    return pose


def write_lsm(root: Path, *, views: int = 12, model: str = MODEL, synset: str = SYNSET) -> Path:
    """One object of the LSM release; returns its folder of renderings."""
    folder = root / "renders" / synset / model
    folder.mkdir(parents=True)
    focal = 1.875 * SIZE
    K = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    across, down = pixel_rays(focal)
    for view in range(views):
        pose = lsm_pose(view)
        directions = np.stack([across, down, np.ones_like(across)], -1) @ pose[:3, :3]
        origin = -pose[:3, 3] @ pose[:3, :3]
        depth = hit_sphere(np.broadcast_to(origin, directions.shape), directions, CENTRE, RADIUS)
        Image.fromarray(draw_image(depth, directions, origin)).save(folder / f"render_{view}.png")
        steps = np.where(np.isfinite(depth), np.rint(np.minimum(depth, 10.0) / 10 * 65535), 65535)
        Image.fromarray(steps.astype(np.uint16)).save(folder / f"depth_{view}.png")
        savemat(folder / f"camera_{view}.mat", {"K": K, "extrinsic": pose, "quat": np.zeros((1, 4))})
    for side in (32, 64):
        file = root / "voxels" / f"modelVoxels{side}" / synset / f"{model}.mat"
        file.parent.mkdir(parents=True, exist_ok=True)
        solid = ball_voxels(side)
        volume = np.zeros((side,) * 3, np.uint8)
        for y in range(side):
            volume[:, :, side - 1 - y] = solid[:, y, :]
        savemat(file, {"Volume": volume}, do_compression=side == 32)
    return folder


def binvox_bytes(solid: np.ndarray, translate: tuple[float, float, float], scale: float, header: str = "") -> bytes:
    """A binvox file of (x, y, z) bool, written voxel by voxel."""
    side = len(solid)
    header = (
        header or f"#binvox 1\ndim {side} {side} {side}\ntranslate {' '.join(map(str, translate))}\nscale {scale}\n"
    )
    runs: list[list[int]] = []
    for x in range(side):
        for z in range(side):
            for y in range(side):
                value = int(solid[x, y, z])
                if runs and runs[-1][0] == value and runs[-1][1] < 255:
                    runs[-1][1] += 1
                else:
                    runs.append([value, 1])
    return header.encode() + b"data\n" + bytes(number for run in runs for number in run)


def _turn(axis: int, degrees: float) -> np.ndarray:
    """Rotation about x, y or z, right-handed."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


# azimuth, elevation, in-plane, distance; the last column of the file is never used.
R2N2_VIEWS = [(30, 20, 0, 0.8), (200, -25, 0, 0.9), (305, 10, 35, 0.7), (75.5, 60, -80, 1.0), (0, 0, 180, 0.85)]
R2N2_SCALE = 0.9


def write_r2n2(root: Path, *, apart: bool = False, size: int = 64, model: str = MODEL, synset: str = SYNSET) -> Path:
    """One object of 3D-R2N2's renderings; returns its folder. ``apart`` puts the voxels into their own tree."""
    home = root / "ShapeNetRendering" / synset / model
    folder = home / "rendering"
    folder.mkdir(parents=True)
    # Blender has z up: the object is loaded as (x, -z, y). Its camera sits on a turning frame, on the frame's x axis.
    object_from_blender = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    across, down = pixel_rays(35 / 32 * size, size)
    lines = []
    for view, (azimuth, elevation, roll, distance) in enumerate(R2N2_VIEWS):
        frame = object_from_blender @ _turn(2, -azimuth) @ _turn(1, -elevation) @ _turn(0, -roll)
        local = np.stack([-np.ones_like(across), across, -down], -1)
        directions = local @ frame.T
        origin = frame @ np.array([1.75 * distance, 0.0, 0.0])
        hit = hit_sphere(np.broadcast_to(origin, directions.shape), directions, CENTRE, RADIUS)
        Image.fromarray(draw_image(hit, directions, origin)).save(folder / f"{view:02d}.png")
        lines.append(f"{azimuth} {elevation} {roll} {distance} 25")
    (folder / "rendering_metadata.txt").write_text("\n".join(lines) + "\n")
    (folder / "renderings.txt").write_text("".join(f"{view:02d}.png\n" for view in range(len(lines))))
    solid = root / "ShapeNetVox32" / synset / model if apart else home
    solid.mkdir(parents=True, exist_ok=True)
    # The header places the cube elsewhere, as the published ones do.
    content = binvox_bytes(ball_voxels(32, R2N2_SCALE), (-0.2, -0.45, -0.1), R2N2_SCALE)
    (solid / "model.binvox").write_bytes(content)
    return home
