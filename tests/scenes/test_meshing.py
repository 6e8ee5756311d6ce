"""Meshes of analytic scenes: closed, of the correct volume, and with the scene's occupancy."""

import numpy as np
import pytest
import torch

from lsmgeo import scenes
from lsmgeo.errors import OptionError
from lsmgeo.scenes import (
    Material,
    Scene,
    box,
    cone,
    cylinder,
    ellipsoid,
    half_space,
    sphere,
    synthetic13,
    to_mesh,
)

SHEAR = np.array([[1.0, 0.4, 0.0, 0.1], [0.0, 2.0, 0.3, -0.2], [0.2, 0.0, 0.7, 0.05]])


def polygon(segments):
    """The area of a regular polygon relative to its circle."""
    angle = 2 * np.pi / segments
    return np.sin(angle) / angle


EXACT = {
    "box": (box((0.1, 0.2, 0.3), (1, 2, 3)), 6.0),
    "turned": (box((1, 0, 0), (1, 2, 3)).rotated(0, 33), 6.0),
    "sheared": (box((0, 0, 0), (1, 2, 3)).transformed(SHEAR), 6.0 * np.linalg.det(SHEAR[:, :3])),
    "mirrored": (box((1, 0, 0), (1, 2, 3)).mirrored(0), 6.0),
    "halved": (box((0, 0, 0), (1, 2, 3)).minus(half_space((0, 0, 0), (1, 1, 1))), 3.0),
    "cornered": (
        box((5, 0, 0), (1, 1, 1)).minus(half_space((5, 0, 0), (1, 0, 0)), half_space((5, 0, 0), (0, 0, -1))),
        0.25,
    ),
    "spared": (box((0, 0, 0), (1, 1, 1)).minus(half_space((0, -9, 0), (0, 1, 0))), 1.0),
    "drilled": (box((0, 0, 0), (1, 1, 1)).minus(box((0, 0, 0), (0.5, 0.5, 2))), 0.75),
}
ROUND = {
    "cylinder": (cylinder((0, 0, 0), (1, 2, 2), 0.5), np.pi * 0.25 * 3),
    "cone": (cone((0, 0, 0), (0, 0, 3), 0.5), np.pi * 0.25),
    "frustum": (cone((0, 1, 0), (2, 1, 0), 0.2, 0.4), np.pi * 2 / 3 * (0.04 + 0.08 + 0.16)),
}


@pytest.mark.parametrize("name", EXACT)
def test_flat_solids_have_their_volume(name):
    solid, expected = EXACT[name]
    mesh = to_mesh(Scene([solid]))
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, expected, rtol=1e-9)


@pytest.mark.parametrize("segments", [8, 64])
@pytest.mark.parametrize("name", ROUND)
def test_round_solids_have_the_volume_of_their_polygon(name, segments):
    solid, expected = ROUND[name]
    mesh = to_mesh(Scene([solid]), segments=segments)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, expected * polygon(segments), rtol=1e-9)


def test_a_ball_converges_with_the_square_of_the_segments():
    ball = Scene([ellipsoid((0.3, 0, 0), (1, 2, 3)).minus(half_space((0.3, 0, 0), (1, 2, 0)))])
    expected = 4 / 3 * np.pi * 6 / 2
    errors = [expected - to_mesh(ball, segments=segments).volume for segments in (32, 64, 128)]
    assert errors[2] > 0
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4, rtol=0.05)


def test_round_solids_reach_their_bounds():
    for solid in (sphere((0, 0, 0), 0.5), cylinder((0, 0, 0), (0, 1, 0), 0.3)):
        np.testing.assert_allclose(to_mesh(Scene([solid])).bounds, solid.bounds(), atol=1e-9)


def test_parts_that_overlap_are_counted_once():
    cross = Scene([box((0, 0, 0), (3, 1, 1)), box((0, 0, 0), (1, 3, 1)), box((9, 0, 0), (1, 1, 1))])
    mesh = to_mesh(cross)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, 6.0, rtol=1e-9)


def test_a_cut_does_not_change_other_parts():
    hollow = box((0, 0, 0), (1, 1, 1)).minus(box((0, 0, 0), (0.8, 0.8, 0.8)))
    mesh = to_mesh(Scene([hollow, box((0, 0, 0), (0.5, 0.5, 0.5))]))
    np.testing.assert_allclose(mesh.volume, 1 - 0.8**3 + 0.5**3, rtol=1e-9)


def test_faces_have_the_colours_of_their_parts():
    red, blue = Material((1.0, 0.0, 0.0)), Material((0.0, 0.0, 1.0))
    pierced = box((0, 0, 0), (1, 1, 1), red).minus(box((0, 0, 0), (0.5, 0.5, 2), blue))
    mesh = to_mesh(Scene([pierced, box((5, 0, 0), (1, 1, 1), blue)]))
    colours = np.asarray(mesh.visual.face_colors)
    first = mesh.triangles_center[:, 0] < 2
    np.testing.assert_array_equal(np.unique(colours[first], axis=0), [[255, 0, 0, 255]])
    np.testing.assert_array_equal(np.unique(colours[~first], axis=0), [[0, 0, 255, 255]])
    # The walls of the hole have the colour of the part with the cut.
    np.testing.assert_allclose(mesh.area_faces[first].sum(), 4 + 2 * 0.75 + 4 * 0.5, rtol=1e-9)


@pytest.mark.parametrize("category", synthetic13.CATEGORIES)
def test_shapes_are_watertight(category):
    for index in range(2):
        shape = synthetic13.shape(0, index, category)
        mesh = to_mesh(shape.scene, segments=32)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        low, high = shape.scene.bounds()
        assert 0 < mesh.volume < np.prod(high - low)
        assert (mesh.bounds[0] >= low - 1e-9).all()
        assert (mesh.bounds[1] <= high + 1e-9).all()


@pytest.mark.parametrize(("index", "category"), [(0, "cabinet"), (3, "lamp"), (1, "vessel")])
def test_the_mesh_has_the_occupancy_of_the_scene(index, category):
    """Points differ only between the polyhedron and the curve: 128 segments of radius 0.5 deviate by 1.5e-4."""
    scene = synthetic13.shape(0, index, category).scene
    mesh = to_mesh(scene, segments=128)
    points = np.random.default_rng(0).uniform(*scene.bounds(), size=(4000, 3))
    expected = scenes.occupancy([scene], torch.from_numpy(points)[None])[0].numpy()
    found = mesh.contains(points)
    assert expected.any()
    assert not expected.all()
    # Where they differ, the scene's surface is closer than that: some point around is on its other side.
    differing = points[found != expected]
    assert len(differing) < 12
    around = np.random.default_rng(1).normal(size=(200, 3))
    around *= 1e-3 / np.linalg.norm(around, axis=1, keepdims=True)
    inside = scenes.occupancy([scene], torch.from_numpy(differing[:, None] + around)[None])[0].numpy()
    assert (inside != expected[found != expected][:, None]).any(1).all()


def test_scenes_without_a_closed_surface_are_refused():
    with pytest.raises(OptionError, match="half-space has no closed surface"):
        to_mesh(Scene([box((0, 0, 0), (1, 1, 1)), half_space((0, 0, 0), (0, 1, 0))]))
    with pytest.raises(OptionError, match="Scene"):
        to_mesh(box((0, 0, 0), (1, 1, 1)))


@pytest.mark.parametrize("segments", [4, 10, 16.0, True])
def test_the_segments_are_checked(segments):
    with pytest.raises(OptionError, match="segments must be a multiple of 4"):
        to_mesh(Scene([sphere((0, 0, 0), 1)]), segments=segments)
