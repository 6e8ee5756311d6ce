"""The operators' rules, scene by scene and view by view."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tests.oracle.projection import (
    Array,
    backproject,
    is_in_image,
    pixel_lattice,
    project,
    ray_direction,
    resize_intrinsics,
)
from tests.oracle.sampling import is_inside, sample, scatter

NEAR = 1e-6


class Sampled(NamedTuple):
    """Values (B, V, C, N) and visibility (B, V, N)."""

    values: Array
    visible: npt.NDArray[np.bool_]


def unproject(
    features: Array,
    intrinsics: Array,
    rotations: Array,
    translations: Array,
    image_sizes: npt.NDArray[np.int64],
    points: Array,
    *,
    view_mask: npt.NDArray[np.bool_] | None = None,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    augment: tuple[str, ...] = (),
    direction_frame: str = "world",
    near: float = NEAR,
) -> Sampled:
    """Features (B, V, C, h, w) at the points (B, N, 3); cameras (B, V, ...), image sizes (B, V, 2) as (H, W)."""
    batch, views, channels, *size = features.shape
    count = points.shape[1]
    extra = ("depth" in augment) + 3 * ("direction" in augment)
    values = np.zeros((batch, views, channels + extra, count))
    visible = np.zeros((batch, views, count), dtype=bool)
    for b, v in np.ndindex(batch, views):
        if view_mask is not None and not view_mask[b, v]:
            continue
        matrix = resize_intrinsics(intrinsics[b, v], tuple(image_sizes[b, v]), tuple(size))
        pixels, depth = project(matrix, rotations[b, v], translations[b, v], points[b])
        front = depth > near
        visible[b, v] = front & is_in_image(pixels, tuple(size))
        values[b, v, :channels, front] = sample(features[b, v], pixels[front], _kind(mode), padding_mode).T
        geometric = []
        if "depth" in augment:
            geometric.append(depth[None])
        if "direction" in augment:
            geometric.append(ray_direction(rotations[b, v], translations[b, v], points[b], direction_frame).T)
        if geometric:
            values[b, v, channels:] = np.concatenate(geometric)
    return Sampled(values, visible)


def plane_sweep(
    volume: Array,
    intrinsics: Array,
    rotations: Array,
    translations: Array,
    image_sizes: npt.NDArray[np.int64],
    lattice: Array,
    depths: Array,
    size: tuple[int, int],
    *,
    view_mask: npt.NDArray[np.bool_] | None = None,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    augment: tuple[str, ...] = (),
    direction_frame: str = "world",
    near: float = NEAR,
) -> Sampled:
    """Volume (B, C, D, H, W) on the planes (B, V, P) of each view; lattice: world_from_lattice (B, 4, 4).

    Values are (B, V, C, P, h, w), visibility (B, V, P, h, w).
    """
    batch, channels, *shape = volume.shape
    views, planes = depths.shape[1:]
    extra = ("depth" in augment) + 3 * ("direction" in augment)
    values = np.zeros((batch, views, channels + extra, planes, *size))
    visible = np.zeros((batch, views, planes, *size), dtype=bool)
    pixels = pixel_lattice(size)
    for b, v, k in np.ndindex(batch, views, planes):
        if view_mask is not None and not view_mask[b, v]:
            continue
        matrix = resize_intrinsics(intrinsics[b, v], tuple(image_sizes[b, v]), size)
        distance = np.full(len(pixels), depths[b, v, k])
        points = backproject(matrix, rotations[b, v], translations[b, v], pixels, distance)
        index = np.linalg.solve(lattice[b, :3, :3], (points - lattice[b, :3, 3]).T).T
        if depths[b, v, k] > near:
            visible[b, v, k] = is_inside(index, tuple(shape)).reshape(size)
            values[b, v, :channels, k] = sample(volume[b], index, _kind(mode), padding_mode).reshape(channels, *size)
        channel = channels
        if "depth" in augment:
            values[b, v, channel, k] = depths[b, v, k]
            channel += 1
        if "direction" in augment:
            direction = ray_direction(rotations[b, v], translations[b, v], points, direction_frame)
            values[b, v, channel:, k] = direction.T.reshape(3, *size)
    return Sampled(values, visible)


def frustum_index(
    intrinsics: Array, rotation: Array, translation: Array, depths: Array, points: Array
) -> tuple[Array, Array]:
    """Pixel and plane (N, 3) of points (N, 3) in a frustum with these depths (P,), and their depth (N,).

    The plane is linear in 1/depth between neighbours, and goes on so outside; 0 if there is only one.
    """
    pixels, depth = project(intrinsics, rotation, translation, points)
    plane = np.zeros(len(points))
    if len(depths) > 1:
        with np.errstate(divide="ignore"):
            inverse, table = 1.0 / depth, 1.0 / depths
        plane = np.interp(-inverse, -table, np.arange(len(depths), dtype=np.float64))
        first, last = table[0] - table[1], table[-2] - table[-1]
        plane = np.where(inverse > table[0], (table[0] - inverse) / first, plane)
        plane = np.where(inverse < table[-1], len(depths) - 1 + (table[-1] - inverse) / last, plane)
    return np.concatenate([pixels, plane[:, None]], 1), depth


def sample_volume(
    volume: Array,
    index: Array,
    front: npt.NDArray[np.bool_],
    mode: str = "trilinear",
    padding_mode: str = "zeros",
) -> Sampled:
    """Volume (B, C, D, H, W) at x, y, z indices (B, N, 3), 0 where not in front (B, N): (B, C, N), (B, N)."""
    values = np.zeros((*volume.shape[:2], index.shape[1]))
    visible = np.zeros(front.shape, dtype=bool)
    for b in range(len(volume)):
        chosen = front[b]
        values[b, :, chosen] = sample(volume[b], index[b, chosen], _kind(mode), padding_mode).T
        visible[b, chosen] = is_inside(index[b, chosen], volume.shape[2:])
    return Sampled(values, visible)


def splat(
    values: Array,
    intrinsics: Array,
    rotations: Array,
    translations: Array,
    image_sizes: npt.NDArray[np.int64],
    lattice: Array,
    depths: Array,
    shape: tuple[int, int, int],
    *,
    view_mask: npt.NDArray[np.bool_] | None = None,
    mode: str = "trilinear",
    padding_mode: str = "zeros",
    near: float = NEAR,
) -> Array:
    """Values (B, V, C, P, h, w) at depths (B, V, P, h, w), added to volumes (B, C, D, H, W)."""
    batch, views, channels, _, *size = values.shape
    volume = np.zeros((batch, channels, *shape))
    pixels = np.tile(pixel_lattice(tuple(size)), (depths.shape[2], 1))
    for b, v in np.ndindex(batch, views):
        if view_mask is not None and not view_mask[b, v]:
            continue
        matrix = resize_intrinsics(intrinsics[b, v], tuple(image_sizes[b, v]), tuple(size))
        points = backproject(matrix, rotations[b, v], translations[b, v], pixels, depths[b, v].reshape(-1))
        index = np.linalg.solve(lattice[b, :3, :3], (points - lattice[b, :3, 3]).T).T
        front = depths[b, v].reshape(-1) > near
        added = values[b, v].reshape(channels, -1)[:, front]
        volume[b] += scatter(added, index[front], shape, _kind(mode), padding_mode)
    return volume


def view_statistics(values: Array, visible: npt.NDArray[np.bool_], names: tuple[str, ...]) -> Array:
    """Mean, population variance and maximum over the visible views, as blocks of channels: (B, len(names) * C, N)."""
    batch, _, channels, count = values.shape
    blocks = np.zeros((batch, len(names), channels, count))
    for b, c, n in np.ndindex(batch, channels, count):
        seen = values[b, visible[b, :, n], c, n]
        if len(seen) == 0:
            continue
        mean = seen.sum() / len(seen)
        for block, name in enumerate(names):
            if name == "mean":
                blocks[b, block, c, n] = mean
            elif name == "variance":
                blocks[b, block, c, n] = ((seen - mean) ** 2).sum() / len(seen)
            else:
                blocks[b, block, c, n] = seen.max()
    return blocks.reshape(batch, len(names) * channels, count)


def _kind(mode: str) -> str:
    return "nearest" if mode == "nearest" else "linear"
