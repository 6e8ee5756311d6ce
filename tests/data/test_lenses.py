"""Lenses and the pinhole cameras that stand in for them."""

import numpy as np
import pytest

from lsmgeo.data import Lens
from lsmgeo.errors import CameraError
from tests.data.posed_writers import see_fisheye, see_perspective

K = np.array([[80.0, 0, 46.7], [0, 82, 33.1], [0, 0, 1]])
LENSES = {
    "barrel": Lens("perspective", K, (-0.2, 0.02, 0.001, -0.002), 72, 96),
    "cushion": Lens("perspective", K, (0.25, 0.05, 0.0, 0.0, 0.02), 72, 96),
    "fisheye": Lens("fisheye", K * [[0.7], [0.7], [1]], (0.03, -0.01, 0.002, 0.0), 72, 96),
}


def seen(lens, rays):
    """Pixels (N, 2) of rays (N, 2), by the documentation's own equations."""
    see = see_fisheye if lens.kind == "fisheye" else see_perspective
    x, y = see(rays[:, 0], rays[:, 1], lens.coefficients)
    return np.stack([x, y], -1) * lens.intrinsics[[0, 1], [0, 1]] + lens.intrinsics[:2, 2]


@pytest.mark.parametrize("name", LENSES)
def test_the_pinhole_view_is_the_widest_without_an_empty_pixel(name):
    lens = LENSES[name]
    for image in (np.full((72, 96), 255, np.uint8), np.full((72, 96, 4), 255, np.uint8)):
        assert int(lens.straighten(image).min()) == 255
    # All of its rim lies in the image, and each side touches the image's own.
    x, y = np.linspace(0, 95, 400), np.linspace(0, 71, 400)
    sides = {"left": (0 * y, y), "right": (0 * y + 95, y), "top": (x, 0 * x), "bottom": (x, 0 * x + 71)}
    for side, rim in sides.items():
        pixels = seen(lens, (np.stack(rim, -1) - lens.pinhole[:2, 2]) / lens.pinhole[[0, 1], [0, 1]])
        assert (pixels > -0.02).all()
        assert (pixels < [95.02, 71.02]).all()
        gap = {"left": pixels[:, 0], "right": 95 - pixels[:, 0], "top": pixels[:, 1], "bottom": 71 - pixels[:, 1]}[side]
        assert gap.min() < 0.1


@pytest.mark.parametrize("name", LENSES)
def test_pixels_go_where_the_pinhole_camera_sees_the_same_ray(name):
    lens = LENSES[name]
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (200, 2))
    expected = rays @ lens.pinhole[:2, :2].T + lens.pinhole[:2, 2]
    np.testing.assert_allclose(lens.straighten_pixels(seen(lens, rays)), expected, atol=1e-6)
    assert lens.straighten_pixels(np.zeros((0, 2))).shape == (0, 2)


def test_pixels_that_the_model_cannot_lead_back_are_nowhere():
    # r (1 - 0.2 r^2) is at most 0.861, that is 69 pixels; and no pinhole camera sees what lies 90 degrees off its axis.
    barrel = Lens("perspective", K, (-0.2, 0.0, 0.0, 0.0), 72, 96)
    for lens, near, far in ((barrel, 55.0, 72.0), (LENSES["fisheye"], 75.0, 56 * 2.2)):
        pixels = lens.straighten_pixels(lens.intrinsics[:2, 2] + [[near, 0], [far, 0]])
        np.testing.assert_array_equal(np.isnan(pixels), [[False, False], [True, True]])


@pytest.mark.parametrize(
    ("kind", "coefficients", "shrunk"),
    [
        ("perspective", (-0.9, 0.0, 0.0, 0.0), 0.5),
        ("perspective", (1e6, -1e6, 0.0, 0.0), 1),
        ("perspective", (-0.73, 0.12, 0.0, 0.05), 1),
        ("fisheye", (0.0, 0.0, 0.0, 0.0), 0.2),
        ("fisheye", (-5.0, 0.0, 0.0, 0.0), 0.7),
    ],
)
def test_a_lens_that_leaves_no_straight_image_says_so(kind, coefficients, shrunk):
    lens = Lens(kind, K * [[shrunk], [shrunk], [1]], coefficients, 72, 96)
    with pytest.raises(CameraError, match="the distortion"):
        lens.pinhole  # noqa: B018
