"""Epipolar tangency of silhouettes known in closed form."""

import itertools

import numpy as np
import pytest

from lsmgeo.diagnosis.silhouette_consistency import epipolar_tangency, silhouette_hull
from lsmgeo.diagnosis.two_view_geometry import Geometry

# An ellipsoid, X = A u + b with |u| = 1: no mirror symmetry, so that mirrored cameras differ.
SHAPE = np.array([[0.42, 0.11, -0.07], [0.0, 0.27, 0.13], [0.0, 0.0, 0.16]])
PLACE = np.array([0.05, -0.03, 0.02])
EYES = [(2.0, 0.3, 0.4), (-0.5, 1.9, 0.2), (0.3, -0.8, 2.1), (-1.6, -0.9, -1.2), (1.1, 1.3, -1.0)]


def camera(eye, roll):
    """K and cam_from_world of a camera that looks near the origin, rolled, with unequal focal lengths and skew."""
    eye = np.array(eye)
    forward = np.array([0.04, 0.02, -0.01]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross([np.sin(roll), 0.2, np.cos(roll)], forward)
    right /= np.linalg.norm(right)
    E = np.eye(4)
    E[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    E[:3, 3] = -E[:3, :3] @ eye
    K = np.array([[310.0, 3.0, 150.0], [0.0, 290.0, 131.0], [0.0, 0.0, 1.0]])
    return K, E


def exact_silhouette(K, E, count=4000):
    """Where rays touch the ellipsoid: on a circle of the unit sphere seen from A^-1 (C - b)."""
    center = -E[:3, :3].T @ E[:3, 3]
    seen_from = np.linalg.solve(SHAPE, center - PLACE)
    distance = np.linalg.norm(seen_from)
    axis = seen_from / distance
    first = np.cross(axis, [0.3, 0.5, 0.8])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    circle = axis / distance + np.sqrt(1 - 1 / distance**2) * (
        np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    )
    pixels = ((circle @ SHAPE.T + PLACE) @ E[:3, :3].T + E[:3, 3]) @ K.T
    return pixels[:, :2] / pixels[:, 2:]


CAMERAS = [camera(eye, 0.4 * index) for index, eye in enumerate(EYES)]
SILHOUETTES = [exact_silhouette(*camera) for camera in CAMERAS]


def both(first, second):
    (K1, E1), (K2, E2) = first, second
    E = np.stack([E1, E2])
    return Geometry(np.stack([K1, K2]), E[:, :3, :3], E[:, :3, 3])


def residuals(cameras, silhouettes=SILHOUETTES):
    pairs = itertools.combinations(range(len(cameras)), 2)
    return np.concatenate(
        [epipolar_tangency(silhouettes[i], silhouettes[j], both(cameras[i], cameras[j])) for i, j in pairs]
    )


def test_silhouettes_of_one_object_touch_the_same_planes():
    errors = residuals(CAMERAS)
    assert np.isfinite(errors).all()
    assert errors.max() < 1e-4  # 4,000 points on a silhouette of some 300 pixels


def test_an_error_is_as_large_as_the_shift_of_a_silhouette():
    K, E = CAMERAS[1]
    for first, second in itertools.permutations(range(len(CAMERAS)), 2):
        cameras = both(CAMERAS[first], CAMERAS[second])
        center = -np.linalg.solve(CAMERAS[first][1][:3, :3], CAMERAS[first][1][:3, 3])
        K, E = CAMERAS[second]
        pixel = K @ (E[:3, :3] @ center + E[:3, 3])
        epipole = pixel[:2] / pixel[2]
        toward = SILHOUETTES[second].mean(0) - epipole
        across = np.array([-toward[1], toward[0]]) / np.linalg.norm(toward)
        errors = epipolar_tangency(SILHOUETTES[first], SILHOUETTES[second] + 0.5 * across, cameras)
        # Half of it, as the other view has nearly the same scale; less where the shift is oblique.
        assert 0.2 < errors.min() <= errors.max() < 1.0


@pytest.mark.parametrize(
    "change",
    [
        lambda K, E: (K, np.linalg.inv(E)),
        lambda K, E: (K, np.diag([1.0, -1.0, -1.0, 1.0]) @ E),
        lambda K, E: (K, np.diag([1.0, -1.0, 1.0, 1.0]) @ E @ np.diag([1.0, -1.0, 1.0, 1.0])),
        lambda K, E: (np.diag([0.5, 0.5, 1.0]) @ K, E),
        lambda K, E: (np.array([[1, 0, 0], [0, 1, 6.0], [0, 0, 1]]) @ K, E),
    ],
)
def test_wrong_cameras_have_large_errors(change):
    errors = residuals([change(*camera) for camera in CAMERAS])
    assert np.nanmedian(errors) > 2.0


def test_exchanged_views_have_large_errors():
    assert np.nanmedian(residuals(CAMERAS, [*SILHOUETTES[1:], SILHOUETTES[0]])) > 2.0


def test_the_world_may_be_moved_mirrored_and_scaled():
    rng = np.random.default_rng(0)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    for mirror in (np.eye(3), np.diag([1.0, 1.0, -1.0])):
        moved = []
        for K, E in CAMERAS:
            pose = np.eye(4)
            pose[:3, :3] = E[:3, :3] @ rotation @ mirror
            pose[:3, 3] = 7.0 * E[:3, 3] + pose[:3, :3] @ [30.0, 5.0, -11.0]
            moved.append((K, pose))
        found, expected = (np.sort(errors.reshape(-1, 2)) for errors in (residuals(moved), residuals(CAMERAS)))
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_there_is_no_distance_where_the_baseline_meets_the_object():
    first, second = camera((2.0, 0.1, 0.0), 0.0), camera((-2.0, 0.1, 0.0), 0.0)
    assert np.isnan(epipolar_tangency(exact_silhouette(*first), exact_silhouette(*second), both(first, second))).all()
    same = epipolar_tangency(SILHOUETTES[0], SILHOUETTES[0], both(CAMERAS[0], CAMERAS[0]))
    assert np.isnan(same).all()


def test_the_hull_is_that_of_the_pixel_centres():
    mask = np.zeros((20, 30), bool)
    assert silhouette_hull(mask) is None
    mask[5:9, 7:12] = True
    mask[6, 8] = False
    points = silhouette_hull(mask)
    assert points.min(0).tolist() == [7, 5]
    assert points.max(0).tolist() == [11, 8]
    mask[0, 3] = True
    assert silhouette_hull(mask) is None  # it touches the image border
