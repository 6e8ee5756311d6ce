"""Solid voxels against exact occupancy that does not know the mesh, and what becomes of meshes with faults."""

import sys

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lsmgeo import scenes
from lsmgeo.data import Mesh, from_trimesh, load_mesh, normalise, voxelise
from lsmgeo.data.meshes.mesh_topology import merged_faces, parts_of
from lsmgeo.data.meshes.scan_conversion import LINES, cells_touched, crossings
from lsmgeo.data.meshes.voxelise import _vote_inside as by_vote
from lsmgeo.data.meshes.voxelise import plan_voxels, winding_number
from lsmgeo.errors import BackendError, DTypeError, GridError, OptionError
from lsmgeo.scenes.meshing import to_mesh
from tests.data.real_sets import folder_of_meshes


def centres(count, lower=-0.5, upper=0.5):
    line = lower + (np.arange(count) + 0.5) * (upper - lower) / count
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)[..., ::-1]


def overlap(first, second):
    first, second = np.asarray(first), np.asarray(second)
    assert first.shape == second.shape
    return (first & second).sum() / (first | second).sum()


def equal(solid, expected):
    assert expected.any()
    np.testing.assert_array_equal(solid.numpy(), expected)


def boxes(seed, count=6):
    """Overlapping boxes, each (centre, half size), and their meshes."""
    rng = np.random.default_rng(seed)
    found = [(rng.uniform(-0.2, 0.2, 3), rng.uniform(0.08, 0.25, 3)) for _ in range(count)]
    return found, [trimesh.creation.box(bounds=(centre - half, centre + half)) for centre, half in found]


def in_boxes(points, found):
    return np.any([(np.abs(points - centre) < half).all(-1) for centre, half in found], axis=0)


def fine(mesh, size=0.06):
    return from_trimesh(mesh.subdivide_to_size(size, max_iter=12))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("resolution", [32, 64])
def test_unions_of_boxes_are_exact(seed, resolution):
    found, parts = boxes(seed)
    expected = in_boxes(centres(resolution), found)
    union = from_trimesh(trimesh.boolean.union(parts))
    assert union.watertight
    equal(voxelise(union, resolution), expected)


@pytest.mark.parametrize("seed", range(4))
def test_overlapping_parts_are_one_solid(seed):
    found, parts = boxes(seed)
    expected = in_boxes(centres(32), found)
    together = from_trimesh(trimesh.util.concatenate(parts))
    equal(voxelise(together), expected)
    for part in parts[::2]:
        part.invert()
    equal(voxelise(from_trimesh(trimesh.util.concatenate(parts))), expected)
    rng = np.random.default_rng(seed)
    some = rng.random(len(together.faces)) < 0.5
    turned = np.where(some[:, None], together.faces[:, ::-1], together.faces)
    equal(voxelise(Mesh(together.vertices, turned)), expected)


def test_differences_and_hollows_are_exact():
    points = centres(32)
    outer, inner = (np.zeros(3), np.array([0.31, 0.43, 0.37])), (np.array([0, 0.12, 0]), np.array([0.2, 0.41, 0.26]))
    meshes = [trimesh.creation.box(bounds=(centre - half, centre + half)) for centre, half in (outer, inner)]
    cup = from_trimesh(trimesh.boolean.difference(meshes))
    expected = in_boxes(points, [outer]) & ~in_boxes(points, [inner])
    equal(voxelise(cup), expected)
    void = (np.zeros(3), np.array([0.15, 0.2, 0.1]))
    inside = trimesh.creation.box(bounds=(-void[1], void[1]))
    inside.invert()
    hollow = from_trimesh(trimesh.util.concatenate([meshes[0], inside]))
    expected = in_boxes(points, [outer]) & ~in_boxes(points, [void])
    equal(voxelise(hollow), expected)


