"""Frustum grids: backprojection, the identity of a view on its own frustum, plane-induced homographies (P01, P24)."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import CameraTensors, FrustumGrid, functional
from tests import oracle, tolerances
from tests.property import support
from tests.property.test_unproject import pixel_ramp
from tests.strategies import scenes

SIZE = (3, 5)


def frustum(scene, depths, size=SIZE, view=0, dtype=torch.float64):
    """The frustum of one view of each scene."""
    cameras = support.cameras(scene, dtype)
    return FrustumGrid(CameraTensors(*(field[:, view] for field in cameras)), torch.from_numpy(depths).to(dtype), size)


def frustum_depths(scene, planes=3):
    """(B, P), different for each scene."""
    return (0.5 + np.arange(planes) + 0.25 * np.arange(scene.batch)[:, None]) * (1 + scene.seed % 3)


@given(scenes(placements=("facing", "grazing", "inside")), st.booleans())
def test_sites_are_backprojected_pixels(scene, shared):
    depths = frustum_depths(scene)
    grid = frustum(scene, depths[0] if shared else depths)
    expected = np.stack(
        [
            oracle.frustum_sites(
                (scene.intrinsics[b, 0], scene.rotations[b, 0], scene.translations[b, 0]),
                tuple(scene.image_sizes[b, 0]), depths[0 if shared else b], SIZE,
            )
            for b in range(scene.batch)
        ]
    )  # fmt: skip
    assert grid.shape == (3, *SIZE)
    support.assert_within(support.array(grid.centers()), expected, 1e-8)
    T, inverse = support.array(grid.world_from_lattice), support.array(grid.lattice_from_world)
    k, j, i = 1, 2, 4
    d = depths[0] if shared else depths[:, k]
    d = np.broadcast_to(depths[0, k] if shared else d, scene.batch)
    q = np.stack([np.full_like(d, i), np.full_like(d, j), 1 / d, np.ones_like(d)], axis=-1)
    world = np.einsum("bij,bj->bi", T, q)
    support.assert_within(world[:, :3] / world[:, 3:], expected[:, k, j, i], 1e-8)
    back = np.einsum("bij,bj->bi", inverse, world)
    support.assert_within(back / back[:, 3:], q, 1e-8)


@given(scenes(placements=("facing", "grazing", "inside"), least=7))
def test_view_reads_its_own_pixels_on_its_own_frustum(scene):
    """P01: projecting a backprojected pixel gives the pixel and the depth, at all depths."""
    for dtype in support.DTYPES:
        exact = scene.rounded(dtype)
        depths = frustum_depths(exact)
        features = torch.from_numpy(pixel_ramp(exact)).to(dtype)
        grid = frustum(exact, depths, scene.size, view=scene.views - 1, dtype=support.camera_dtype(dtype))
        volume, visible = functional.unproject(
            features, support.cameras(exact, dtype), grid, padding_mode="border", augment=("depth",)
        )
        values = support.array(volume[:, -1])
        expected = np.empty_like(values)
        expected[:, :2] = pixel_ramp(exact)[:, -1, :, None]
        expected[:, 2] = depths[..., None, None]
        magnitude = 1.0 + np.linalg.norm(exact.translations[:, -1], axis=-1)[:, None] / depths
        norm = np.abs(support.feature_intrinsics(exact)[:, -1]).sum(-1).max(-1)
        bound = tolerances.length_error(dtype, 8 * (magnitude * norm[:, None] + 16) * np.maximum(depths, 1))
        support.assert_within(values, expected, bound[:, None, :, None, None])
        assert bool(visible[:, -1].all())


@given(scenes(placements=("facing", "grazing"), least=7))
def test_planes_warp_by_their_homography(scene):
    """P24: the frustum plane at depth d of one view, seen by another: H = K' (R + t n^T / d) K^-1."""
    depths = frustum_depths(scene)
    features = torch.from_numpy(pixel_ramp(scene))
    volume, _ = functional.unproject(features, support.cameras(scene), frustum(scene, depths), padding_mode="border")
    values = support.array(volume[:, -1])
    to_size, own = support.feature_intrinsics(scene, SIZE), support.feature_intrinsics(scene)
    pixels = np.concatenate([oracle.pixel_lattice(SIZE), np.ones((SIZE[0] * SIZE[1], 1))], 1)
    last = np.array([scene.size[1] - 1, scene.size[0] - 1])
    for b, k in np.ndindex(scene.batch, depths.shape[1]):
        reference = to_size[b, 0], scene.rotations[b, 0], scene.translations[b, 0]
        source = own[b, -1], scene.rotations[b, -1], scene.translations[b, -1]
        warped = oracle.homography(reference, source, depths[b, k]) @ pixels.T
        front = warped[2] > 1e-3
        expected = np.clip((warped[:2] / np.where(front, warped[2], 1.0)).T, 0, last)
        actual = values[b, :, k].reshape(2, -1).T
        support.assert_within(actual[front], expected[front], 1e-7)
        np.testing.assert_array_equal(actual[warped[2] < -1e-9], 0.0)


def test_frustum_of_a_plain_camera_is_known():
    camera = CameraTensors(torch.eye(3), torch.eye(4), torch.tensor(2), torch.tensor(3))
    grid = FrustumGrid(camera, torch.tensor([1.0, 4.0]))
    assert grid.shape == (2, 2, 3)
    torch.testing.assert_close(grid.centers()[1, 1], torch.tensor([[0.0, 4.0, 4.0], [4.0, 4.0, 4.0], [8.0, 4.0, 4.0]]))
