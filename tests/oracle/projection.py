"""Pinhole cameras and lattices, one view at a time. Pixel (0, 0) is centred at (0.0, 0.0); x right, y down, z ahead."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def project(intrinsics: Array, rotation_matrix: Array, translation: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) and depths (N,) of points (N, 3); pixels are NaN or inf where the depth is 0."""
    x, y, z = (points @ rotation_matrix.T + translation).T
    a, b, cx = intrinsics[0]
    c, d, cy = intrinsics[1]
    with np.errstate(all="ignore"):
        u = (a * x + b * y) / z + cx
        v = (c * x + d * y) / z + cy
    return np.stack([u, v], axis=-1), z


def backproject(intrinsics: Array, rotation_matrix: Array, translation: Array, pixels: Array, depth: Array) -> Array:
    """World points (N, 3) seen at pixels (N, 2) with camera z ``depth`` (N,), by linear solves."""
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[:, :1])], axis=1)
    in_camera = np.linalg.solve(intrinsics, homogeneous.T).T * depth[:, None]
    return np.linalg.solve(rotation_matrix, (in_camera - translation).T).T


def camera_center(rotation_matrix: Array, translation: Array) -> Array:
    """The point that ``R X + t`` maps to 0."""
    return np.linalg.solve(rotation_matrix, -translation)


def ray_direction(rotation_matrix: Array, translation: Array, points: Array, frame: str = "world") -> Array:
    """Unit vectors (N, 3) from the camera centre to the points; 0 at the centre itself."""
    offset = points - camera_center(rotation_matrix, translation)
    if frame == "camera":
        offset = offset @ rotation_matrix.T
    length = np.linalg.norm(offset, axis=-1, keepdims=True)
    return np.divide(offset, length, out=np.zeros_like(offset), where=length > 0)


def resize_intrinsics(intrinsics: Array, image_size: tuple[int, int], size: tuple[int, int]) -> Array:
    """Intrinsics of the same camera whose image (H, W) is resized to (h, w), area for area."""
    sy, sx = size[0] / image_size[0], size[1] / image_size[1]
    resized = np.array(intrinsics, dtype=np.float64)
    resized[0, :2] *= sx
    resized[0, 2] = (intrinsics[0, 2] + 0.5) * sx - 0.5
    resized[1, :2] *= sy
    resized[1, 2] = (intrinsics[1, 2] + 0.5) * sy - 0.5
    return resized


def is_in_image(pixels: Array, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Whether pixels (N, 2) fall in ``[-0.5, w - 0.5) x [-0.5, h - 0.5)``."""
    height, width = size
    u, v = pixels[..., 0], pixels[..., 1]
    with np.errstate(invalid="ignore"):
        return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def homography(reference: tuple[Array, Array, Array], source: tuple[Array, Array, Array], depth: float) -> Array:
    """Pixels of ``source`` from pixels of ``reference`` through its plane ``z = depth``; a camera is (K, R, t)."""
    k_ref, r_ref, t_ref = reference
    k_src, r_src, t_src = source
    relative = r_src @ np.linalg.inv(r_ref)
    offset = t_src - relative @ t_ref
    normal = np.array([0.0, 0.0, 1.0])
    return k_src @ (relative + np.outer(offset, normal) / depth) @ np.linalg.inv(k_ref)


def rotation(axis_angle: Array) -> Array:
    """Rotation by ``|a|`` radians about ``a`` (Rodrigues)."""
    angle = float(np.linalg.norm(axis_angle))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(axis_angle) / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def look_at(eye: Array, target: Array, up: Array) -> tuple[Array, Array]:
    """R, t of a camera at ``eye`` whose z axis points at ``target`` and whose y axis points away from ``up``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(forward, right), forward])
    return matrix, -matrix @ eye


def pixel_lattice(size: tuple[int, int]) -> Array:
    """All pixel centres (h*w, 2) as (u, v), row by row."""
    return np.array([(float(j), float(i)) for i in range(size[0]) for j in range(size[1])])


def world_from_lattice(shape: tuple[int, int, int], lower: Array, upper: Array, pose: Array) -> Array:
    """World from voxel index (x, y, z, 1): voxel i of n is centred at lower + (i + .5)(upper - lower)/n."""
    counts = np.array(shape[::-1], dtype=np.float64)
    spacing = (upper - lower) / counts
    box = np.eye(4)
    box[:3, :3] = np.diag(spacing)
    box[:3, 3] = lower + 0.5 * spacing
    return pose @ box


def voxel_sites(shape: tuple[int, int, int], lower: Array, upper: Array, pose: Array) -> Array:
    """World centres (D, H, W, 3) of the voxels."""
    matrix = world_from_lattice(shape, lower, upper, pose)
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in shape), indexing="ij")
    return np.stack([x, y, z], axis=-1) @ matrix[:3, :3].T + matrix[:3, 3]


def frustum_sites(
    camera: tuple[Array, Array, Array], image_size: tuple[int, int], depths: Array, size: tuple[int, int]
) -> Array:
    """World sites (P, h, w, 3): the pixel centres of the camera resized to ``size``, at camera z ``depths`` (P,)."""
    intrinsics = resize_intrinsics(camera[0], image_size, size)
    pixels = pixel_lattice(size)
    planes = [backproject(intrinsics, camera[1], camera[2], pixels, np.full(len(pixels), d)) for d in depths]
    return np.stack(planes).reshape(len(depths), *size, 3)
