"""Analytic scenes against the oracle's ray tracer: hits, depth, normals, silhouettes, occupancy, shadows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lsmgeo import VoxelGrid, scenes
from lsmgeo.cameras import CameraTensors, orbit, resize
from lsmgeo.scenes import rendering
from tests import oracle
from tests.oracle import primitives as truth
from tests.scenes.drawn import KINDS, Drawn, drawn, make

SUN = scenes.Lights(torch.tensor([[0.0, 1.0, 0.0]]), torch.full((1, 3), 0.6), torch.full((3,), 0.3))

# Where two surfaces are closer along a ray than this, rounding decides which is hit.
EDGE = {torch.float64: 1e-9, torch.float32: 1e-4}
# Depth is about 3, and the error of a small ellipsoid's normal is that of the hit over its radius.
DEPTH = {torch.float64: 1e-12, torch.float32: 2e-5}


def compare(found: scenes.Rendering, wanted: Drawn, dtype: torch.dtype) -> None:
    for view in range(wanted.cameras.intrinsics.shape[1]):
        expected, normal, margin = truth.first_hit(wanted.parts, *wanted.rays(view))
        depth = found.depth[0, view].flatten().double().numpy()
        mask = found.mask[0, view].flatten().numpy()
        # Masks are uncertain where the ray's interval inside, or between two parts, is a sliver.
        clear = (margin > EDGE[dtype]) & np.isfinite(expected)
        np.testing.assert_array_equal(mask[clear], True)
        assert not (mask & ~np.isfinite(expected)).sum() > (0 if dtype == torch.float64 else 2)
        np.testing.assert_array_equal(depth[~mask], 0.0)
        np.testing.assert_allclose(depth[clear], expected[clear], rtol=DEPTH[dtype] * 10, atol=0)
        ours = found.normals[0, view].flatten(1).T.double().numpy()
        # Near grazing angles the hit and its normal are ill conditioned.
        error = np.linalg.norm(ours - normal, axis=1)[clear] * np.minimum(margin[clear], 1)
        np.testing.assert_allclose(error, 0, atol=1e-8 if dtype == torch.float64 else 2e-3)


@given(drawn())
def test_renderings_agree_with_the_oracle(wanted):
    found = scenes.render([wanted.scene], wanted.cameras, SUN, dtype=torch.float64)
    compare(found, wanted, torch.float64)
    assert found.depth.dtype == torch.float64


@settings(max_examples=50)
@given(drawn())
def test_single_precision_agrees_away_from_edges(wanted):
    compare(scenes.render([wanted.scene], wanted.cameras, SUN), wanted, torch.float32)


@settings(max_examples=30)
@given(st.lists(drawn(), min_size=1, max_size=3), st.booleans())
def test_views_rendered_together_equal_views_rendered_one_by_one(several, shadows):
    """Accelerators render many views at once, CPUs one by one; the images are the same."""
    batch = CameraTensors(*(torch.cat([torch.as_tensor(one.cameras[i]) for one in several]) for i in range(2)), 15, 20)
    solids = [one.scene for one in several]
    options = {"shadows": shadows, "dtype": torch.float64}
    strengths = torch.linspace(0.2, 0.6, len(several)).view(-1, 1, 1)  # each scene has its own lights
    lights = scenes.Lights(
        SUN.directions.expand(len(several), 1, 3), strengths.expand(-1, 1, 3), strengths[:, 0] * SUN.ambient
    )
    alone = scenes.render(solids, batch, lights, **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "ONE_VIEW_AT_A_TIME", ())
        patch.setattr(rendering, "VIEWS_AT_ONCE", 4)
        together = scenes.render(solids, batch, lights, **options)
    for name, expected in alone._asdict().items():
        torch.testing.assert_close(getattr(together, name), expected, rtol=1e-9, atol=1e-9, msg=name)


@settings(max_examples=50)
@given(drawn())
def test_rays_from_anywhere_agree_with_the_oracle(wanted):
    origins, directions = (np.concatenate([wanted.rays(view)[i] for view in range(2)]) for i in range(2))
    lengths = np.linspace(0.2, 5, len(directions))[:, None]  # the ray parameter is a multiple of the direction
    expected, normal, margin = truth.first_hit(wanted.parts, origins, directions * lengths)
    found = scenes.trace([wanted.scene], torch.tensor(origins)[None], torch.tensor(directions * lengths)[None])
    clear = margin > EDGE[torch.float64]
    np.testing.assert_array_equal(found.hit[0].numpy()[clear], np.isfinite(expected)[clear])
    hit = clear & np.isfinite(expected)
    np.testing.assert_allclose(found.distance[0].numpy()[hit], expected[hit], rtol=1e-10)
    at = origins + np.where(np.isfinite(expected), expected, 0)[:, None] * directions * lengths
    np.testing.assert_allclose(found.points[0].numpy()[hit], at[hit], atol=1e-9)
    # Conditioned as in `compare`.
    error = np.linalg.norm(found.normals[0].numpy() - normal, axis=1)[hit] * np.minimum(margin[hit], 1)
    np.testing.assert_allclose(error, 0, atol=1e-8)
    assert not found.hit[0].numpy()[~hit & clear].any()
    assert found.distance[0].numpy()[~np.isfinite(expected) & clear].min(initial=np.inf) == np.inf


@given(drawn(), st.integers(0, 2**20))
def test_occupancy_agrees_with_the_oracle(wanted, seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (500, 3))
    found = scenes.occupancy([wanted.scene], torch.from_numpy(points)[None])
    np.testing.assert_array_equal(found[0].numpy(), truth.holds(wanted.parts, points))


@settings(max_examples=20)
@given(drawn())
def test_shadows_agree_with_the_oracle(wanted):
    towards = np.array([0.3, 0.8, -0.5])
    towards /= np.linalg.norm(towards)
    light = scenes.Lights(torch.from_numpy(towards)[None], torch.full((1, 3), 0.5), torch.full((3,), 0.25))
    found = scenes.render([wanted.scene], wanted.cameras, light, shadows=True, dtype=torch.float64)
    for view in range(2):
        origins, directions = wanted.rays(view)
        s, normal, margin = truth.first_hit(wanted.parts, origins, directions)
        # Far from edges and grazing angles; 1e-3 is ten times the offset of the shadow rays.
        clear = np.isfinite(s) & (margin > 1e-3) & (normal @ towards > 0.02)
        at = origins[clear] + s[clear, None] * directions[clear] + 1e-3 * normal[clear]
        outside = ~truth.holds(wanted.parts, at)
        blocked, _, width = truth.first_hit(wanted.parts, at, np.broadcast_to(towards, at.shape))
        sure = outside & (~np.isfinite(blocked) | ((blocked > 0.01) & (width > 0.01)))
        expected = 0.7 * (0.25 + 0.5 * (normal[clear] @ towards) * ~np.isfinite(blocked))
        colour = found.images[0, view, 0].flatten().numpy()[clear]
        # At edges of shadows the two offsets differ: fewer than one pixel in a hundred.
        different = ~np.isclose(colour, expected, atol=1e-6)[sure]
        assert different.sum() <= 1 + 0.01 * sure.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_those_of_the_surface(kind):
    rng = np.random.default_rng(3)
    solid, shape = make(kind, rng, np.array([0.0, 1.0, 0.0]), 1.0)
    lower, upper = solid.bounds()
    if kind == "half_space":
        assert np.isinf(lower).all()
        assert np.isinf(upper).all()
        return
    points = rng.uniform(-2, 2, (400000, 3))
    inside = points[shape.holds(points)]
    assert (inside >= lower).all()
    assert (inside <= upper).all()
    # Random points come close to every side.
    np.testing.assert_allclose(inside.min(0), lower, atol=0.12)
    np.testing.assert_allclose(inside.max(0), upper, atol=0.12)


def room() -> scenes.Scene:
    return scenes.Scene([scenes.box((0, 0, 0), (4, 4, 4)).minus(scenes.box((0, 0, 0), (3, 3, 3)))])


def test_a_room_is_visible_from_inside():
    camera = CameraTensors(torch.tensor([[[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]]]), torch.eye(4)[None, None], 9, 9)
    found = scenes.render([room()], camera, SUN)
    torch.testing.assert_close(found.depth, torch.full((1, 1, 9, 9), 1.5))
    torch.testing.assert_close(found.normals[0, 0, :, 4, 4], torch.tensor([0.0, 0.0, -1.0]))


def test_a_solid_that_contains_the_camera_is_invisible():
    camera = CameraTensors(torch.tensor([[[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]]]), torch.eye(4)[None, None], 9, 9)
    around, ahead = scenes.sphere((0, 0, 0), 1), scenes.box((0, 0, 5), (4, 4, 2))
    assert not scenes.render([scenes.Scene([around])], camera, SUN).mask.any()
    assert float(scenes.render([scenes.Scene([around, ahead])], camera, SUN).depth[0, 0, 4, 4]) == 4.0


def test_a_sphere_at_the_centre_of_the_view():
    views = orbit(torch.tensor([[0.0, 120.0]]), 20.0, 2.0, focal_length=60.0, height=33, width=33)
    found = scenes.render([scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])], views, SUN)
    torch.testing.assert_close(found.depth[0, :, 16, 16], torch.full((2,), 1.5))
    centers = -views.cam_from_world[0, :, :3, :3].transpose(1, 2) @ views.cam_from_world[0, :, :3, 3:]
    torch.testing.assert_close(found.normals[0, :, :, 16, 16], centers[..., 0] / 2)
    # The silhouette is a circle with sin a = r / |C|.
    v, u = torch.meshgrid(torch.arange(33.0) - 16, torch.arange(33.0) - 16, indexing="ij")
    inside = u.square() + v.square() < (60 * np.tan(np.arcsin(0.25))) ** 2
    assert torch.equal(found.mask[0, 0], inside)


def test_the_nearest_of_many_is_hit_in_any_order():
    solids = [scenes.sphere((0, 0, z), 0.3, scenes.Material((z / 10, 0, 0))) for z in (3.0, 5.0, 7.0)]
    camera = CameraTensors(torch.tensor([[[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]]]), torch.eye(4)[None, None], 9, 9)
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        found = scenes.render([scenes.Scene([solids[i] for i in order])], camera, SUN)
        torch.testing.assert_close(found.depth[0, 0, 4, 4], torch.tensor(2.7))


def test_a_floor_reaches_the_horizon():
    """Rays at and above the horizon miss; below it the depth is height over slope."""
    floor = scenes.Scene([scenes.half_space((0, 1, 0), (0, -1, 0))])  # y is down in the camera's frame
    camera = CameraTensors(torch.tensor([[[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]]]), torch.eye(4)[None, None], 9, 9)
    depth = scenes.render([floor], camera, SUN).depth[0, 0, :, 2]
    torch.testing.assert_close(depth, torch.tensor([0.0] * 5 + [8.0 / k for k in (1, 2, 3, 4)]))


@settings(max_examples=50)
@given(drawn(), st.booleans())
def test_voxels_agree_with_the_oracle(wanted, rotated):
    pose = np.eye(4)
    if rotated:
        pose[:3, :3] = oracle.rotation(np.array([0.3, -0.5, 0.2]))
    matrix = torch.from_numpy(pose) if rotated else None
    grid = VoxelGrid((5, 6, 7), (-0.9, -0.8, -0.7), (0.8, 0.9, 1.0), world_from_grid=matrix)
    points = oracle.voxel_sites((5, 6, 7), np.array([-0.9, -0.8, -0.7]), np.array([0.8, 0.9, 1.0]), pose).reshape(-1, 3)
    found = scenes.voxels([wanted.scene], grid)
    np.testing.assert_array_equal(found[0].flatten().numpy(), truth.holds(wanted.parts, points))
    assert found.shape == (1, 5, 6, 7)


def test_a_cut_flush_with_a_face_opens_it():
    """A drawer: rounding leaves no lid for any camera, and no wall between touching cuts."""
    drawer = scenes.box((0.1, 0, 0.05), (1, 0.5, 1)).minus(scenes.box((0.1, 0.05, 0.05), (0.8, 0.4, 0.8)))
    halves = scenes.box((0.1, 0, 0.05), (1, 0.5, 1)).minus(
        scenes.box((-0.1, 0.05, 0.05), (0.4, 0.4, 0.8)), scenes.box((0.3, 0.05, 0.05), (0.4, 0.4, 0.8))
    )
    views = orbit(torch.tensor([[10.0, 75.0, 200.0]]), 50.0, 3.0, focal_length=120.0, height=90, width=110)
    floor = []
    for solid in (drawer, drawer.rotated(0, 17.0), halves):
        found = scenes.render([scenes.Scene([solid])], views, SUN)
        centers = -(views.cam_from_world[0, :, :3, :3].mT @ views.cam_from_world[0, :, :3, 3:])[..., 0]
        through = views.cam_from_world[0, :, :3, :3].mT @ torch.linalg.inv(views.intrinsics[0])
        v, u = torch.meshgrid(torch.arange(90.0), torch.arange(110.0), indexing="ij")
        rays = torch.einsum("vij,hwj->vhwi", through, torch.stack((u, v, torch.ones_like(u)), -1))
        points = centers[:, None, None] + found.depth[0, ..., None] * rays
        matrix = torch.from_numpy(np.linalg.inv(np.r_[solid.world_from_local, [[0, 0, 0, 1]]])).float()
        local = points @ matrix[:3, :3].T + matrix[:3, 3]
        opening = found.mask[0] & (local[..., 0].abs() < 0.79) & (local[..., 2].abs() < 0.79)
        assert opening.sum() > 500
        assert not (opening & (local[..., 1] > 0.99)).any()
        floor.append(int((opening & (local[..., 1] < -0.5)).sum()))
    assert floor[0] == floor[2]


def test_a_hole_that_is_flush_at_both_ends_is_open():
    plate = scenes.box((0, 0.1, 0), (1, 0.2, 1)).minus(scenes.box((0, 0.1, 0), (0.5, 0.2, 0.5)))
    view = orbit(torch.tensor([[30.0]]), 85.0, 3.0, focal_length=120.0, height=61, width=61, target=(0.0, 0.1, 0.0))
    found = scenes.render([scenes.Scene([plate])], view, SUN)
    assert not found.mask[0, 0, 26:35, 26:35].any()
    assert found.mask.any()


@pytest.mark.parametrize("scale", [1e-4, 1e-2, 1.0, 1e3])
def test_shadows_are_the_same_at_every_scale(scale):
    solids = [
        scenes.sphere((0, 0.3, 0), 0.2),
        scenes.half_space((0, 0, 0), (0, 1, 0)),
        scenes.box((0.3, 0.1, 0), (0.2, 0.2, 0.2)),
    ]
    views = orbit(torch.tensor([[20.0]]), 35.0, 2.0 * scale, focal_length=120.0, height=120, width=120)
    scene = scenes.Scene([solid.scaled(scale) for solid in solids])
    light = scenes.Lights(torch.tensor([[0.48, 0.8, 0.36]]), torch.full((1, 3), 0.6), torch.full((3,), 0.2))
    found = scenes.render([scene], views, light, shadows=True, near=1e-6 * scale).images
    unit = orbit(torch.tensor([[20.0]]), 35.0, 2.0, focal_length=120.0, height=120, width=120)
    expected = scenes.render([scenes.Scene(solids)], unit, light, shadows=True, dtype=torch.float64).images
    different = ~torch.isclose(found.double(), expected, atol=1e-3).all(2)
    assert int(different.sum()) <= 12  # at the shadows' edges
    blocked = torch.isclose(expected, torch.tensor(0.14, dtype=torch.float64), atol=1e-4).all(2)
    assert int(blocked.sum()) > 50


def test_many_views_of_a_scene_are_split(monkeypatch):
    monkeypatch.setattr(rendering, "ONE_VIEW_AT_A_TIME", ())
    monkeypatch.setattr(rendering, "VIEWS_AT_ONCE", 2)
    solids = [scenes.Scene([scenes.sphere((x, 0, 0), 0.2)]) for x in (0.0, 0.1)]
    views = orbit(torch.arange(10.0).view(2, 5) * 30, 10.0, 2.0, focal_length=20.0, height=9, width=9)
    together = scenes.render(solids, views, SUN)
    monkeypatch.undo()
    torch.testing.assert_close(together.depth, scenes.render(solids, views, SUN).depth)


def test_nothing_is_recorded_for_derivatives():
    view = orbit(torch.zeros(1, 1), 0.0, 2.0, focal_length=20.0, height=9, width=9)
    view = view._replace(cam_from_world=view.cam_from_world.requires_grad_())
    lights = SUN._replace(ambient=torch.full((3,), 0.3, requires_grad=True))
    scene = scenes.Scene([scenes.sphere((0, 0, 0), 0.3)])
    found = scenes.render([scene], view, lights, background=torch.ones(3, requires_grad=True))
    assert not any(value.requires_grad for value in found)
    dark = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
    assert float(scenes.render([scene], view, dark, shadows=True).images[0, 0, 0, 4, 4]) == pytest.approx(0.7)


@settings(max_examples=30)
@given(drawn(), st.integers(0, 2))
def test_a_mirrored_scene_gives_the_mirrored_image(wanted, axis):
    origins, directions = (torch.from_numpy(np.array(rays))[None] for rays in wanted.rays(0))
    mirror = torch.ones(3, dtype=torch.float64)
    mirror[axis] = -1
    expected = scenes.trace([wanted.scene], origins, directions)
    reflected = scenes.Scene([solid.mirrored(axis) for solid in wanted.scene.solids])
    found = scenes.trace([reflected], origins * mirror, directions * mirror)
    torch.testing.assert_close(found.distance, expected.distance, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.points, expected.points * mirror, rtol=1e-9, atol=1e-9)


@settings(max_examples=30)
@given(drawn())
def test_another_size_is_another_camera(wanted):
    found = scenes.render([wanted.scene], wanted.cameras, SUN, size=(23, 17), dtype=torch.float64)
    expected = scenes.render([wanted.scene], resize(wanted.cameras, 23, 17), SUN, dtype=torch.float64)
    torch.testing.assert_close(found.depth, expected.depth, rtol=1e-9, atol=1e-9)
