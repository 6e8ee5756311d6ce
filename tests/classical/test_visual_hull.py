"""Hulls carved by silhouettes, against loops over views and against the solids themselves."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lsmgeo import VoxelGrid
from lsmgeo.cameras import CameraTensors, select
from lsmgeo.classical import default_grid, extract_mesh, hull_box, signed_distance, visual_hull
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from tests import oracle
from tests.classical.seen import Cameras, all_round, is_closed
from tests.oracle.primitives import Ellipsoid, Faces, Part, holds

RADII = np.array([0.42, 0.2, 0.3])
TURN = oracle.rotation(np.array([0.4, -0.7, 0.5]))
EGG = [Part(Ellipsoid(np.array([0.03, -0.05, 0.02]), RADII, TURN))]
POSE = np.block([[oracle.rotation(np.array([0.2, 0.5, -0.3])), np.array([[0.03], [-0.02], [0.01]])], [0, 0, 0, 1]])
SHAPE, LOWER, UPPER = (7, 9, 8), np.array([-0.9, -0.7, -0.8]), np.array([0.8, 0.9, 0.75])


def some(cameras, views):
    return Cameras(cameras.intrinsics[views], cameras.rotations[views], cameras.translations[views], cameras.size)


def expected_support(masks, cameras, points, rule, outside):
    """View by view: what the mask says where the point projects, clamped to the outermost pixels."""
    said, seen = [], []
    for view, mask in enumerate(masks):
        K = oracle.resize_intrinsics(cameras.intrinsics[view], cameras.size, mask.shape)
        pixels, depth = oracle.project(K, cameras.rotations[view], cameras.translations[view], points)
        sees = (depth > 1e-6) & oracle.is_in_image(pixels, mask.shape)
        pixels = np.where(sees[:, None], pixels, 0.0)
        said.append(np.where(sees, oracle.sample(mask[None], pixels, "linear", "border")[0], np.nan))
        seen.append(sees)
    said, seen = np.array(said), np.array(seen)
    if outside == "empty":
        said = np.where(seen, said, 0.0)
        return said.mean(0) if rule == "mean" else said.min(0)
    known = seen.any(0)
    said[:, ~known] = 0.0
    return np.nanmean(said, 0) if rule == "mean" else np.nanmin(said, 0)


@pytest.mark.parametrize("rule", ["mean", "all"])
@pytest.mark.parametrize("outside", ["empty", "unknown"])
@pytest.mark.parametrize("size", [(24, 30), (17, 26)])
def test_support_is_what_the_views_say(rule, outside, size):
    # Near enough that some views do not see some voxels, and one stands inside the grid.
    cameras = all_round(4, (24, 30), distance=1.3)
    cameras.translations[3] *= 0.3
    masks = np.random.default_rng(2).uniform(size=(4, *size))
    grid = VoxelGrid(SHAPE, LOWER.tolist(), UPPER.tolist(), torch.tensor(POSE))
    points = oracle.voxel_sites(SHAPE, LOWER, UPPER, POSE).reshape(-1, 3)
    hull = visual_hull(torch.tensor(masks), cameras.tensors(), grid, rule=rule, outside=outside)
    expected = expected_support(masks, cameras, points, rule, outside).reshape(SHAPE)
    np.testing.assert_allclose(hull.support.numpy(), expected, atol=1e-9)
    np.testing.assert_array_equal(hull.occupancy.numpy(), expected > (0.75 if rule == "mean" else 0.5))
    assert 0 < int((hull.support > 0).sum())


def test_three_of_four_are_not_more_than_three_quarters():
    cameras = Cameras(*(np.repeat(value[:1], 4, 0) for value in all_round(4)[:3]), (60, 72))
    masks, grid = torch.ones(4, 60, 72, dtype=torch.bool), VoxelGrid(3, -0.1, 0.1)
    masks[0] = False
    assert not visual_hull(masks, cameras.tensors(), grid).occupancy.any()
    assert visual_hull(masks, cameras.tensors(), grid, threshold=0.74).occupancy.all()
    assert visual_hull(masks[1:], some(cameras, slice(1, None)).tensors(), grid).occupancy.all()


@pytest.mark.parametrize("rule", ["mean", "all"])
def test_the_hull_holds_the_solid_and_little_more(rule):
    cameras = all_round(24, (90, 108))
    masks = cameras.see(EGG)[0] > 0
    grid = VoxelGrid((30, 32, 31), -0.5, 0.5)
    hull = visual_hull(torch.tensor(masks), cameras.tensors(), grid, rule=rule).occupancy.numpy()
    centers = oracle.voxel_sites((30, 32, 31), np.full(3, -0.5), np.full(3, 0.5), np.eye(4)).reshape(-1, 3)
    # A pixel is about 0.016 wide at the solid: what lies deeper than that projects wholly inside.
    inner = [Part(Ellipsoid(np.array([0.03, -0.05, 0.02]), RADII - 0.02, TURN))]
    outer = [Part(Ellipsoid(np.array([0.03, -0.05, 0.02]), RADII + 0.06, TURN))]
    assert hull.reshape(-1)[holds(inner, centers)].all()
    if rule == "all":
        assert not hull.reshape(-1)[~holds(outer, centers)].any()
        # Moved by half a voxel, the hull would lose part of the solid.
        moved = holds(inner, centers + np.array([0.5 / 31 + 0.02, 0, 0]))
        assert not hull.reshape(-1)[moved].all()


def test_a_concavity_is_never_seen():
    """A cube with a pit in its top, from all round: the pit is filled, however many the views."""
    pit = Faces(np.array([-0.15, 0.0, -0.15]), np.diag([0.3, 0.4, 0.3]))
    cube = [Part(Faces(np.full(3, -0.3), 0.6 * np.eye(3)), (pit,))]
    cameras = all_round(30)
    masks = cameras.see(cube)[0] > 0
    grid = VoxelGrid(24)
    hull = visual_hull(torch.tensor(masks), cameras.tensors(), grid, rule="all").occupancy.numpy().reshape(-1)
    centers = oracle.voxel_sites((24, 24, 24), np.full(3, -0.5), np.full(3, 0.5), np.eye(4)).reshape(-1, 3)
    inside = pit.holds(centers) & (centers[:, 1] < 0.26)
    assert not holds(cube, centers)[inside].any()
    assert hull[inside].all()


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), views=st.integers(2, 6), outside=st.sampled_from(["empty", "unknown"]))
def test_more_views_add_nothing_by_strict_intersection(seed, views, outside):
    generator = np.random.default_rng(seed)
    cameras = all_round(views, (12, 14), distance=float(generator.uniform(1.2, 3)))
    masks = torch.tensor(generator.uniform(size=(views, 12, 14)) < 0.8)
    grid = VoxelGrid(6, -0.3, 0.3)
    fewer = visual_hull(masks[:-1], some(cameras, slice(-1)).tensors(), grid, rule="all", outside=outside).occupancy
    more = visual_hull(masks, cameras.tensors(), grid, rule="all", outside=outside).occupancy
    # All these voxels are seen by the first view, so that an unknown one cannot become known.
    assert not bool((more & ~fewer).any())


def test_slabs_batches_lists_and_poses_change_nothing():
    cameras = all_round(5, (20, 26))
    masks = torch.tensor(np.random.default_rng(5).uniform(size=(5, 20, 26)))
    grid = VoxelGrid((7, 6, 5), (-0.4, -0.5, -0.3), (0.5, 0.4, 0.6))
    for rule in ("mean", "all"):
        for outside in ("empty", "unknown"):
            options = {"rule": rule, "outside": outside}
            whole = visual_hull(masks, cameras.tensors(), grid, **options)
            slabs = visual_hull(masks, cameras.tensors(), grid, memory=1, **options)
            listed = visual_hull(list(masks), cameras.tensors(), grid, **options)
            move = torch.tensor(POSE)
            tensors = cameras.tensors()
            away = tensors._replace(cam_from_world=tensors.cam_from_world @ torch.linalg.inv(move))
            posed = VoxelGrid((7, 6, 5), grid.lower, grid.upper, move)
            moved = visual_hull(masks, away, posed, **options)
            both = CameraTensors(*(torch.stack(pair) for pair in zip(tensors[:2], away[:2], strict=True)), 20, 26)
            poses = VoxelGrid((7, 6, 5), grid.lower, grid.upper, torch.stack((torch.eye(4).double(), move)))
            batch = visual_hull(masks.expand(2, 5, 20, 26), both, poses, **options)
            for other in (slabs.support, listed.support, moved.support, *batch.support):
                torch.testing.assert_close(other, whole.support, rtol=0, atol=1e-9)
            single = visual_hull(masks.float(), cameras.tensors(), grid, **options).support
            torch.testing.assert_close(single.double(), whole.support, rtol=0, atol=1e-4)


def test_distances_to_the_outline_carve_a_smooth_hull():
    cameras = all_round(20, (90, 108))
    ball = [Part(Ellipsoid(np.zeros(3), np.full(3, 0.35), np.eye(3)))]
    distances = torch.stack([signed_distance(mask) for mask in torch.tensor(cameras.see(ball)[0] > 0)])
    grid = VoxelGrid(20)
    hull = visual_hull(distances, cameras.tensors(), grid, rule="all", threshold=0.0)
    mesh = extract_mesh(hull.support, grid, level=0.0)
    assert is_closed(mesh.faces)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    # Within a pixel of the ball on its inner side; between tangent cones the hull stands out.
    assert radii.min() > 0.35 - 0.01
    assert radii.max() < 0.43


def test_signed_distance_is_that_to_the_farther_kind_of_pixel():
    mask = np.random.default_rng(1).uniform(size=(9, 11)) < 0.6
    distance = signed_distance(torch.tensor(mask)).numpy()
    y, x = np.mgrid[:9, :11]
    for i, j in np.ndindex(9, 11):
        other = mask != mask[i, j]
        nearest = np.hypot(y - i, x - j)[other].min()
        assert distance[i, j] == pytest.approx((nearest - 0.5) * (1 if mask[i, j] else -1), abs=1e-4)
    assert signed_distance(torch.ones(3, 4, dtype=torch.bool)).eq(5).all()
    assert signed_distance(torch.zeros(3, 4, dtype=torch.bool)).eq(-5).all()
    with pytest.raises(ShapeError, match="mask"):
        signed_distance(torch.ones(3, 4))


ROD = [Part(Faces(-TURN @ np.array([0.4, 0.012, 0.012]), 2 * (TURN * np.array([0.4, 0.012, 0.012])).T))]


@pytest.mark.parametrize(("parts", "slack"), [(EGG, 0.15), (ROD, 0.15)], ids=["egg", "rod"])
def test_the_box_holds_the_solid_and_little_more(parts, slack):
    cameras = all_round(12, (90, 108))
    shift = np.array([3.0, -1.0, 2.0])  # far from the origin, where nothing says that the object is
    cameras = cameras._replace(translations=cameras.translations - cameras.rotations @ shift)
    (part,) = parts
    moved = part.shape
    if isinstance(moved, Ellipsoid):
        moved = Ellipsoid(moved.center + shift, moved.radii, moved.rotation)
        reach = np.sqrt(np.diag(TURN @ np.diag(RADII**2) @ TURN.T))
        low, high = moved.center - reach, moved.center + reach
    else:
        moved = Faces(moved.corner + shift, moved.edges)
        corners = moved.corner + np.array([[(k >> a) & 1 for a in range(3)] for k in range(8)]) @ moved.edges
        low, high = corners.min(0), corners.max(0)
    masks = [torch.tensor(mask) for mask in cameras.see([Part(moved)])[0] > 0]
    lower, upper = hull_box(masks, cameras.tensors(), margin=0.0)
    pixel = 0.02
    assert (np.array(lower) < low + pixel).all()
    assert (np.array(upper) > high - pixel).all()
    assert (np.array(lower) > low - slack).all()
    assert (np.array(upper) < high + slack).all()
    grid = default_grid(masks, cameras.tensors(), 40)
    T = grid.world_from_lattice.numpy()
    assert max(grid.shape) == 40
    np.testing.assert_allclose(T[:3, :3], np.eye(3) * T[0, 0], atol=1e-12)
    assert (np.array(grid.lower) <= np.array(lower)).all()
    assert (np.array(grid.upper) >= np.array(upper)).all()


def test_two_views_bound_a_box_and_one_does_not():
    cameras = all_round(2, (60, 72))
    masks = [torch.tensor(mask) for mask in cameras.see(EGG)[0] > 0]
    lower, upper = hull_box(masks, cameras.tensors())
    assert all(-3 < low < -0.1 for low in lower)
    assert all(0.1 < high < 3 for high in upper)
    for views in ([0], [0, 0, 0]):
        with pytest.raises(OptionError, match="from one direction"):
            hull_box([masks[view] for view in views], some(cameras, views).tensors())


def test_boxes_of_silhouettes_that_do_not_belong_together_are_refused():
    cameras = all_round(6, (60, 72))
    masks = torch.zeros(6, 60, 72, dtype=torch.bool)
    for view in range(6):
        masks[view, 5:9, (8 + 12 * (view % 2)) : (12 + 12 * (view % 2))] = True
    with pytest.raises(OptionError, match="nothing projects into all"):
        hull_box(list(masks), cameras.tensors())
    masks[3] = False
    with pytest.raises(OptionError, match="silhouette of view 3 is empty"):
        hull_box(list(masks), cameras.tensors())
    with pytest.raises(ShapeError, match="one for each of the 6"):
        hull_box(list(masks[:2]), cameras.tensors())
    with pytest.raises(OptionError, match="margin"):
        hull_box(list(masks), cameras.tensors(), margin=-1.0)
    for junk in (None, 3, "masks", [None] * 6, masks.float(), masks[:, 0], list(masks.numpy())):
        with pytest.raises(DTypeError, match="hull_box: masks"):
            hull_box(junk, cameras.tensors())
    with pytest.raises(ShapeError, match="hull_box: cameras"):
        hull_box(list(masks), select(cameras.tensors(), 0, 0))


def test_bad_input_is_refused():
    cameras, grid = all_round(3, (8, 9)).tensors(), VoxelGrid(4)
    masks = torch.ones(3, 8, 9)
    for bad, error in (
        ({"masks": masks[:2]}, ShapeError),
        ({"masks": masks[0]}, ShapeError),
        ({"masks": masks[:0]}, ShapeError),
        ({"masks": [masks, masks]}, ShapeError),
        ({"masks": []}, DTypeError),
        ({"masks": masks.long()}, DTypeError),
        ({"masks": masks * float("nan")}, OptionError),
        ({"masks": None}, DTypeError),
        ({"grid": 3}, DTypeError),
        ({"grid": VoxelGrid(4, world_from_grid=torch.eye(4).repeat(2, 1, 1))}, ShapeError),
        ({"rule": "any"}, OptionError),
        ({"outside": "full"}, OptionError),
        ({"threshold": float("nan")}, OptionError),
        ({"memory": 0}, OptionError),
    ):
        arguments = {"masks": masks, "cameras": cameras, "grid": grid} | bad
        with pytest.raises(error, match=r"visual_hull|unproject"):
            visual_hull(**arguments)