def test_a_prism_is_exact():
    angles = np.deg2rad(np.arange(5) * 72 + 11)
    rim = 0.42 * np.stack([np.cos(angles), np.sin(angles)], 1)
    vertices = np.concatenate([np.c_[rim, np.full(5, height)] for height in (-0.33, 0.29)])
    faces = [[0, k + 1, k] for k in range(1, 4)] + [[5, 5 + k, 6 + k] for k in range(1, 4)]
    for k in range(5):
        n = (k + 1) % 5
        faces += [[k, n, n + 5], [k, n + 5, k + 5]]
    points = centres(32)
    middle = angles + np.deg2rad(36)
    normals = np.stack([np.cos(middle), np.sin(middle)], 1)
    expected = (points[..., :2] @ normals.T < 0.42 * np.cos(np.deg2rad(36))).all(-1)
    expected &= (points[..., 2] > -0.33) & (points[..., 2] < 0.29)
    equal(voxelise(Mesh(vertices, np.array(faces))), expected)


@pytest.mark.parametrize("subdivisions", [1, 4])
def test_spheres_agree_with_ray_tests_of_trimesh(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.45)
    expected = ball.contains(centres(32).reshape(-1, 3)).reshape(32, 32, 32)
    equal(voxelise(from_trimesh(ball)), expected)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**16),
    lower=st.sampled_from([(-0.5, -0.5, -0.5), (-0.1, -0.4, 0.0), (-2.0, -1.0, -0.7)]),
    shape=st.sampled_from([(9, 9, 9), (5, 8, 12), (1, 16, 3)]),
)
def test_any_polyhedron_on_any_grid_agrees_with_solid_angles(seed, lower, shape):
    rng = np.random.default_rng(seed)
    hull = trimesh.PointCloud(rng.uniform(-0.5, 0.5, (12, 3))).convex_hull
    mesh = from_trimesh(hull)
    upper = (0.5, 0.6, 0.7)
    solid = voxelise(mesh, shape, lower=lower, upper=upper).numpy()
    lines = [low + (np.arange(n) + 0.5) * (up - low) / n for low, up, n in zip(lower, upper, shape[::-1], strict=True)]
    z, y, x = np.meshgrid(*lines[::-1], indexing="ij")
    points = np.stack((x, y, z), -1).reshape(-1, 3)
    around = winding_number(points, mesh.vertices[mesh.faces]).reshape(shape)
    np.testing.assert_array_equal(solid, around > 0.5)


def test_corners_edges_and_faces_through_centres_leave_no_gap():
    # Vertices at voxel centres, edges and diagonals along the lines: every tie there is.
    n = 8
    low, high = -0.5 + 1.5 / n, -0.5 + 6.5 / n
    box = from_trimesh(trimesh.creation.box(bounds=[[low] * 3, [high] * 3]))
    triangles = ((box.vertices + 0.5) * n - 0.5)[box.faces]
    for signed in (True, False):
        solid = by_vote(triangles, (n, n, n), LINES[:3], signed=signed)
        assert solid[2:6, 2:6, 2:6].all()  # centres 2 to 5 are within; 1 and 6 are on the surface
        assert int(solid[1:6, 1:6, 1:6].sum()) == int(solid.sum()) == 125  # of each pair of sides one is within
    for line in LINES:
        count = np.zeros((64, 64), int)
        for found in crossings(triangles, (n, n, n), line):
            np.add.at(count, (found.column + 20, found.row + 20), 1)
        assert count.any()
        assert (count % 2 == 0).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("solid", ["sphere", "boxes", "parts", "cup"])
def test_a_twentieth_of_the_faces_may_be_missing(solid, seed):
    points = centres(32)
    if solid == "sphere":
        ball = trimesh.creation.icosphere(subdivisions=4, radius=0.45)
        mesh, expected = from_trimesh(ball), ball.contains(points.reshape(-1, 3)).reshape(32, 32, 32)
    elif solid == "cup":
        cup = [trimesh.creation.box(extents=(0.62, 0.86, 0.74)), trimesh.creation.box(extents=(0.4, 0.86, 0.5))]
        cup[1].apply_translation((0, 0.12, 0))
        mesh = fine(trimesh.boolean.difference(cup))
        expected = in_boxes(points, [(np.zeros(3), np.array([0.31, 0.43, 0.37]))])
        expected &= ~in_boxes(points, [(np.array([0, 0.12, 0]), np.array([0.2, 0.43, 0.25]))])
    else:
        found, parts = boxes(1)
        mesh = fine(trimesh.boolean.union(parts) if solid == "boxes" else trimesh.util.concatenate(parts))
        expected = in_boxes(points, found)
    assert voxelise(mesh).numpy().tolist() == expected.tolist()
    kept = np.random.default_rng(seed).random(len(mesh.faces)) >= 0.05
    holed = Mesh(mesh.vertices, mesh.faces[kept])
    assert not holed.watertight
    assert overlap(voxelise(holed, keep_thin=False), expected) >= 0.999
    assert overlap(voxelise(holed), expected) >= 0.99


