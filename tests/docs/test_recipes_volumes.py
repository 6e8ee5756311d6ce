"""The recipes of bird's-eye view, volumes and features at points against their formulas, written out site by site."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from lsmgeo import VoxelGrid
from tests import oracle
from tests.kernels import cases

ROOT = Path(__file__).resolve().parents[2]
PATH = ROOT / "examples" / "recipes_volumes.py"
SPEC = importlib.util.spec_from_file_location("recipes_volumes", PATH)
recipes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(recipes)

CAMERAS = cases.VIEWS.to(torch.float64)
U, _, W = torch.linalg.svd(CAMERAS.cam_from_world[..., :3, :3])
CAMERAS.cam_from_world[..., :3, :3] = U @ W  # exact rotations: float32's are not their own inverses
K, E = CAMERAS.intrinsics.numpy(), CAMERAS.cam_from_world.numpy()
R, T = E[..., :3, :3], E[..., :3, 3]
IMAGE = (12, 15)
FEATURES = cases.FEATURES.double()  # (2, 3, 5, 7, 10)
SIZE = tuple(FEATURES.shape[-2:])
B, V, C = FEATURES.shape[:3]
GRID = VoxelGrid((4, 3, 6), (-0.6, -0.5, -0.7), (0.5, 0.45, 0.65), cases.POSE.double())
SITES = GRID.centers().reshape(-1, 3).numpy()
DEPTHS = torch.linspace(0.9, 2.4, 8, dtype=torch.float64)
GENERATOR = torch.Generator().manual_seed(5)


def random(*shape):
    return torch.rand(*shape, dtype=torch.float64, generator=GENERATOR)


LOGITS = 4 * random(B, V, len(DEPTHS), *SIZE)


def sampled(points, **options):
    """The features (B, V, C, N) at points (N, 3) or (B, N, 3), and which view sees which."""
    sizes = np.full((B, V, 2), IMAGE)
    points = np.broadcast_to(points, (B, *points.shape[-2:]))
    return oracle.unproject(FEATURES.numpy(), K, R, T, sizes, points, **options)


def mean_of_visible(values, visible):
    """(B, C, N): site by site, the mean over the views that see it."""
    found = np.zeros((B, values.shape[2], values.shape[3]))
    for b, n in np.ndindex(B, values.shape[3]):
        if visible[b, :, n].any():
            found[b, :, n] = values[b, visible[b, :, n], :, n].mean(0)
    return found


def close(found, expected):
    np.testing.assert_allclose(found.numpy().reshape(expected.shape), expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-3


def read_by_rounding(points):
    """Atlas and ImVoxelNet by hand: K scaled by w / W, the rounded pixel. The sum of the views, and their number."""
    total, count = np.zeros((B, C, len(points))), np.zeros((B, len(points)))
    scale = np.diag([SIZE[1] / IMAGE[1], SIZE[0] / IMAGE[0], 1.0])
    for b, v, n in np.ndindex(B, V, len(points)):
        x, y, z = scale @ K[b, v] @ (R[b, v] @ points[n] + T[b, v])
        column, row = round(x / z), round(y / z)
        if z > 0 and 0 <= column < SIZE[1] and 0 <= row < SIZE[0]:
            total[b, :, n] += FEATURES[b, v, :, row, column].numpy()
            count[b, n] += 1
    return total, count


def scaled_cameras():
    return recipes.scaled(CAMERAS, SIZE[1] / IMAGE[1], SIZE[0] / IMAGE[0], SIZE)


def pooled(sites, to_cell):
    """Lift-Splat by hand, (B, D C, H, W); `sites` (b, v) gives points (P h w, 3), `to_cell` the cell x, y, z of one."""
    weights = LOGITS.softmax(2).numpy()
    found = np.zeros((B, GRID.shape[0], C, *GRID.shape[1:]))
    for b, v in np.ndindex(B, V):
        for n, point in enumerate(sites(b, v)):
            k, j, i = np.unravel_index(n, weights.shape[2:])
            x, y, z = to_cell(point)
            if 0 <= x < found.shape[4] and 0 <= y < found.shape[3] and 0 <= z < found.shape[1]:
                found[b, z, :, y, x] += weights[b, v, k, j, i] * FEATURES[b, v, :, j, i].numpy()
    return found.reshape(B, -1, *GRID.shape[1:])


def test_lift_splat():
    inverse = np.linalg.inv(GRID.world_from_lattice.numpy())
    found = recipes.lift_splat(FEATURES, LOGITS, CAMERAS, GRID, DEPTHS)
    expected = pooled(
        lambda b, v: oracle.frustum_sites((K[b, v], R[b, v], T[b, v]), IMAGE, DEPTHS.numpy(), SIZE).reshape(-1, 3),
        lambda point: np.floor(inverse[:3] @ (*point, 1.0) + 0.5).astype(int),
    )
    assert found.shape == expected.shape
    close(found, expected)


def test_lift_splat_as_published():
    grid = VoxelGrid(GRID.shape, GRID.lower, GRID.upper)
    lower, step = np.array(grid.lower), (np.array(grid.upper) - grid.lower) / grid.shape[::-1]

    def sites(b, v):
        rows, columns = np.linspace(0, IMAGE[0] - 1, SIZE[0]), np.linspace(0, IMAGE[1] - 1, SIZE[1])
        pixels = np.array([(u, v) for v in rows for u in columns])
        return np.concatenate([oracle.backproject(K[b, v], R[b, v], T[b, v], pixels, np.full(70, d)) for d in DEPTHS])

    cameras = CAMERAS._replace(height=IMAGE[0], width=IMAGE[1])
    found = recipes.lift_splat_as_published(FEATURES, LOGITS, cameras, grid, DEPTHS)
    expected = pooled(sites, lambda point: np.trunc((point - lower) / step).astype(int))
    close(found, expected)
    rounded_down = pooled(sites, lambda point: np.floor((point - lower) / step).astype(int))
    assert np.abs(rounded_down - expected).max() > 0.1


def test_bevformer_attention():
    samples, (D, H, W) = 3, GRID.shape
    offsets, weights = 4 * random(B, len(SITES), samples, 2) - 2, random(B, len(SITES), samples)
    expected = np.zeros((B, C, H * W))
    for b, column in np.ndindex(B, H * W):
        hits = 0
        for v in range(V):
            pixels, depth = oracle.project(
                oracle.resize_intrinsics(K[b, v], IMAGE, SIZE), R[b, v], T[b, v], SITES[column :: H * W]
            )
            if not ((depth > 0) & oracle.is_in_image(pixels, SIZE)).any():
                continue
            hits += 1
            for k in range(D):
                if depth[k] > 0:
                    n = k * H * W + column
                    read = oracle.sample(FEATURES[b, v].numpy(), pixels[k] + offsets[b, n].numpy())
                    expected[b, :, column] += read @ weights[b, n].numpy()
        expected[b, :, column] /= max(hits, 1)
    close(recipes.bevformer_attention(FEATURES, CAMERAS, GRID, offsets, weights), expected)


def test_simple_bev():
    expected = mean_of_visible(*sampled(SITES, padding_mode="border")).reshape(B, C * GRID.shape[0], *GRID.shape[1:])
    found = recipes.simple_bev(FEATURES, CAMERAS, GRID)
    assert found.shape == expected.shape
    close(found, expected)


def test_imvoxelnet_volume():
    values, visible = sampled(SITES, mode="nearest")
    volume, known = recipes.imvoxelnet_volume(FEATURES, CAMERAS, GRID)
    close(volume, mean_of_visible(values, visible))
    np.testing.assert_array_equal(known.numpy().reshape(B, -1), visible.any(1))
    assert not known.all()


def test_imvoxelnet_as_published():
    """Points at the lower corners of the voxels, K without half pixels."""
    shape, lower, upper = (4, 3, 6), np.array((-0.6, -0.5, -0.7)), np.array((0.5, 0.45, 0.65))
    step = (upper - lower) / shape[::-1]
    z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    total, count = read_by_rounding((lower + step * np.stack((x, y, z), -1)).reshape(-1, 3))
    grid = VoxelGrid(shape, lower - step / 2, upper - step / 2)
    volume, known = recipes.imvoxelnet_volume(FEATURES, scaled_cameras(), grid)
    close(volume, total / np.maximum(count, 1)[:, None])
    np.testing.assert_array_equal(known.numpy().reshape(B, -1), count > 0)


@pytest.mark.parametrize("parts", [(1, 1, 1), (2, 1)])
def test_atlas_update(parts):
    mean, count = torch.zeros(B, C, *GRID.shape, dtype=torch.float64), torch.zeros(B, 1, *GRID.shape, dtype=torch.long)
    cameras = scaled_cameras()  # as published
    for features, first, number in zip(FEATURES.split(parts, 1), np.cumsum((0, *parts)), parts, strict=False):
        part = cameras.at((slice(None), slice(int(first), int(first) + number)))
        mean, count = recipes.atlas_update(mean, count, features, part, GRID)
    total, number = read_by_rounding(SITES)
    close(mean, total / np.maximum(number, 1)[:, None])
    np.testing.assert_array_equal(count.numpy().reshape(B, -1), number)
    assert set(np.unique(number)) >= {0, 1, 2}


def test_neuralrecon_points():
    points = 1.3 * random(B, 40, 3) - 0.65
    values, visible = sampled(points.numpy(), padding_mode="border", augment=("depth",))
    mean = mean_of_visible(values, visible)
    for b in range(B):
        seen = visible[b].any(0)
        assert 0 < seen.sum() < 40
        depth = mean[b, -1, seen] - mean[b, -1, seen].mean()
        mean[b, -1, seen] = depth / (np.linalg.norm(depth) + 1e-5)
    found, count = recipes.neuralrecon_points(FEATURES, CAMERAS, points)
    close(found, mean)
    np.testing.assert_array_equal(count.numpy(), visible.sum(1))


def test_pixelnerf_inputs():
    points, directions = 1.3 * random(B, 20, 3) - 0.65, torch.nn.functional.normalize(random(B, 20, 3) - 0.5, dim=-1)
    expected = np.zeros((B, V, C + 6, 20))
    expected[:, :, :C] = sampled(points.numpy(), padding_mode="border").values
    for b, v, n in np.ndindex(B, V, 20):
        expected[b, v, C : C + 3, n] = R[b, v] @ points[b, n].numpy() + T[b, v]
        expected[b, v, C + 3 :, n] = R[b, v] @ directions[b, n].numpy()
    close(recipes.pixelnerf_inputs(FEATURES, CAMERAS, points, directions), expected)


def test_mvsnerf_inputs():
    size, inverse = (5, 6), 1 / DEPTHS.numpy()
    volume, points = random(B, 4, len(DEPTHS), *size), 1.3 * random(B, 30, 3) - 0.65
    expected = np.zeros((B, 4 + V * (C + 1), 30))
    for b, n in np.ndindex(B, 30):
        own = oracle.resize_intrinsics(K[b, 0], IMAGE, size)
        pixel, depth = oracle.project(own, R[b, 0], T[b, 0], points[b, n : n + 1].numpy())
        assert depth > 0
        k = np.clip(np.searchsorted(DEPTHS.numpy(), depth[0]) - 1, 0, len(DEPTHS) - 2)
        plane = k + (1 / depth[0] - inverse[k]) / (inverse[k + 1] - inverse[k])
        expected[b, :4, n] = oracle.sample(volume[b].numpy(), np.array([[*pixel[0], plane]]))[:, 0]
    values, visible = sampled(points.numpy(), padding_mode="border")
    expected[:, 4:] = np.concatenate((values, visible[:, :, None]), 2).reshape(B, -1, 30)
    assert (expected[:, :4] == 0).all(1).any()  # points outside the frustum
    close(recipes.mvsnerf_inputs(volume, FEATURES, CAMERAS, DEPTHS, points), expected)


@pytest.mark.parametrize("advance", [0.1, 1.0])  # with all planes in front, and with some behind
def test_mpi_view(advance):
    size, small = (6, 8), (5, 6)
    mpi = random(B, 4, len(DEPTHS), *small)
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = oracle.rotation(np.array((0.03, -0.05, 0.1))), (0.1, -0.05, -advance)
    reference = CAMERAS.at((slice(None), 0))
    target = reference._replace(cam_from_world=torch.from_numpy(turned @ E[:, 0]))
    expected, behind = np.zeros((B, 3, size[0] * size[1])), False
    for b in range(B):
        first = (oracle.resize_intrinsics(K[b, 0], IMAGE, small), R[b, 0], T[b, 0])
        moved = turned @ E[b, 0]
        second = (oracle.resize_intrinsics(K[b, 0], IMAGE, size), moved[:3, :3], moved[:3, 3])
        for k in reversed(range(len(DEPTHS))):  # back to front
            to_first = np.linalg.inv(oracle.homography(first, second, float(DEPTHS[k])))
            u, v, w = to_first @ np.c_[oracle.pixel_lattice(size), np.ones(48)].T
            sites = oracle.backproject(*first, np.stack((u / w, v / w), -1), np.full(48, float(DEPTHS[k])))
            front = oracle.project(*second, sites)[1] > 0
            behind |= not front.all()
            red_green_blue_alpha = oracle.sample(mpi[b, :, k].numpy(), np.stack((u / w, v / w), -1))
            alpha = red_green_blue_alpha[3] * front
            expected[b] = alpha * red_green_blue_alpha[:3] + (1 - alpha) * expected[b]
    assert behind == (advance > 0.5)
    close(recipes.mpi_view(mpi, reference, DEPTHS, target, size), expected)


def test_recipes_are_short_and_shown():
    page = (ROOT / "docs" / "recipes_volumes.rst").read_text(encoding="utf-8")
    functions = [node for node in ast.parse(PATH.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)]
    assert len(functions) == 11
    for function in functions:
        first = function.body[1].lineno  # after the docstring
        assert function.end_lineno - first + 1 <= 10, function.name
        assert f":pyobject: {function.name}\n" in page
