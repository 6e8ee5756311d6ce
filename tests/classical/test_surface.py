"""Meshes out of grids, against closed forms, and files of them read back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo import VoxelGrid
from lsmgeo.classical import Tsdf, drop_specks, extract_mesh, write_mesh
from lsmgeo.data import Mesh, load_mesh
from lsmgeo.errors import DataError, DTypeError, GridError, OptionError, ShapeError
from tests import oracle
from tests.classical.seen import is_closed, volume

SHAPE, LOWER, UPPER = (18, 20, 22), np.array([-0.6, -0.5, -0.55]), np.array([0.5, 0.6, 0.45])
POSE = np.block([[oracle.rotation(np.array([0.3, -0.2, 0.6])), np.array([[0.1], [-0.2], [0.3]])], [0, 0, 0, 1]])
MIRROR = POSE @ np.diag([-1.0, 1.0, 1.0, 1.0])


def grid_and_centers(pose):
    grid = VoxelGrid(SHAPE, LOWER.tolist(), UPPER.tolist(), torch.tensor(pose))
    return grid, oracle.voxel_sites(SHAPE, LOWER, UPPER, pose)


def seen(distance, weight=None, colours=None):
    distance = torch.as_tensor(distance)
    return Tsdf(distance, torch.ones_like(distance) if weight is None else torch.as_tensor(weight), colours)


def normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("pose", [np.eye(4), POSE, MIRROR], ids=["straight", "posed", "mirrored"])
def test_a_plane_comes_back_exactly_and_faces_the_outside(pose):
    grid, centers = grid_and_centers(pose)
    normal, middle = np.array([0.48, -0.6, 0.64]), centers.reshape(-1, 3).mean(0)
    mesh = extract_mesh(seen((centers - middle) @ normal), grid)
    assert len(mesh.faces) > 300
    np.testing.assert_allclose((mesh.vertices - middle) @ normal, 0, atol=1e-6)
    turned = normals(mesh) @ normal
    assert (turned > 0).all()
    # The whole plane within the box through the outermost centres: its area, by the faces, is the box's cross-section.
    assert turned.sum() / 2 == pytest.approx(cross_section(normal, middle, pose), rel=1e-6)


def cross_section(normal, middle, pose):
    """Area where a plane cuts the box through the outermost voxel centres, by its intersections with the edges."""
    matrix = oracle.world_from_lattice(SHAPE, LOWER, UPPER, pose)
    last = np.array(SHAPE[::-1]) - 1.0
    corners = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)]) * last
    world = corners @ matrix[:3, :3].T + matrix[:3, 3]
    points = []
    for i in range(8):
        for axis in range(3):
            j = i | (1 << axis)
            a, b = (world[i] - middle) @ normal, (world[j] - middle) @ normal
            if a * b < 0:
                points.append(world[i] + a / (a - b) * (world[j] - world[i]))
    points = np.array(points)
    x = np.linalg.svd(normal[None])[2][1:]
    flat = (points - points.mean(0)) @ x.T
    flat = flat[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
    after = np.roll(flat, -1, 0)
    return 0.5 * abs((flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0]).sum())


@pytest.mark.parametrize("pose", [np.eye(4), POSE, MIRROR], ids=["straight", "posed", "mirrored"])
def test_a_ball_is_closed_outward_and_in_place(pose):
    grid, centers = grid_and_centers(pose)
    middle = centers.reshape(-1, 3).mean(0) + 0.01
    distance = np.linalg.norm(centers - middle, axis=-1) - 0.33
    for mesh in (extract_mesh(seen(distance), grid), extract_mesh(torch.tensor(-distance), grid, level=0.0)):
        errors = np.linalg.norm(mesh.vertices - middle, axis=1) - 0.33
        # A chord of 0.06 under a circle of radius 0.33 rises by 0.0013; half a voxel would be 0.025.
        assert np.abs(errors).max() < 0.002
        assert is_closed(mesh.faces)
        assert len(mesh.vertices) - len(mesh.faces) / 2 == 2
        assert volume(mesh.vertices - middle, mesh.faces) == pytest.approx(4 / 3 * np.pi * 0.33**3, rel=0.02)


def test_one_voxel_is_an_octahedron_about_its_centre():
    occupancy = torch.zeros(3, 4, 5, dtype=torch.bool)
    occupancy[2, 0, 3] = True
    mesh = extract_mesh(occupancy, VoxelGrid((3, 4, 5), 0.0, (5.0, 8.0, 9.0)))
    offset = mesh.vertices - np.array([3.5, 1.0, 7.5])
    expected = [[-0.5, 0, 0], [0, -1, 0], [0, 0, -1.5], [0, 0, 1.5], [0, 1, 0], [0.5, 0, 0]]
    np.testing.assert_allclose(np.array(sorted(offset.tolist())), sorted(expected), atol=1e-6)
    assert len(mesh.faces) == 8
    assert is_closed(mesh.faces)
    assert volume(offset, mesh.faces) == pytest.approx(8 * 0.5 * 1 * 1.5 / 6)


def test_what_fills_the_grid_is_closed_at_its_border():
    mesh = extract_mesh(torch.ones(4, 4, 4, dtype=torch.bool), VoxelGrid(4))
    assert is_closed(mesh.faces)
    assert volume(mesh.vertices, mesh.faces) > 0.9
    assert np.abs(mesh.vertices).max() == pytest.approx(0.5)


def test_cells_with_an_unseen_corner_have_no_surface():
    grid, centers = grid_and_centers(np.eye(4))
    weight = np.ones(SHAPE)
    weight[:, :, 11:] = 0
    distance = np.where(weight > 0, centers[..., 2] - 0.013, -0.7)
    mesh = extract_mesh(seen(distance, weight), grid)
    assert len(mesh.faces) == 2 * (SHAPE[1] - 1) * 10
    assert mesh.vertices[:, 0].max() == pytest.approx(centers[0, 0, 10, 0])
    # One cell alone.
    weight = np.zeros(SHAPE)
    z = int(np.searchsorted(centers[:, 0, 0, 2], 0.013))
    weight[z - 1 : z + 1, 4:6, 7:9] = 2
    one = extract_mesh(seen(centers[..., 2] - 0.013, weight), grid)
    assert len(one.faces) == 2
    np.testing.assert_allclose(one.vertices.min(0)[:2], centers[z, 4, 7, :2], atol=1e-6)
    np.testing.assert_allclose(one.vertices.max(0)[:2], centers[z, 5, 8, :2], atol=1e-6)


def test_colours_are_interpolated_from_corners_that_have_any():
    grid, centers = grid_and_centers(np.eye(4))
    colours = torch.tensor(0.5 + 0.6 * centers).permute(3, 0, 1, 2).clamp(0, 1)
    distance = centers[..., 2] + 0.021
    mesh = extract_mesh(seen(distance, colours=colours), grid)
    np.testing.assert_allclose(mesh.colours / 255, np.clip(0.5 + 0.6 * mesh.vertices, 0, 1), atol=0.5 / 255 + 0.004)
    # Of two corners one is unknown: the colour is the other's, not half of it.
    behind = torch.where(torch.tensor(distance) > 0, 0.0, torch.tensor(0.8).double()).expand(3, *SHAPE)
    mesh = extract_mesh(seen(distance, colours=behind), grid)
    np.testing.assert_array_equal(np.unique(mesh.colours), [204])


def test_nothing_gives_a_mesh_without_faces():
    for shape in ((4, 4, 4), (1, 4, 4)):
        grid = VoxelGrid(shape)
        for value in (-1.0, 0.0, 1.0):
            assert len(extract_mesh(seen(torch.full(shape, value)), grid).faces) == 0
        assert len(extract_mesh(torch.zeros(shape, dtype=torch.bool), grid).faces) == 0
        assert len(extract_mesh(seen(torch.randn(shape), torch.zeros(shape)), grid).faces) == 0


def test_specks_are_dropped():
    occupancy = torch.zeros(9, 9, 9, dtype=torch.bool)
    occupancy[1, 1, 1] = occupancy[1, 7, 1] = True
    occupancy[4:8, 4:8, 4:8] = True
    grid = VoxelGrid(9)
    whole = extract_mesh(occupancy, grid)
    large = extract_mesh(occupancy, grid, specks=9)
    assert len(whole.faces) == len(large.faces) + 16
    assert is_closed(large.faces)
    assert large.vertices.min() > -0.15
    assert len(np.unique(large.faces)) == len(large.vertices)
    assert len(extract_mesh(occupancy, grid, specks=8).faces) == len(whole.faces)
    assert len(drop_specks(whole, 10**6).faces) == 0
    assert len(drop_specks(drop_specks(whole, 10**6), 1).faces) == 0
    with pytest.raises(DTypeError, match="drop_specks: mesh"):
        drop_specks(None, 1)
    for junk in (None, -1, 1.5, "many"):
        with pytest.raises(OptionError, match="drop_specks: faces"):
            drop_specks(whole, junk)


@pytest.mark.parametrize("ending", ["ply", "glb", "PLY"])
@pytest.mark.parametrize("is_coloured", [True, False])
def test_files_are_read_back(tmp_path, ending, is_coloured):
    generator = np.random.default_rng(3)
    vertices = generator.normal(size=(5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3], [0, 4, 1]])
    colours = np.array([[250, 10, 30]] * 5, np.uint8) if is_coloured else None
    path = write_mesh(tmp_path / "deep" / f"mesh.{ending}", Mesh(vertices, faces, colours=colours))
    assert [item.name for item in path.parent.iterdir()] == [path.name]
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], vertices[faces], rtol=1e-6)
    if is_coloured:
        assert mesh.face_colours is not None
        np.testing.assert_allclose(mesh.face_colours, np.tile(colours[0] / 255, (3, 1)), atol=1e-3)


def test_an_independent_reader_agrees_on_vertex_colours(tmp_path):
    import trimesh

    vertices = np.random.default_rng(4).normal(size=(4, 3)).astype(np.float32)
    colours = np.array([[1, 2, 3], [40, 50, 60], [255, 0, 128], [9, 99, 199]], np.uint8)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [3, 2, 1]]), colours=colours)
    for ending in ("ply", "glb"):
        read = trimesh.load(write_mesh(tmp_path / f"a.{ending}", mesh), force="mesh", process=False)
        np.testing.assert_allclose(read.vertices, vertices, rtol=1e-6)
        np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], colours)


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path):
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    with pytest.raises(OptionError, match=r"must end in \.ply or \.glb"):
        write_mesh(tmp_path / "a.obj", mesh)
    with pytest.raises(DataError, match="no face"):
        write_mesh(tmp_path / "a.ply", Mesh(mesh.vertices, np.zeros((0, 3), np.int64)))
    with pytest.raises(DTypeError, match="write_mesh: mesh must be a"):
        write_mesh(tmp_path / "a.ply", None)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        write_mesh(tmp_path / "file" / "a.ply", mesh)
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_bad_input_is_refused():
    field, grid = torch.zeros(4, 4, 4), VoxelGrid(4)
    for arguments, options, error in (
        ((field, 4), {}, DTypeError),
        ((field.numpy(), grid), {}, DTypeError),
        ((field[0], grid), {}, ShapeError),
        ((torch.zeros(4, 4, 5), grid), {}, ShapeError),
        ((field, VoxelGrid(4, world_from_grid=torch.eye(4).repeat(2, 1, 1))), {}, GridError),
        ((field, grid), {"level": float("nan")}, OptionError),
        ((field, grid), {"specks": -1}, OptionError),
        ((field * float("nan"), grid), {}, OptionError),
    ):
        with pytest.raises(error, match="extract_mesh"):
            extract_mesh(*arguments, **options)
