"""Solids, materials and lights as values, and errors of invalid ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lsmgeo import scenes
from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.errors import DTypeError, GridError, OptionError, ShapeError

AXES = np.eye(3)
VIEW = orbit(torch.zeros(1, 1), 0.0, 2.0, focal_length=20.0, height=9, width=9)
SUN = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.6), torch.full((3,), 0.3))
NO_VIEW = CameraTensors(torch.zeros(1, 0, 3, 3), torch.zeros(1, 0, 4, 4), 9, 9)
BALL = scenes.Scene([scenes.sphere((0, 0, 0), 0.4)])


def inside(solid: scenes.Solid, *points: tuple[float, float, float]) -> list[bool]:
    return scenes.occupancy([scenes.Scene([solid])], torch.tensor([points], dtype=torch.float64))[0].tolist()


def test_solids_contain_their_points():
    assert inside(scenes.box((1, 2, 3), (2, 4, 6)), (1.9, 3.9, 5.9), (2.1, 2, 3)) == [True, False]
    assert inside(scenes.ellipsoid((0, 0, 0), (1, 2, 3)), (0, 1.9, 0), (0, 0, 2.9), (0.9, 0.9, 0)) == [
        True,
        True,
        False,
    ]
    assert inside(scenes.cylinder((0, 0, 0), (0, 0, 2), 0.5), (0.4, 0, 1.9), (0, 0, 2.1), (0.4, 0.4, 1)) == [
        True,
        False,
        False,
    ]
    tapered = scenes.cone((0, 0, 0), (2, 0, 0), 1.0, 0.5)
    assert inside(tapered, (0.1, 0.9, 0), (1.9, 0.5, 0), (1.9, 0.9, 0)) == [True, True, False]
    # The wider end may be second.
    widening = scenes.cone((0, 0, 0), (2, 0, 0), 0.5, 1.0)
    assert inside(widening, (0.1, 0.9, 0), (1.9, 0.9, 0)) == [False, True]
    assert inside(scenes.half_space((0, 1, 0), (0, 2, 0)), (5, 0.9, 5), (0, 1.1, 0)) == [True, False]


def test_a_cut_changes_only_its_own_solid():
    hole = scenes.cylinder((-1, 0, 0), (1, 0, 0), 0.2)
    drilled, whole = scenes.box((0, 0, 0), (1, 1, 1)).minus(hole), scenes.box((0, 0, 0.1), (0.1, 1, 1))
    assert inside(drilled, (0, 0, 0), (0, 0.3, 0)) == [False, True]
    both = scenes.Scene([drilled, whole])
    assert scenes.occupancy([both], torch.tensor([[[0.0, 0, 0], [0.3, 0, 0]]]))[0].tolist() == [True, False]


def test_solids_may_be_tiny_and_colours_lists():
    assert inside(scenes.sphere((0, 0, 0), 1e-9), (0, 0, 5e-10), (0, 0, 2e-9)) == [True, False]
    assert inside(scenes.box((0, 0, 0), (1e-3, 1e-3, 1e-9)), (0, 0, 4e-10), (0, 0, 6e-10)) == [True, False]
    assert scenes.Material(np.array([0.1, 0.2, 0.3])) == scenes.Material((0.1, 0.2, 0.3))


def test_moves_compose_as_matrices():
    solid = scenes.box((0.1, 0.2, 0.3), (0.4, 0.5, 0.6)).minus(scenes.sphere((0.1, 0.2, 0.3), 0.1))
    turned = solid.rotated(2, 90.0, center=(1, 0, 0)).moved((0, 0, 1)).scaled((1, 2, 1))
    # (x, y, z) -> about (1, 0, 0) by 90 degrees: (1 - y, x - 1, z) -> z + 1 -> y doubled
    expected = np.array([[0, -1, 0, 1], [2, 0, 0, -2], [0, 0, 1, 1]]) @ np.r_[solid.world_from_local, [[0, 0, 0, 1]]]
    np.testing.assert_allclose(turned.world_from_local, expected, atol=1e-12)
    cut = np.r_[solid.cuts[0].world_from_local, [[0, 0, 0, 1]]]
    np.testing.assert_allclose(
        turned.cuts[0].world_from_local, np.array([[0, -1, 0, 1], [2, 0, 0, -2], [0, 0, 1, 1]]) @ cut, atol=1e-12
    )
    assert inside(solid.mirrored(0), (-0.25, 0.2, 0.3), (0.25, 0.2, 0.3)) == [True, False]


def test_voxels_of_a_ball_are_those_with_centres_inside():
    found = scenes.voxels([scenes.Scene([scenes.sphere((0.1, 0, -0.05), 0.3)])], 16)[0]
    steps = -0.5 + (np.arange(16) + 0.5) / 16
    z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
    np.testing.assert_array_equal(found.numpy(), (x - 0.1) ** 2 + y**2 + (z + 0.05) ** 2 <= 0.09)


def colour_at(material: scenes.Material, y: float) -> np.ndarray:
    """The albedo of a wall at height y, from ambient light only."""
    wall = scenes.Scene([scenes.box((0, 0, 0), (1, 4, 4), material)])
    view = orbit(torch.zeros(1, 1), 0.0, 2.5, focal_length=9.0, height=1, width=1, target=(0, y, 0))
    ambient = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
    return scenes.render([wall], view, ambient, dtype=torch.float64).images[0, 0, :, 0, 0].numpy()


def test_textures_mix_two_colours():
    one, other = (1.0, 0.5, 0.0), (0.0, 0.5, 1.0)
    heights = np.linspace(-1, 1, 41)
    assert np.allclose([colour_at(scenes.Material(one), y) for y in heights[:3]], one)
    for texture in ("stripes", "waves", "checker"):
        colours = np.array([colour_at(scenes.Material(one, texture, other, 3.0, seed=5), y) for y in heights])
        np.testing.assert_allclose(colours[:, 1], 0.5)
        np.testing.assert_allclose(colours[:, 0] + colours[:, 2], 1.0)  # on the line between the two
        assert colours[:, 0].max() > 0.7
        assert colours[:, 0].min() < 0.3
        if texture == "checker":
            assert set(colours[:, 0].round(9)) == {0.0, 1.0}
        again = [colour_at(scenes.Material(one, texture, other, 3.0, seed=6), y) for y in heights]
        assert np.abs(colours - again).max() > 0.1


def test_shading_adds_lights_and_stops_at_white():
    lights = scenes.Lights(
        torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.6, 0.8]]),
        torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.5]]),
        torch.full((3,), 0.1),
    )
    up = torch.tensor([0.0, 1.0, 0.0])
    expected = torch.tensor([0.6, 0.6, 0.9])
    torch.testing.assert_close(scenes.shade(torch.ones(3), up, lights), expected)
    torch.testing.assert_close(scenes.shade(torch.full((3,), 2.0), up, lights), torch.ones(3))
    shadowed = scenes.shade(torch.ones(3), up, lights, torch.tensor([False, True]))
    torch.testing.assert_close(shadowed, torch.tensor([0.1, 0.1, 0.4]))
    torch.testing.assert_close(scenes.shade(torch.ones(3), -up, lights), torch.full((3,), 0.1))


def test_backgrounds_lie_behind():
    picture = torch.rand(3, 9, 9, generator=torch.Generator().manual_seed(0))
    found = scenes.render([BALL], VIEW, SUN, background=picture)
    outside = ~found.mask[0, 0]
    assert outside.any()
    torch.testing.assert_close(found.images[0, 0][:, outside], picture[:, outside])
    assert not torch.isclose(found.images[0, 0][:, ~outside], picture[:, ~outside]).all()
    # Of any layout in memory.
    turned = picture.permute(1, 2, 0).contiguous().permute(2, 0, 1).expand(1, 1, 3, 9, 9)
    torch.testing.assert_close(scenes.render([BALL], VIEW, SUN, background=turned).images, found.images)
    views = orbit(torch.zeros(2, 3), 0.0, 2.0, focal_length=20.0, height=9, width=9)
    swapped = torch.zeros(3, 2, 3, 9, 9).transpose(0, 1)
    both = scenes.render([BALL, BALL], views, SUN, background=swapped)
    torch.testing.assert_close(both.images[1, 2][:, ~outside], found.images[0, 0][:, ~outside])


def test_batches_are_loops():
    box = scenes.Scene([scenes.box((0, 0, 0), (0.5, 0.3, 0.4))])
    views = orbit(
        torch.tensor([[0.0, 50.0, 100.0], [10.0, 60.0, 200.0]]), 15.0, 2.0, focal_length=20.0, height=9, width=11
    )
    lights = scenes.Lights(
        torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]]]), torch.full((2, 1, 3), 0.5), torch.tensor([[0.1] * 3, [0.4] * 3])
    )
    both = scenes.render([BALL, box], views, lights)
    for index, scene in enumerate((BALL, box)):
        for view in range(3):
            some = (slice(index, index + 1), slice(view, view + 1))
            one = CameraTensors(views.intrinsics[some], views.cam_from_world[some], 9, 11)
            alone = scenes.render([scene], one, scenes.Lights(*(value[index] for value in lights)))
            for name in both._fields:
                torch.testing.assert_close(getattr(both, name)[index, view], getattr(alone, name)[0, 0], rtol=0, atol=0)


def test_another_size_sees_the_same():
    """K is resized for the size: at an odd ratio a coarse pixel has the centre of a fine one."""
    coarse = scenes.render([BALL], VIEW, SUN).depth
    fine = scenes.render([BALL], VIEW, SUN, size=(27, 27)).depth
    torch.testing.assert_close(fine[..., 1::3, 1::3], coarse, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: scenes.sphere((0, 0, 0), 0), "radii must be positive"),
        (lambda: scenes.sphere((0, 0, 0), math.nan), "radii must be positive"),
        (lambda: scenes.box((0, 0, 0), (1, -1, 1)), "size must be positive"),
        (lambda: scenes.box((0, 0, 0), (1, 1)), "size must be positive"),
        (lambda: scenes.box((0, math.inf, 0), (1, 1, 1)), "finite"),
        (lambda: scenes.cylinder((0, 0, 0), (0, 0, 0), 1), "direction of finite length"),
        (lambda: scenes.cylinder((0, 0, 0), (0, 1, 0), -1), "radius must be positive"),
        (lambda: scenes.cone((0, 0, 0), (0, 1, 0), 1, -1), "radii must not be negative"),
        (lambda: scenes.half_space((0, 0, 0), (0, 0, 0)), "direction of finite length"),
        (lambda: scenes.sphere((0, 0, 0), 1).scaled((1, 0, 1)), "invertible"),
        (lambda: scenes.Material(texture="marble"), "plain, stripes, checker, waves"),
        (lambda: scenes.Material((1, 2, 0)), r"three numbers in \[0, 1\]"),
        (lambda: scenes.Material(frequency=0), "frequency must be positive"),
        (lambda: scenes.Material("red"), "three numbers"),
        (lambda: scenes.Material(seed=-1), "seed must be a whole number"),
        (lambda: BALL.transformed(np.eye(3)), "must be affine"),
        (lambda: scenes.Scene([]), "at least one Solid"),
        (lambda: scenes.Scene(["ball"]), "at least one Solid"),
        (lambda: BALL.solids[0].minus(BALL.solids[0].minus(BALL.solids[0])), "no cuts of their own"),
        (lambda: BALL.solids[0].minus(1), "must be Solids"),
    ],
)
def test_invalid_scenes_are_refused(make, words):
    with pytest.raises(OptionError, match=words):
        make()


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: scenes.render(BALL, VIEW, SUN), OptionError, "sequence of Scene"),
        (lambda: scenes.render([], VIEW, SUN), ShapeError, "at least one Scene"),
        (lambda: scenes.render(None, VIEW, SUN), OptionError, "sequence of Scene"),
        (lambda: scenes.render([BALL], NO_VIEW, SUN), ShapeError, "V = 0"),
        (lambda: scenes.render([BALL, BALL], VIEW, SUN), ShapeError, "S = 2 scenes"),
        (lambda: scenes.render([BALL], VIEW, SUN, dtype=torch.float16), DTypeError, "float32 or torch.float64"),
        (lambda: scenes.render([BALL], VIEW, "sun"), DTypeError, "must be Lights"),
        (lambda: scenes.render([BALL], VIEW, SUN._replace(ambient=torch.ones(2))), ShapeError, "lights.ambient"),
        (lambda: scenes.render([BALL], VIEW, SUN._replace(colours=torch.ones(2, 3))), ShapeError, "must agree"),
        (lambda: scenes.render([BALL], VIEW, SUN, background=(1, 1)), ShapeError, "background"),
        (lambda: scenes.render([BALL], VIEW, SUN, near=0), OptionError, "near must be a positive number"),
        (lambda: scenes.trace([BALL], torch.zeros(1, 4, 2), torch.zeros(1, 4, 2)), ShapeError, r"\(S, N, 3\)"),
        (lambda: scenes.trace([BALL], torch.zeros(1, 4, 3), torch.zeros(1, 5, 3)), ShapeError, "must agree"),
        (lambda: scenes.occupancy([BALL], torch.zeros(3, 4, 3)), ShapeError, "S = 1 scenes"),
        (lambda: scenes.voxels([BALL], 0), ValueError, "at least"),
        (lambda: scenes.voxels([BALL], "many"), GridError, "shape must be"),
    ],
)
def test_bad_arguments_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call()
