"""Scenes that are ugly by default.

Hypothesis draws the structure (sizes, placements, poses, intrinsics); the values of features and volumes come from a
drawn seed, so that shrinking works on geometry. Batch, views, channels and all lattice sizes differ, images are not
square, their size is not that of the feature map, pixels are sheared and anisotropic, voxels too, and cameras stand
inside the grid, behind it, on a site, or see a site exactly on a pixel centre or on the image border.
"""

from __future__ import annotations

import dataclasses
import itertools
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from hypothesis import strategies as st

from tests import oracle

Array = npt.NDArray[np.float64]

IMAGE_TRANSFORMS = np.array(
    [
        *([[1.0, 0.0], [0.0, 1.0]],) * 4,
        *([[-1.0, 0.0], [0.0, 1.0]], [[0.0, -1.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.9, 0.2], [-0.3, 1.1]]),
    ]
)
PLACEMENTS = ("facing", "grazing", "inside", "behind", "on_site", "on_pixel", "on_border")
OUTSIDE = ("facing", "grazing", "on_pixel", "on_border")


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Cameras (B, V), one voxel grid, and seeded values to sample. Everything is NumPy float64."""

    intrinsics: Array  # (B, V, 3, 3), of the images
    rotations: Array  # (B, V, 3, 3)
    translations: Array  # (B, V, 3)
    image_sizes: npt.NDArray[np.int64]  # (B, V, 2) as (H, W)
    shape: tuple[int, int, int]  # (D, H, W)
    lower: Array  # (3,)
    upper: Array  # (3,)
    pose: Array  # (B, 4, 4), world_from_grid
    size: tuple[int, int]  # (h, w) of the feature maps
    channels: int
    seed: int
    placements: tuple[str, ...]

    @property
    def batch(self) -> int:
        return self.intrinsics.shape[0]

    @property
    def views(self) -> int:
        return self.intrinsics.shape[1]

    @cached_property
    def features(self) -> Array:
        """Random feature maps (B, V, C, h, w) in [-1, 1], exact in float32."""
        values = np.random.default_rng(self.seed).uniform(-1, 1, (self.batch, self.views, self.channels, *self.size))
        return values.astype(np.float32).astype(np.float64)

    @cached_property
    def volume(self) -> Array:
        """Random volume (B, C, D, H, W) in [-1, 1], exact in float32."""
        values = np.random.default_rng(self.seed + 1).uniform(-1, 1, (self.batch, self.channels, *self.shape))
        return values.astype(np.float32).astype(np.float64)

    @cached_property
    def view_mask(self) -> npt.NDArray[np.bool_]:
        """A ragged mask (B, V)."""
        return np.random.default_rng(self.seed + 2).uniform(size=(self.batch, self.views)) < 0.6

    @cached_property
    def sites(self) -> Array:
        """World centres of the voxels (B, N, 3), x fastest."""
        grids = [oracle.voxel_sites(self.shape, self.lower, self.upper, pose) for pose in self.pose]
        return np.stack(grids).reshape(self.batch, -1, 3)

    @cached_property
    def lattice(self) -> Array:
        """``world_from_lattice`` (B, 4, 4)."""
        return np.stack([oracle.world_from_lattice(self.shape, self.lower, self.upper, pose) for pose in self.pose])

    def rounded(self, dtype: torch.dtype) -> Scene:
        """The scene whose cameras are exact in ``dtype``."""
        if dtype == torch.float64:
            return self
        arrays = (self.intrinsics, self.rotations, self.translations)
        intrinsics, rotations, translations = (a.astype(np.float32).astype(np.float64) for a in arrays)
        return dataclasses.replace(self, intrinsics=intrinsics, rotations=rotations, translations=translations)

    def replace(self, **changes: object) -> Scene:
        return dataclasses.replace(self, **changes)


def _unit_interval(drawn: bytes) -> Array:
    """Numbers in [0, 1] from bytes, which Hypothesis draws ten times faster than floats one by one."""
    return np.frombuffer(drawn, dtype=np.uint8) / 255.0


_SHAPES = [shape for shape in itertools.permutations((4, 5, 6, 2, 1), 3) if 10 <= np.prod(shape) <= 120]
_SIZES = list(itertools.permutations((9, 7, 12, 1), 2))
_BATCH_VIEWS_CHANNELS = ((2, 3, 1), (1, 2, 3), (3, 2, 1), (2, 1, 3), (1, 3, 2), (2, 3, 4), (3, 2, 4))


def _rotations_about(axis_angles: Array) -> Array:
    """Rotation matrices (N, 3, 3) from axis times angle (N, 3)."""
    x, y, z = axis_angles.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    angle = np.sqrt(x * x + y * y + z * z)[:, None, None]
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross @ cross


def _cross(a: Array, b: Array) -> Array:
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _normalized(a: Array) -> Array:
    return a / np.sqrt(np.sum(a * a, axis=1, keepdims=True))


def _cameras(
    numbers: Array, kinds: list[str], center: Array, radius: Array, sites: Array, image: Array, size: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """K, R, t of N views from numbers (N, 16) in [0, 1], grid centres (N, 3), radii (N, 1), sites (N, S, 3)."""
    count = len(kinds)
    every = np.arange(count)
    is_kind = {kind: np.array([[k == kind] for k in kinds]) for kind in PLACEMENTS}
    azimuth, elevation = 6.28 * numbers[:, 0], -1.4 + 2.8 * numbers[:, 1]
    out = np.stack([np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)], 1)
    lateral = -1.0 + 2.0 * numbers[:, 2:5]
    chosen = sites[every, (numbers[:, 5] * (sites.shape[1] - 1)).astype(np.int64)]

    eye = center + radius * (1.3 + 2.7 * numbers[:, 6:7]) * out
    eye = np.where(is_kind["inside"], center + 0.4 * radius * lateral, eye)
    eye = np.where(is_kind["on_site"], chosen, eye)
    target = center + 0.2 * radius * lateral
    target = np.where(is_kind["grazing"], center + 1.2 * radius * (lateral + 0.3 * np.sign(lateral)), target)
    target = np.where(is_kind["behind"], 2 * eye - center, target)
    close = is_kind["inside"] | is_kind["on_site"]
    target = np.where(close, center + 0.45 * radius * out, target)

    forward = _normalized(target - eye)
    right = _normalized(_cross(forward, np.array([[0.1, -1.0, 0.2]])))
    upright = np.stack([right, _cross(forward, right), forward], axis=1)
    roll = np.zeros((count, 3))
    roll[:, 2] = -3.1 + 6.2 * numbers[:, 7]
    rotation = _rotations_about(roll) @ upright
    translation = -(rotation @ eye[..., None])[..., 0]

    focal = np.where(close[:, 0], 0.5, 1.0) * (0.6 + 1.4 * numbers[:, 8]) * image[:, 1]
    intrinsics = np.zeros((count, 3, 3))
    intrinsics[:, 0, 0] = focal
    intrinsics[:, 0, 1] = focal * (-0.4 + 0.8 * numbers[:, 9])
    intrinsics[:, 1, 1] = focal * (0.5 + 1.5 * numbers[:, 10])
    # Every other image is flipped, rolled by a quarter turn or sheared, as augmentation leaves it.
    kind = (7.99 * numbers[:, 9]).astype(np.int64)
    intrinsics[:, :2, :2] = IMAGE_TRANSFORMS[kind] @ intrinsics[:, :2, :2]
    intrinsics[:, :2, 2] = (0.2 + 0.6 * numbers[:, 11:13]) * image[:, ::-1]
    intrinsics[:, 2, 2] = 1.0

    # Move the principal point until the chosen site falls exactly where the placement wants it in the feature map.
    shape = np.array(size[::-1], dtype=np.float64)
    wanted = np.floor(0.999 * numbers[:, 13:15] * shape)
    axis = (3.99 * numbers[:, 15]).astype(np.int64) % 2
    edge = np.where(numbers[:, 15] < 0.5, -0.5, shape[axis] - 0.5)
    wanted[every, axis] = np.where(is_kind["on_border"][:, 0], edge, wanted[every, axis])
    seen = (intrinsics @ (rotation @ chosen[..., None] + translation[..., None]))[..., 0]
    moved = is_kind["on_pixel"] | is_kind["on_border"]
    depth = np.where(moved, seen[:, 2:], 1.0)
    shift = (wanted + 0.5) * image[:, ::-1] / shape - 0.5 - seen[:, :2] / depth
    intrinsics[:, :2, 2] += np.where(moved, shift, 0.0)
    return intrinsics, rotation, translation


@st.composite
def scenes(draw: st.DrawFn, placements: tuple[str, ...] = PLACEMENTS, rigid: bool = False, least: int = 1) -> Scene:
    """Scenes whose views stand at ``placements``; ``rigid``: no shear in the grid; ``least``: smallest h and w."""
    batch, views, channels = draw(st.sampled_from(_BATCH_VIEWS_CHANNELS))
    shape = draw(st.sampled_from(_SHAPES))
    size = draw(st.sampled_from([size for size in _SIZES if min(size) >= least]))
    poses = draw(st.sampled_from(("none", "rigid") if rigid else ("none", "rigid", "affine")))
    seed = draw(st.integers(0, 2**20))
    count = batch * views
    drawn = draw(st.binary(min_size=6 + batch * 6 + count * 17, max_size=6 + batch * 6 + count * 17))
    # The view's number is added so that views differ in placement even where Hypothesis draws zeros.
    kinds = tuple(placements[(byte + i) % len(placements)] for i, byte in enumerate(drawn[:count]))
    numbers = _unit_interval(drawn[count:])

    lower, upper = -1.2 + numbers[:3], 0.3 + 1.2 * numbers[3:6]
    pose = np.tile(np.eye(4), (batch, 1, 1))
    per_batch = numbers[6 : 6 + 6 * batch].reshape(batch, 6)
    if poses != "none":
        pose[:, :3, :3] = _rotations_about(-1.8 + 3.6 * per_batch[:, :3])
        pose[:, :3, 3] = -2.0 + 4.0 * per_batch[:, 3:]
    if poses == "affine":
        pose[:, :3, :3] @= np.array([[1.3, 0.2, 0.0], [0.0, 0.8, -0.3], [0.1, 0.0, 1.1]])

    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    local = lower + (index + 0.5) * (upper - lower) / np.array(shape[::-1])
    sites = local @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
    center = pose[:, :3, :3] @ (0.5 * (lower + upper)) + pose[:, :3, 3]
    radius = np.sqrt(((sites - center[:, None]) ** 2).sum(-1)).max(axis=1) + 0.1

    image_sizes = np.array([[(10 + 3 * b + v, 17 - 2 * v + b) for v in range(views)] for b in range(batch)])
    of_view = np.repeat(np.arange(batch), views)
    intrinsics, rotation, translation = _cameras(
        numbers[6 + 6 * batch :].reshape(count, 16), list(kinds), center[of_view], radius[of_view, None],
        sites[of_view], image_sizes.reshape(count, 2), size,
    )  # fmt: skip
    leading = (batch, views)
    return Scene(
        intrinsics.reshape(*leading, 3, 3), rotation.reshape(*leading, 3, 3), translation.reshape(*leading, 3),
        image_sizes, shape, lower, upper, pose, size, channels, seed, kinds,
    )  # fmt: skip


@st.composite
def sweep_depths(draw: st.DrawFn, scene: Scene, planes: tuple[int, ...] = (1, 3, 8)) -> Array:
    """Ascending plane depths (B, V, P) around each camera's distance to the grid, the first plane near the camera."""
    count = draw(st.sampled_from(planes))
    spread = draw(st.integers(1, 10)) / 10.0
    centers = -(scene.rotations.swapaxes(-1, -2) @ scene.translations[..., None])[..., 0]
    distance = np.linalg.norm(scene.sites.mean(axis=1)[:, None] - centers, axis=-1) + 0.3
    steps = np.linspace(1.0 - 0.9 * spread, 1.0 + spread, count) if count > 1 else np.ones(1)
    depths = distance[..., None] * steps
    return depths.astype(np.float32).astype(np.float64)


def rotations() -> st.SearchStrategy[Array]:
    """Rotation matrices of up to 1.8 radians per axis."""
    return vectors(1.8).map(oracle.rotation)


def vectors(scale: float = 2.0) -> st.SearchStrategy[Array]:
    """3-vectors in [-scale, scale]."""
    return st.binary(min_size=3, max_size=3).map(lambda drawn: scale * (2.0 * _unit_interval(drawn) - 1.0))
