"""The recipes against their formulas, written out site by site."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from tests import oracle
from tests.kernels import cases

ROOT = Path(__file__).resolve().parents[2]
PATH = ROOT / "examples" / "recipes.py"
SPEC = importlib.util.spec_from_file_location("recipes", PATH)
recipes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(recipes)

CAMERAS = cases.VIEWS.to(torch.float64)
U, _, W = torch.linalg.svd(CAMERAS.cam_from_world[..., :3, :3])
CAMERAS.cam_from_world[..., :3, :3] = U @ W  # exact rotations: float32's are not their own inverses
FEATURES = torch.cat((cases.FEATURES, 0.3 * cases.FEATURES[:, :, :1]), 2).double()  # (2, 3, 6, 7, 10)
SIZE = FEATURES.shape[-2:]
DEPTHS = torch.tensor([0.8, 1.4, 2.2], dtype=torch.float64)
B, V, C = FEATURES.shape[:3]


def warped(depths, padding_mode="zeros"):
    """All views (B, V, C, P, h, w) at the reference's pixels and depths (B, P, h, w), depth, and visibility."""
    depths = np.broadcast_to(depths, (B, depths.shape[-3], *SIZE))
    K, E = CAMERAS.intrinsics.numpy(), CAMERAS.cam_from_world.numpy()
    R, t = E[..., :3, :3], E[..., :3, 3]
    sizes = np.full((B, V, 2), (12, 15))
    points = []
    for b in range(B):
        own = oracle.resize_intrinsics(K[b, 0], (12, 15), tuple(SIZE))
        pixels = np.tile(oracle.pixel_lattice(tuple(SIZE)), (depths.shape[1], 1))
        points.append(oracle.backproject(own, R[b, 0], t[b, 0], pixels, depths[b].reshape(-1)))
    values, visible = oracle.unproject(
        FEATURES.numpy(), K, R, t, sizes, np.stack(points), padding_mode=padding_mode, augment=("depth", "direction")
    )
    shape = (depths.shape[1], *SIZE)
    return values.reshape(B, V, C + 4, *shape), visible.reshape(B, V, *shape)


def planes():
    return np.broadcast_to(DEPTHS.numpy()[:, None, None], (len(DEPTHS), *SIZE))


def variance(values, visible):
    found = np.zeros((B, *values.shape[2:]))
    for b, k, j, i in np.ndindex(B, *values.shape[3:]):
        seen = values[b, visible[b, :, k, j, i], :, k, j, i]
        if len(seen):
            found[b, :, k, j, i] = ((seen - seen.mean(0)) ** 2).mean(0)
    return found


def correlation(values, groups):
    """(B, V - 1, groups, P, h, w) of the source views with the reference's own pixels."""
    own = FEATURES[:, 0].numpy()
    found = np.zeros((B, V - 1, groups, *values.shape[3:]))
    size = C // groups
    for b, v, g in np.ndindex(B, V - 1, groups):
        part = slice(g * size, (g + 1) * size)
        found[b, v, g] = (own[b, part, None] * values[b, 1 + v, part]).mean(0)
    return found


def close(found, expected):
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-3


def test_mvsnet_variance():
    values, visible = warped(planes(), "border")
    volume, known = recipes.mvsnet_variance(FEATURES, CAMERAS, DEPTHS)
    close(volume, variance(values[:, :, :C], visible))
    np.testing.assert_array_equal(known.numpy(), visible.sum(1) >= 2)
    single = visible.sum(1) == 1
    assert single.any()
    assert not volume.numpy()[np.broadcast_to(single[:, None], volume.shape)].any()


