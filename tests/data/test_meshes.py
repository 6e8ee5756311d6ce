"""Meshes from files, against files written by hand, trimesh's readers and the facts of 154 meshes."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from lsmgeo.data import Mesh, from_trimesh, load_mesh, normalise
from lsmgeo.data.meshes.mesh_topology import corner_normals
from lsmgeo.errors import DataError, DTypeError, OptionError, ShapeError
from tests.data import mesh_writers as writers
from tests.data.real_sets import folder_of_meshes
from tests.tolerances import TERMWISE


def load(tmp_path, name, content, **options):
    (tmp_path / name).write_bytes(content)
    return load_mesh(tmp_path / name, **options)


def corners(mesh):
    return mesh.vertices[mesh.faces]


CUBES = [name for name in writers.samples() if not name.startswith("nodes")]
# One that we and one that trimesh parses are enough in a process of its own.
GUARDED = ["quads.obj", "big.ply"]


@pytest.mark.parametrize(("name", "guarded"), [(n, False) for n in CUBES] + [(n, True) for n in GUARDED])
def test_every_form_gives_the_cube(tmp_path, name, guarded):
    mesh = load(tmp_path, name, writers.samples()[name], guarded=guarded)
    np.testing.assert_array_equal(corners(mesh), writers.CUBE[writers.FANS])
    assert mesh.watertight
    if name.endswith((".obj", ".stl")):
        assert mesh.face_colours is None
    elif name == "tinted.ply":
        expected = (writers.TINTS / 255)[np.arange(8) % 6][writers.FANS].mean(1)
        np.testing.assert_allclose(mesh.face_colours, expected, atol=1e-6)
    else:
        np.testing.assert_allclose(mesh.face_colours, np.repeat(writers.TINTS, 2, 0) / 255, atol=1e-6)


@pytest.mark.parametrize(("name", "guarded"), [("nodes.gltf", False), ("nodes.glb", False), ("nodes.glb", True)])
def test_nodes_place_the_cube_and_mirrors_keep_it_outwards(tmp_path, name, guarded):
    mesh = load(tmp_path, name, writers.samples()[name], guarded=guarded)
    cube = writers.CUBE[writers.FANS]
    # A turn by 90 degrees about y takes (x, y, z) to (z, y, -x).
    first = cube[..., [2, 1, 0]] * [1, 1, -1] + [10, 0, 0]
    mirrored = cube[:, ::-1] * [-2, 1, 1]
    second = mirrored[..., [2, 1, 0]] * [1, 1, -1] + [10, 0, 0]
    np.testing.assert_allclose(corners(mesh), np.concatenate((first, second)), atol=1e-6)
    np.testing.assert_allclose(mesh.face_colours, np.tile([0.2, 0.4, 0.6], (24, 1)), atol=1e-6)
    volume = (corners(mesh)[:, 0] * np.cross(corners(mesh)[:, 1], corners(mesh)[:, 2])).sum() / 6
    np.testing.assert_allclose(volume, 3.0, rtol=1e-5)


@pytest.mark.parametrize("kind", ["ply", "off", "stl", "glb", "obj"])
def test_what_trimesh_writes_is_read_as_it_was(tmp_path, kind):
    expected = trimesh.creation.annulus(0.2, 0.5, 0.3)
    expected.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.7])))
    expected.visual.face_colors = np.random.default_rng(0).integers(0, 256, (len(expected.faces), 3))
    content = expected.export(file_type=kind)
    mesh = load(tmp_path, f"ring.{kind}", content.encode() if isinstance(content, str) else content)
    np.testing.assert_allclose(corners(mesh), expected.triangles, atol=1e-6)
    assert mesh.watertight
    if kind == "ply":
        np.testing.assert_allclose(mesh.face_colours, expected.visual.face_colors[:, :3] / 255, atol=1e-6)


def test_materials_colour_the_faces_of_an_obj(tmp_path):
    names = ["red", "green", "blue wood", "a/b", "cyan", "steel"]
    (tmp_path / "cube.mtl").write_bytes(writers.mtl(names))
    for guarded in (False, True):
        mesh = load(tmp_path, "cube.obj", writers.obj(materials=names), guarded=guarded)
        np.testing.assert_allclose(mesh.face_colours, np.repeat(writers.TINTS, 2, 0) / 255, atol=1e-6)


def test_a_face_without_a_known_material_is_grey(tmp_path):
    names = ["red", "green", "blue", "yellow", "cyan", "steel"]
    (tmp_path / "cube.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl green\nmap_Kd wood.png\nnewmtl steel\nKd 2 0 -1\n")
    mesh = load(tmp_path, "cube.obj", writers.obj(materials=names))
    np.testing.assert_allclose(mesh.face_colours[::2], [[1, 0, 0], *4 * [[0.7, 0.7, 0.7]], [1, 0, 0]], atol=1e-6)


def test_a_missing_material_file_leaves_the_shape(tmp_path):
    mesh = load(tmp_path, "cube.obj", writers.obj(materials=list("abcdef")))
    assert mesh.face_colours is None
    assert mesh.watertight


def test_vertices_with_colours_and_unused_vertices(tmp_path):
    text = b"v 9 9 9\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 2 3 4\n"
    mesh = load(tmp_path, "one.obj", text)
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    # The vertex that no face uses has no colour; it must not spoil those that have.
    np.testing.assert_allclose(mesh.face_colours, [[1 / 3, 1 / 3, 1 / 3]], atol=1e-6)


def test_normalise_centres_the_box_and_scales_it():
    mesh = Mesh(writers.CUBE * [2, 3, 6] + [5, -7, 11], writers.FANS)
    diagonal = normalise(mesh)
    np.testing.assert_allclose(
        diagonal.bounds, np.array([[-1, -1.5, -3], [1, 1.5, 3]]) / 7, rtol=TERMWISE[torch.float64]
    )
    longest = normalise(mesh, to="longest")
    np.testing.assert_allclose(
        longest.bounds, np.array([[-1, -1.5, -3], [1, 1.5, 3]]) / 6, rtol=TERMWISE[torch.float64]
    )
    np.testing.assert_array_equal(longest.faces, mesh.faces)


def test_a_vertex_that_no_face_uses_does_not_move_the_box():
    stray = np.concatenate((writers.CUBE, [[100.0, 0, 0]]))
    np.testing.assert_allclose(normalise(Mesh(stray, writers.FANS), to="longest").bounds[1], [0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        (([[0, 0, 0]], writers.FANS), DTypeError, "vertices must be a numpy array"),
        ((writers.CUBE, writers.FANS.astype(float)), DTypeError, "faces must be a numpy array"),
        ((writers.CUBE[:, :2], writers.FANS), ShapeError, r"vertices must be \(N, 3\)"),
        ((writers.CUBE, writers.FANS, None, np.zeros((7, 3), np.uint8)), ShapeError, r"colours must be \(8, 3\)"),
        ((writers.CUBE, writers.FANS, None, np.zeros((8, 3), np.uint16)), DTypeError, "colours must be uint8"),
        ((writers.CUBE[:7], writers.FANS), OptionError, "0 to 6"),
        ((writers.CUBE, writers.FANS - 1), OptionError, "0 to 7"),
        ((writers.CUBE + np.inf, writers.FANS), OptionError, "finite"),
        ((writers.CUBE, writers.FANS, np.ones((11, 3))), ShapeError, r"\(12, 3\)"),
        ((writers.CUBE, writers.FANS, np.full((12, 3), 1.5)), OptionError, r"\[0, 1\]"),
        ((writers.CUBE, writers.FANS, np.full((12, 3), np.nan)), OptionError, r"\[0, 1\]"),
    ],
)
def test_a_mesh_is_checked_when_made(arguments, error, match):
    with pytest.raises(error, match=match):
        Mesh(*arguments)


def test_options_are_checked(tmp_path):
    mesh = Mesh(writers.CUBE, writers.FANS)
    with pytest.raises(OptionError, match="to must be one of 'diagonal', 'longest'; got str 'height'"):
        normalise(mesh, to="height")
    with pytest.raises(OptionError, match="must have a size"):
        normalise(Mesh(np.ones((3, 3)), np.array([[0, 1, 2]])))
    with pytest.raises(DTypeError, match="from_trimesh"):
        normalise(trimesh.creation.box())
    with pytest.raises(ShapeError, match="at least one face"):
        normalise(Mesh(writers.CUBE, writers.FANS[:0]))
    with pytest.raises(OptionError, match="max_faces"):
        load_mesh(tmp_path / "cube.obj", max_faces=0)
    with pytest.raises(DataError, match="limit of 5"):
        load(tmp_path, "cube.obj", writers.obj(), max_faces=5)
    with pytest.raises(DataError, match="larger than the limit of 100 bytes"):
        load(tmp_path, "cube.stl", writers.stl(), max_bytes=100)


def test_watertight_agrees_with_trimesh():
    ball = trimesh.creation.icosphere(subdivisions=2)
    soup = trimesh.Trimesh(ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3), process=False)
    assert from_trimesh(ball).watertight
    assert from_trimesh(soup).watertight  # vertices in one place count as one
    assert not Mesh(ball.vertices.view(np.ndarray), ball.faces.view(np.ndarray)[1:]).watertight
    twice = np.concatenate((ball.faces, ball.faces[:, ::-1]))
    assert not Mesh(ball.vertices.view(np.ndarray), twice).watertight


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box():
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = corner_normals(ball.vertices, ball.faces, 40.0)
    np.testing.assert_allclose(smooth, ball.triangles, atol=0.01)
    box = trimesh.creation.box()
    sharp = corner_normals(box.vertices, box.faces, 40.0)
    np.testing.assert_allclose(sharp, np.repeat(box.face_normals[:, None], 3, 1), atol=1e-12)
    # Over a crease of 90 degrees all three sides of a corner count alike, however each is cut into triangles.
    round_box = corner_normals(box.vertices, box.faces, 91.0)
    np.testing.assert_allclose(round_box, np.sign(box.triangles) / np.sqrt(3), atol=1e-12)
    # A cylinder of many sides: smooth around, sharp at the rim.
    can = trimesh.creation.cylinder(1.0, 2.0, sections=24)
    normals = corner_normals(can.vertices, can.faces, 40.0)
    side = np.abs(can.face_normals[:, 2]) < 0.5
    np.testing.assert_allclose(normals[side, :, :2], can.triangles[side][..., :2], atol=1e-6)
    np.testing.assert_allclose(normals[~side], np.repeat(can.face_normals[~side][:, None], 3, 1), atol=1e-12)


def test_154_meshes_are_read_as_trimesh_reads_them():
    folder = folder_of_meshes()
    rows = list(csv.DictReader((folder / "index.csv").read_text().splitlines()))
    assert len(rows) == 154
    for row in rows:
        mesh = load_mesh(folder / row["file"])
        expected = trimesh.load(folder / row["file"], process=False)
        np.testing.assert_array_equal(corners(mesh), expected.triangles, err_msg=row["file"])
        assert len(mesh.faces) == int(row["faces"])
        assert mesh.watertight == (row["watertight"] == "True")
        tints = np.unique(np.round(mesh.face_colours * 255), axis=0)
        assert len(tints) == len(np.unique(expected.visual.face_colors[:, :3], axis=0))
        longest = normalise(mesh, to="longest")
        np.testing.assert_allclose(np.ptp(longest.bounds, 0), [float(x) for x in row["extent"].split()], atol=6e-4)


def test_the_meshes_of_the_gallery_are_named_and_whole():
    folder = Path(__file__).parents[2] / "examples" / "meshes"
    readme = (folder / "README.md").read_text()
    files = sorted(folder.glob("*.ply"))
    assert 1 <= len(files) <= 10
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000
    for path in files:
        assert f"| {path.name} |" in readme
        assert len(load_mesh(path).faces) > 100


def test_polygons_of_differing_length_are_read_from_text(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 7\n"
    head += "property list uchar int vertex_index\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    rows = [" ".join(map(str, point)) for point in writers.CUBE]
    first, *quads = writers.QUADS
    for polygon in (first[:3], [first[0], *first[2:]], *quads):
        rows.append(" ".join(map(str, [len(polygon), *polygon, 51, 102, 153])))
    mesh = load(tmp_path, "cube.ply", "\n".join([head + "end_header", *rows]).encode())
    np.testing.assert_array_equal(corners(mesh), writers.CUBE[writers.FANS])
    np.testing.assert_allclose(mesh.face_colours, np.tile([0.2, 0.4, 0.6], (12, 1)), atol=1e-6)


def test_materials_in_any_number_reach_an_isolated_parser(tmp_path):
    names = [f"material_{number:05d}_{'x' * 40}" for number in range(3000)]
    (tmp_path / "many.mtl").write_text("".join(f"newmtl {name}\nKd 0.5 0 0\n" for name in names))
    path = tmp_path / "many.obj"
    path.write_text(f"mtllib many.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl {names[-1]}\nf 1 2 3\n")
    np.testing.assert_allclose(load_mesh(path, guarded=True).face_colours, [[0.5, 0, 0]])