def test_a_lost_floor_and_a_lost_cap_do_not_matter():
    box = fine(trimesh.creation.box((0.6, 0.7, 0.5)))
    expected = in_boxes(centres(32), [(np.zeros(3), np.array([0.3, 0.35, 0.25]))])
    floor = (box.vertices[box.faces][..., 1] < -0.349).all(1)
    assert floor.any()
    open_box = Mesh(box.vertices, box.faces[~floor])
    equal(voxelise(open_box, keep_thin=False), expected)
    assert overlap(voxelise(open_box), expected) > 0.98  # the rims of the walls stand a little below the solid
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.45)
    whole = ball.contains(centres(32).reshape(-1, 3)).reshape(32, 32, 32)
    cap = from_trimesh(ball).faces[ball.triangles_center[:, 2] < 0.3]
    assert overlap(voxelise(Mesh(from_trimesh(ball).vertices, cap)), whole) > 0.9


def test_faces_drawn_from_both_sides_are_taken_once():
    found, parts = boxes(2)
    mesh = from_trimesh(trimesh.boolean.union(parts))
    twice = Mesh(mesh.vertices, np.concatenate((mesh.faces, mesh.faces[:, ::-1])))
    equal(voxelise(twice), in_boxes(centres(32), found))


def test_thin_things_are_kept_where_asked():
    # A sheet, a rod and a board with walls far thinner than a voxel, off all centres.
    sheet = from_trimesh(trimesh.creation.box((0.8, 0.002, 0.8)))
    assert not voxelise(sheet, keep_thin=False).any()
    assert not voxelise(sheet).any()  # watertight: exactly the centres inside, none
    kept = voxelise(sheet, keep_thin=True).numpy()
    y = int(np.flatnonzero(kept.any((0, 2)))[0])
    assert kept.any(1).sum() >= 24 * 24
    assert kept.sum(1).max() <= 2
    assert y in (15, 16)
    rod = trimesh.creation.box((0.012, 0.8, 0.012))
    rod.apply_translation((0.11, 0.0, 0.13))
    assert not voxelise(from_trimesh(rod), keep_thin=False).any()
    column = voxelise(from_trimesh(rod), keep_thin=True).numpy()
    assert column.any((0, 2)).sum() >= 25
    np.testing.assert_array_equal(np.diff(np.flatnonzero(column.any((0, 2)))), 1)  # in one piece
    single = Mesh(np.array([[-0.4, 0.1, -0.4], [0.4, 0.1, -0.4], [0, 0.1, 0.4]]), np.array([[0, 1, 2]]))
    assert 150 < int(voxelise(single).sum()) < 500


def test_surface_voxels_hold_every_point_of_the_surface():
    mesh = trimesh.creation.torus(0.3, 0.12)
    points = mesh.sample(20_000, seed=0)
    touched = cells_touched((mesh.triangles + 0.5) * 32 - 0.5, (32, 32, 32)) > 0
    assert touched[tuple(np.floor((points + 0.5) * 32).astype(int).T)].mean() > 0.99  # what is missed grazes a corner
    x, y, z = centres(32).transpose(2, 1, 0, 3)[touched].T
    assert np.abs(np.hypot(np.hypot(x, y) - 0.3, z) - 0.12).max() < np.sqrt(3) / 64  # half a voxel's diagonal