def test_casmvsnet_stage():
    coarse = 1.4 + 0.3 * torch.rand(B, *SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    hypotheses, volume, known = recipes.casmvsnet_stage(FEATURES, CAMERAS, coarse, 0.1, 4)
    expected = coarse.numpy()[:, None] + 0.1 * np.array([-1.5, -0.5, 0.5, 1.5])[:, None, None]
    close(hypotheses, expected)
    values, visible = warped(expected, "border")
    close(volume, variance(values[:, :, :C], visible))
    np.testing.assert_array_equal(known.numpy(), visible.sum(1) >= 2)
    assert 0 < known.float().mean() < 1


def test_patchmatchnet_step():
    generator = torch.Generator().manual_seed(1)
    depth = 1.0 + torch.rand(B, *SIZE, dtype=torch.float64, generator=generator)
    weights = 0.1 + torch.rand(B, V - 1, *SIZE, dtype=torch.float64, generator=generator)
    hypotheses, match = recipes.patchmatchnet_step(FEATURES, CAMERAS, depth, weights, 3)
    assert hypotheses.shape == (B, 5, *SIZE)
    assert bool((hypotheses.diff(dim=1) < 0).any())  # in no order
    np.testing.assert_array_equal(hypotheses[:, 1, 1:].numpy(), depth[:, :-1].numpy())
    np.testing.assert_array_equal(hypotheses[:, 4, :, :-1].numpy(), depth[..., 1:].numpy())
    np.testing.assert_array_equal(hypotheses[:, 4, :, -1].numpy(), depth[..., -1].numpy())  # at the border its own
    values, visible = warped(hypotheses.numpy())
    share = weights.numpy()[:, :, None] * visible[:, 1:]
    share = share / np.maximum(share.sum(1, keepdims=True), 1e-6)
    close(match, (correlation(values[:, :, :C], 3) * share[:, :, None]).sum(1))


@pytest.mark.parametrize("groups", [1, 2, 6])
def test_groupwise_correlation(groups):
    values, visible = warped(planes(), "border")
    each = correlation(values[:, :, :C], groups) * visible[:, 1:, None]
    expected = each.sum(1) / np.maximum(visible[:, 1:].sum(1), 1)[:, None]
    close(recipes.groupwise_correlation(FEATURES, CAMERAS, DEPTHS, groups), expected)


def test_simplerecon_volume():
    values, visible = warped(planes())
    volume = recipes.simplerecon_volume(FEATURES, CAMERAS, DEPTHS).numpy()
    E = CAMERAS.cam_from_world.numpy()
    centers = -np.einsum("bvji,bvj->bvi", E[..., :3, :3], E[..., :3, 3])
    cosine = (values[:, :1, C + 1 :] * values[:, 1:, C + 1 :]).sum(2)
    expected = [
        correlation(values[:, :, :C], 1)[:, :, 0],
        values[:, 1:, C],
        *np.moveaxis(values[:, 1:, C + 1 :], 2, 0),
        np.arccos(np.clip(cosine, -1 + 1e-6, 1 - 1e-6)),
        visible[:, 1:],
        np.broadcast_to(np.linalg.norm(centers[:, 1:] - centers[:, :1], axis=-1)[:, :, None, None, None], cosine.shape),
    ]
    np.testing.assert_allclose(volume, np.stack(expected, 2), atol=1e-6)


def test_the_angle_between_equal_rays_has_a_finite_gradient():
    same = CAMERAS.at((slice(None), [0, 0])).to(torch.float32)
    moved = same.cam_from_world.clone().requires_grad_()
    volume = recipes.simplerecon_volume(FEATURES[:, :2].float(), same._replace(cam_from_world=moved), DEPTHS)
    assert float(volume.detach()[:, :, 5].min()) > 1e-3  # at 0 its derivative is infinite
    (gradient,) = torch.autograd.grad(volume[:, :, :6].sum(), moved)
    assert bool(gradient.isfinite().all())


def test_recipes_are_short_and_shown():
    page = (ROOT / "docs" / "recipes.rst").read_text(encoding="utf-8")
    functions = [node for node in ast.parse(PATH.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)]
    assert len(functions) == 5
    for function in functions:
        first = function.body[1].lineno  # after the docstring
        assert function.end_lineno - first + 1 <= 10, function.name
        assert f":pyobject: {function.name}\n" in page
