"""Small shapes of random blobs, as plain arrays and as samples: what a shard must give back, known beforehand."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Sample, encode_sample, hash_settings, write_shard

STEP = 5e-5
SETTINGS = hash_settings({"made": "by a test"})


class Shape(NamedTuple):
    """The exact contents of a shard's members."""

    name: str
    category: str
    split: str
    pixels: np.ndarray  # (V, H, W, 3) uint8, 0 off the object
    mask: np.ndarray  # (V, H, W) bool
    steps: np.ndarray  # (V, H, W) uint16
    K: np.ndarray  # (V, 3, 3)
    E: np.ndarray  # (V, 4, 4)
    grids: dict[int, np.ndarray]  # (n, n, n) bool

    def sample(self) -> Sample:
        height, width = self.mask.shape[1:]
        sizes = (torch.full((len(self.mask),), side) for side in (height, width))
        return Sample(
            torch.from_numpy(self.pixels / np.float32(255)).permute(0, 3, 1, 2).contiguous(),
            CameraTensors(torch.from_numpy(self.K), torch.from_numpy(self.E), *sizes),
            torch.from_numpy((self.steps * STEP).astype(np.float32)),
            torch.from_numpy(self.mask),
            torch.from_numpy(self.grids[min(self.grids)]),
            f"meshes/{self.name}.obj",
            self.category,
            self.name,
        )

    def members(self, key: int) -> dict[str, bytes]:
        more = [torch.from_numpy(grid) for side, grid in self.grids.items() if side != min(self.grids)]
        return encode_sample(
            self.sample(), key, depth_step=STEP, more_occupancy=more, source="test", seed=key, split=self.split
        )


def make_shape(number: int, views: int = 3, height: int = 12, width: int = 16, sides: tuple[int, ...] = (8, 16)):
    """Ellipses of random colours and depths before nothing."""
    rng = np.random.default_rng(number)
    v, u = np.mgrid[:height, :width]
    pixels = np.zeros((views, height, width, 3), np.uint8)
    steps = np.zeros((views, height, width), np.uint16)
    K, E = np.zeros((views, 3, 3)), np.tile(np.eye(4), (views, 1, 1))
    for view in range(views):
        for _ in range(3):
            x, y = rng.uniform(0.3, 0.7, 2) * (width, height)
            inside = ((u - x) / (0.3 * width)) ** 2 + ((v - y) / (0.25 * height)) ** 2 < 1
            pixels[view][inside] = rng.integers(0, 256, (int(inside.sum()), 3))
            steps[view][inside] = rng.integers(1, 65536)
        K[view] = [
            [1.5 * width + rng.uniform(), rng.uniform(-1, 1), width / 2],
            [0, 1.5 * width, height / 2],
            [0, 0, 1],
        ]
        E[view, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        E[view, :3, 0] *= np.linalg.det(E[view, :3, :3])
        E[view, :3, 3] = rng.normal(size=3)
    grids = {side: rng.random((side, side, side)) < 0.4 for side in sides}
    category, split = ("chair", "table", "lamp")[number % 3], ("train", "test")[number % 4 == 3]
    return Shape(f"shape-{number}", category, split, pixels, steps > 0, steps, K, E, grids)


def write_set(folder: Path, shards: int = 2, each: int = 3, **options) -> list[Shape]:
    """Write a set of shards; returns its shapes in order."""
    shapes = [make_shape(number, **options) for number in range(shards * each)]
    for shard in range(shards):
        numbers = range(shard * each, (shard + 1) * each)
        items = ((number, shapes[number].members(number)) for number in numbers)
        write_shard(folder / f"set-{shard:06d}.tar", items, SETTINGS)
    return shapes


def assert_equal(sample: Sample, shape: Shape, views, background=(1.0, 1.0, 1.0), side: int | None = 8) -> None:
    """Compare what was read with what was written."""
    views = list(views)
    behind = np.array(background, np.float32)
    expected = np.where(shape.mask[views][..., None], shape.pixels[views] / np.float32(255), behind)
    np.testing.assert_array_equal(sample.images.permute(0, 2, 3, 1).numpy(), expected.astype(np.float32))
    np.testing.assert_array_equal(sample.mask.numpy(), shape.mask[views])
    np.testing.assert_array_equal(sample.cameras.intrinsics.numpy(), shape.K[views].astype(np.float32))
    np.testing.assert_array_equal(sample.cameras.cam_from_world.numpy(), shape.E[views].astype(np.float32))
    height, width = shape.mask.shape[1:]
    assert sample.cameras.height.tolist() == [height] * len(views)
    assert sample.cameras.width.tolist() == [width] * len(views)
    if sample.depth is not None:
        np.testing.assert_allclose(sample.depth.numpy(), shape.steps[views] * STEP, rtol=1e-6, atol=0)
    assert (sample.occupancy is None) == (side is None)
    if side is not None:
        np.testing.assert_array_equal(sample.occupancy.numpy(), shape.grids[side])
    assert (sample.name, sample.category, sample.mesh) == (shape.name, shape.category, f"meshes/{shape.name}.obj")