def test_solids_of_scenes_and_their_meshes_agree():
    parts = [
        scenes.box((-0.1, 0.05, 0.0), (0.2, 0.1, 0.3)),
        scenes.box((0.1, -0.05, 0.05), (0.15, 0.3, 0.1)).minus(scenes.box((0.1, 0.2, 0.05), (0.08, 0.2, 0.05))),
    ]
    points = torch.from_numpy(centres(32).copy())[None]
    scene = scenes.Scene(parts)
    expected = scenes.occupancy([scene], points)[0]
    assert expected.any()
    torch.testing.assert_close(voxelise(from_trimesh(to_mesh(scene))), expected)


def test_parts_and_plans():
    box = trimesh.creation.box()
    two = trimesh.util.concatenate([box, trimesh.creation.box(bounds=[[2, 2, 2], [3, 3, 3]])])
    faces = np.asarray(two.faces)
    parts = parts_of(merged_faces(two.vertices, faces))
    assert parts.closed.tolist() == [True, True]
    assert parts.oriented.tolist() == [True, True]
    assert np.bincount(parts.part).tolist() == [12, 12]
    parts = parts_of(merged_faces(two.vertices, faces[1:]))
    assert sorted(parts.closed.tolist()) == [False, True]
    holed = Mesh(np.asarray(two.vertices), faces[1:])
    assert [len(group[0]) for group in plan_voxels(holed)] == [12, 0, 11, 0]
    # Three sheets at one edge: closed never, and no turning makes them agree.
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    points = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 1], [-1, 0, -1]], float)
    assert parts_of(fan).closed.tolist() == [False]
    assert voxelise(Mesh(0.4 * points, fan)).any()


def test_a_one_sided_surface_ends_and_is_kept():
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    width = np.array([-0.1, 0.1])
    radius = 0.3 + width * np.cos(turn / 2)[:, None]
    points = np.stack(
        [radius * np.cos(turn)[:, None], radius * np.sin(turn)[:, None], width * np.sin(turn / 2)[:, None]], -1
    )
    faces = []
    for k in range(40):
        a, b = 2 * k, 2 * k + 1
        c, d = (a + 2, b + 2) if k < 39 else (1, 0)
        faces += [[a, b, c], [b, d, c]]
    solid = voxelise(Mesh(points.reshape(-1, 3), np.array(faces)))
    assert 100 < int(solid.sum()) < 1500


def test_the_same_input_gives_the_same_bits():
    mesh = fine(trimesh.util.concatenate(boxes(3)[1]))
    kept = Mesh(mesh.vertices, mesh.faces[np.random.default_rng(0).random(len(mesh.faces)) >= 0.1])
    assert torch.equal(voxelise(kept), voxelise(kept))


def test_without_scipy_the_extra_is_named(monkeypatch):
    box = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3)))
    for name in ("scipy", "scipy.sparse"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BackendError, match=r"SciPy; install lsmgeo\[data\]"):
        voxelise(box, 8)


def test_options_are_checked():
    mesh = from_trimesh(trimesh.creation.box((0.5, 0.5, 0.5)))
    with pytest.raises(OptionError, match="at most 512 voxels a side; got"):
        voxelise(mesh, 513)
    with pytest.raises(OptionError, match="keep_thin must be True or False"):
        voxelise(mesh, keep_thin=1)
    with pytest.raises(GridError, match="lower must be below upper"):
        voxelise(mesh, lower=0.5)
    with pytest.raises(DTypeError, match="from_trimesh"):
        voxelise(trimesh.creation.box())
    assert not voxelise(mesh, lower=5.0, upper=6.0).any()  # all of it elsewhere


def test_154_meshes_have_voxels():
    for path in sorted(folder_of_meshes().glob("*.ply")):
        mesh = normalise(load_mesh(path))
        solid = voxelise(mesh, keep_thin=True).numpy()
        low, high = mesh.bounds
        z, y, x = np.nonzero(solid)
        assert len(x) > 60, path.name
        # They reach as far as the mesh does on every side, and no farther.
        for places, axis in ((x, 0), (y, 1), (z, 2)):
            first, last = (places.min() / 32 - 0.5, (places.max() + 1) / 32 - 0.5)
            assert first > low[axis] - 1 / 32 - 1e-9, path.name
            assert last < high[axis] + 1 / 32 + 1e-9, path.name
            assert first < low[axis] + 3 / 32, path.name
            assert last > high[axis] - 3 / 32, path.name
