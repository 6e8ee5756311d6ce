"""From a scene to the library's arguments, and from its answers to comparisons that raise."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from hypothesis import settings
from torch import Tensor

from lsmgeo import CameraTensors, VoxelGrid, functional
from tests import oracle, tolerances
from tests.strategies import Array, Scene

DTYPES = (torch.float64, torch.float32)

# For laws that repeat another one in a second form, or whose examples are large.
FEWER = settings(max_examples=max(10, settings.default.max_examples // 4))

NEAR = 1e-6


class Inputs(NamedTuple):
    features: Tensor
    cameras: CameraTensors
    grid: VoxelGrid


class Geometry(NamedTuple):
    """Where sites fall in the feature maps by the oracle, and how far an implementation may be off."""

    pixels: Array  # (B, V, N, 2)
    depth: Array  # (B, V, N)
    pixel_error: Array  # (B, V, N)
    depth_error: Array  # (B, V, N)
    direction_error: Array  # (B, V, N)


def camera_dtype(dtype: torch.dtype) -> torch.dtype:
    return tolerances.arithmetic(dtype)


def cameras(scene: Scene, dtype: torch.dtype = torch.float64) -> CameraTensors:
    """The scene's cameras with leading shape (B, V)."""
    kind = camera_dtype(dtype)
    extrinsics = np.tile(np.eye(4), (scene.batch, scene.views, 1, 1))
    extrinsics[..., :3, :3], extrinsics[..., :3, 3] = scene.rotations, scene.translations
    sizes = torch.from_numpy(scene.image_sizes)
    return CameraTensors(
        torch.from_numpy(scene.intrinsics).to(kind), torch.from_numpy(extrinsics).to(kind), sizes[..., 0], sizes[..., 1]
    )


def grid(scene: Scene) -> VoxelGrid:
    return VoxelGrid(scene.shape, tuple(scene.lower), tuple(scene.upper), torch.from_numpy(scene.pose))


def inputs(scene: Scene, dtype: torch.dtype = torch.float64) -> Inputs:
    return Inputs(torch.from_numpy(scene.features).to(dtype), cameras(scene, dtype), grid(scene))


def unproject(scene: Scene, dtype: torch.dtype = torch.float64, features: Array | None = None, **options: Any) -> Any:
    """``functional.unproject`` as arrays (B, V, C, N) and (B, V, N)."""
    given = inputs(scene, dtype)
    if features is not None:
        given = given._replace(features=torch.from_numpy(features).to(dtype))
    volume, visible = functional.unproject(*given, **options)
    return array(volume.flatten(3)), visible.flatten(2).numpy()


def expected_unproject(scene: Scene, features: Array | None = None, **options: Any) -> Any:
    """The same by the oracle."""
    features = scene.features if features is None else features
    if isinstance(options.get("view_mask"), Tensor):
        options["view_mask"] = options["view_mask"].numpy()
    return oracle.unproject(
        features, scene.intrinsics, scene.rotations, scene.translations, scene.image_sizes, scene.sites, **options
    )


def array(tensor: Tensor) -> Array:
    return tensor.detach().double().numpy()


def feature_intrinsics(scene: Scene, size: tuple[int, int] | None = None) -> Array:
    """The intrinsics of the feature maps, (B, V, 3, 3)."""
    matrices = np.empty_like(scene.intrinsics)
    for b, v in np.ndindex(scene.batch, scene.views):
        image_size = tuple(scene.image_sizes[b, v])
        matrices[b, v] = oracle.resize_intrinsics(scene.intrinsics[b, v], image_size, size or scene.size)
    return matrices


def geometry(scene: Scene, dtype: torch.dtype, sites: Array | None = None) -> Geometry:
    """Where the sites fall, with the error bounds of :mod:`tests.tolerances`."""
    sites = scene.sites if sites is None else sites
    intrinsics = feature_intrinsics(scene)
    seen = [
        [
            oracle.project(intrinsics[b, v], scene.rotations[b, v], scene.translations[b, v], sites[b])
            for v in range(scene.views)
        ]
        for b in range(scene.batch)
    ]
    pixels = np.array([[pixel for pixel, _ in row] for row in seen])
    depth = np.array([[z for _, z in row] for row in seen])
    extent = np.linalg.norm(sites.max(axis=1) - sites.min(axis=1), axis=-1) + np.linalg.norm(sites, axis=-1).max(axis=1)
    offset = np.linalg.norm(scene.translations, axis=-1)
    magnitude = (np.linalg.norm(sites, axis=-1) + extent[:, None])[:, None] + offset[..., None]
    norm = np.abs(intrinsics[..., :2, :]).sum(-1).max(-1)[..., None]
    centers = -(scene.rotations.swapaxes(-1, -2) @ scene.translations[..., None])[..., 0]
    distance = np.linalg.norm(sites[:, None] - centers[:, :, None], axis=-1)
    depth_error = tolerances.length_error(dtype, magnitude)
    with np.errstate(divide="ignore"):
        direction_error = np.minimum(4.0 * depth_error / distance, 2.0) + tolerances.length_error(dtype, 1.0)
    return Geometry(
        pixels, depth, tolerances.coordinate_error(dtype, norm, magnitude, depth, pixels), depth_error, direction_error
    )


def is_certain(geometry: Geometry, size: tuple[int, int], near: float = NEAR) -> npt.NDArray[np.bool_]:
    """Sites (B, V, N) whose visibility rounding cannot change."""
    in_front = geometry.depth - near
    limits = np.array([size[1] - 0.5, size[0] - 0.5])
    with np.errstate(invalid="ignore"):
        edge = np.minimum(np.abs(geometry.pixels + 0.5), np.abs(geometry.pixels - limits)).min(axis=-1)
        clear = edge > geometry.pixel_error
    return (np.abs(in_front) > geometry.depth_error) & (clear | (in_front < 0))


def is_off_cell_border(geometry: Geometry) -> npt.NDArray[np.bool_]:
    """Sites (B, V, N) whose nearest pixel rounding cannot change."""
    with np.errstate(invalid="ignore"):
        fraction = geometry.pixels + 0.5
        return np.abs(fraction - np.round(fraction)).min(axis=-1) > geometry.pixel_error


def assert_within(actual: Array, expected: Array, bound: Array | float) -> None:
    """Finite, of the same shape, and nowhere further apart than ``bound``."""
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    assert np.isfinite(actual).all(), "not finite"
    bound = np.broadcast_to(np.asarray(bound, dtype=np.float64), actual.shape)
    np.testing.assert_array_less(np.abs(actual - expected), bound + np.finfo(np.float64).tiny)


def assert_known(actual: Tensor, expected: Tensor) -> None:
    """Equal to a few roundings of the largest value: a sample on a pixel centre may be read an ulp beside it."""
    largest = float(expected.abs().max())
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerances.termwise(actual.dtype, largest))


def assert_same(actual: Tensor, expected: Tensor) -> None:
    """Equal bit by bit, NaN equal to NaN."""
    torch.testing.assert_close(actual, expected, rtol=0, atol=0, equal_nan=True)
