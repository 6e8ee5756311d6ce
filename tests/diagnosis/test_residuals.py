"""Residuals against closed forms and independent loops."""

import itertools

import numpy as np
import pytest
import torch

from lsmgeo.data.posed_images import Observations, SparsePoints, Voxels
from lsmgeo.diagnosis.depth_consistency import Surfaces, best_neighbour_errors, relative_errors
from lsmgeo.diagnosis.feature_matching import Matches
from lsmgeo.diagnosis.findings import Check, badness
from lsmgeo.diagnosis.half_pixel import find_shifts
from lsmgeo.diagnosis.permutations import assign_cameras, named_permutations, search_permutation
from lsmgeo.diagnosis.residuals import (
    in_front,
    pair_distances,
    reprojection_errors,
    residuals,
    sampson_distances,
    view_costs,
)
from lsmgeo.diagnosis.silhouette_consistency import Cells, Masks, near_cells, silhouette_overlap, within_a_cell
from lsmgeo.diagnosis.two_view_geometry import Geometry, Hypothesis
from lsmgeo.grids import VoxelGrid

RNG = np.random.default_rng(0)


def cameras(count, rng):
    """Cameras around the origin that look roughly at it."""
    K, R, t = [], [], []
    for _ in range(count):
        eye = rng.standard_normal(3)
        eye *= 5 / np.linalg.norm(eye)
        forward = -eye / 5 + 0.05 * rng.standard_normal(3)
        forward /= np.linalg.norm(forward)
        right = np.cross(rng.standard_normal(3), forward)
        right /= np.linalg.norm(right)
        R.append(np.stack([right, np.cross(forward, right), forward]))
        t.append(-R[-1] @ eye)
        K.append(np.array([[400 + 20 * rng.random(), 1.5, 300], [0, 410, 220 + 10 * rng.random()], [0, 0, 1]]))
    return Geometry(*map(np.array, (K, R, t)))


def projected(geometry, view, points):
    image = (points @ geometry.R[view].T + geometry.t[view]) @ geometry.K[view].T
    return image[:, :2] / image[:, 2:]


def matched(geometry, pairs, points, noise=0.0):
    pixels = [np.stack([projected(geometry, a, points), projected(geometry, b, points)], 1) for a, b in pairs]
    pixels = np.concatenate(pixels) + noise * RNG.standard_normal((len(pairs) * len(points), 2, 2))
    first, second = np.array(pairs).T
    return Matches(first, second, np.repeat(np.arange(len(pairs)), len(points)), pixels)


def test_exact_matches_have_no_distance_and_lie_in_front():
    geometry, points = cameras(4, RNG), RNG.uniform(-1, 1, (50, 3))
    matches = matched(geometry, list(itertools.combinations(range(4), 2)), points)
    np.testing.assert_allclose(sampson_distances(matches, geometry), 0, atol=1e-9)
    front = in_front(matches, geometry)
    assert np.nanmin(front) == 1
    # Rotated by 180 degrees about their x axes, both cameras look away from the points.
    rotated = geometry._replace(R=np.diag([1, -1, -1]) @ geometry.R, t=geometry.t * [1, -1, -1])
    flipped = matches._replace(pixels=matched(rotated, list(itertools.combinations(range(4), 2)), points).pixels)
    assert np.nanmax(in_front(flipped, rotated)) == 0


def test_sampson_distance_is_half_the_gap_of_a_sideways_pair():
    """Two cameras side by side: epipolar lines are rows, and the nearest pair on one row is half the gap from each."""
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    geometry = Geometry(np.stack([K, K]), np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-1, 0, 0]]))
    pixels = np.array([[[100.0, 50.0], [90.0, 53.0]], [[10.0, 20.0], [4.0, 20.0]]])
    matches = Matches(np.array([0]), np.array([1]), np.zeros(2, int), pixels)
    np.testing.assert_allclose(np.abs(sampson_distances(matches, geometry)), [3 / np.sqrt(2), 0], atol=1e-12)
    np.testing.assert_allclose(pair_distances(pixels[:1], geometry, np.array([0]), np.array([1])), [3 / np.sqrt(2)])


def test_sampson_distance_is_the_distance_to_the_nearest_consistent_pair():
    """To first order; the nearest consistent pair is found by a general minimiser."""
    from scipy.optimize import minimize

    geometry, points = cameras(2, np.random.default_rng(5)), np.random.default_rng(6).uniform(-1, 1, (6, 3))
    matches = matched(geometry, [(0, 1)], points, noise=0.5)
    expected = []
    for pixels, point in zip(matches.pixels, points, strict=True):

        def cost(x, pixels=pixels):
            return sum(((projected(geometry, v, x[None])[0] - pixels[v]) ** 2).sum() for v in (0, 1))

        expected.append(
            np.sqrt(minimize(cost, point, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).fun)
        )
    np.testing.assert_allclose(np.abs(sampson_distances(matches, geometry)), expected, rtol=1e-2, atol=1e-4)


def test_without_baseline_pixels_are_compared_through_the_rotation():
    geometry = cameras(2, RNG)
    rotation = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    same = Geometry(
        geometry.K,
        np.stack([geometry.R[0], rotation @ geometry.R[0]]),
        np.stack([geometry.t[0], rotation @ geometry.t[0]]),
    )
    matches = matched(same, [(0, 1)], RNG.uniform(-1, 1, (20, 3)))
    np.testing.assert_allclose(sampson_distances(matches, same), 0, atol=1e-8)
    moved = matches._replace(pixels=matches.pixels + np.array([[0, 0], [3.0, 4.0]]))
    np.testing.assert_allclose(sampson_distances(moved, same), 2.5, atol=1e-8)
    np.testing.assert_allclose(residuals(moved, same), np.tile([-1.5, -2.0], (20, 1)), atol=1e-8)
    assert np.isnan(in_front(matches, same)).all()


def test_reprojection_errors_are_the_noise_that_was_added():
    geometry, points = cameras(3, RNG), RNG.uniform(-1, 1, (30, 3))
    noise = RNG.standard_normal((3, 30, 2))
    observed = tuple(Observations(np.arange(30), projected(geometry, v, points) + noise[v]) for v in range(3))
    sparse = SparsePoints(points, np.zeros((30, 3), np.uint8), observed)
    errors, depths, views = reprojection_errors(sparse, geometry)
    np.testing.assert_allclose(errors, np.linalg.norm(noise, axis=2).ravel(), rtol=1e-9)
    assert (depths > 0).all()
    np.testing.assert_array_equal(views, np.repeat([0, 1, 2], 30))
    costs = view_costs(sparse, geometry)
    np.testing.assert_array_equal(assign_cameras(costs), [0, 1, 2])
    np.testing.assert_array_equal(assign_cameras(costs[:, [2, 0, 1]]), [1, 2, 0])


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.5, 0.5), (-0.3, 0.6)])
def test_a_shift_of_the_principal_points_is_measured(x, y):
    from lsmgeo.diagnosis.evidence import Features

    rng = np.random.default_rng(8)
    geometry, points = cameras(8, rng), rng.uniform(-1, 1, (80, 3))
    features = object.__new__(Features)
    features.matches = matched(geometry, list(itertools.combinations(range(8), 2)), points, noise=0.15)
    (shift,) = find_shifts([features], geometry.shifted(x, y))
    np.testing.assert_allclose([shift.x, shift.y], [x, y], atol=0.05)
    assert max(shift.error_x, shift.error_y) < 0.05


def plane_depth(size, slope):
    """Depth seen by a camera in front of the plane z = 4 + slope x, K with f = 200."""
    height, width = size
    _, u = np.mgrid[:height, :width]
    return 4 / (1 - slope * (u - 50) / 200)


def test_depth_of_a_plane_agrees_with_itself_and_with_no_other():
    K = np.array([[200.0, 0, 50], [0, 200, 40], [0, 0, 1]])
    # The second camera is closer by 1, so all its depths are smaller by 1.
    geometry = Geometry(np.stack([K, K]), np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [0, 0, -1]]))
    v, u = (grid.ravel() for grid in np.mgrid[20:60, 25:75])
    maps = (plane_depth((80, 100), 0.0), plane_depth((80, 100), 0.0) - 1)
    surfaces = Surfaces(maps, (1, 1), (np.stack([u, v], 1).astype(float),) * 2, tuple(m[v, u] for m in maps))
    np.testing.assert_allclose(relative_errors(surfaces, Hypothesis(geometry, geometry)), 0, atol=1e-12)
    wrong = surfaces._replace(maps=(maps[0], maps[1] * 1.1), depths=(surfaces.depths[0], surfaces.depths[1] * 1.1))
    found = best_neighbour_errors(wrong, Hypothesis(geometry, geometry))
    np.testing.assert_allclose(found[0][2], 3 / 3.3 - 1)
    np.testing.assert_allclose(found[1][2], 4.3 / 4 - 1)
    # Twice the depth is inconsistent, because the cameras stay one apart.
    errors = relative_errors(surfaces, Hypothesis(geometry, geometry, depth_scale=2.0))
    np.testing.assert_allclose(np.sort(np.unique(np.round(errors, 12))), [7 / 6 - 1, 7 / 8 - 1][::-1])


def test_voxels_fill_their_own_silhouette_and_no_other():
    K = np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]])
    geometry = Geometry(K[None], np.eye(3)[None], np.array([[0.0, 0, 5]]))
    grid = np.stack(np.meshgrid(*[np.arange(-0.45, 0.5, 0.1)] * 3), -1).reshape(-1, 3)
    cells = Cells(grid, 0.1)
    mask = np.zeros((64, 64), bool)
    # A cube of side 1 whose front is 4.5 away spans 100 / 4.5 = 22 pixels.
    mask[21:44, 21:44] = True
    recall, union = silhouette_overlap(Masks((0,), (mask,), (1,)), cells, geometry)
    assert recall[0] == 1
    assert union[0] > 0.85
    recall, union = silhouette_overlap(Masks((0,), (np.roll(mask, 18, 1),), (1,)), cells, geometry)
    assert recall[0] < 0.5
    assert union[0] < 0.2


def test_points_are_at_most_a_cell_away_from_voxels():
    occupied = torch.zeros(9, 9, 9, dtype=torch.bool)
    occupied[3:6, 3:6, 3:7] = True  # up to 6 along x, for the last axis is x
    near, world_from_lattice = near_cells(Voxels(occupied, VoxelGrid(9, -0.5, 8.5)))
    points = np.array([[3.9, 4.0, 4.2], [7.4, 4.0, 4.0], [7.6, 4.0, 4.0], [4.0, 6.6, 4.0], [-30.0, 4.0, 4.0]])
    assert within_a_cell(points, near, world_from_lattice) == pytest.approx(2 / 5)


def test_a_permutation_is_inferred_from_pairs_of_views():
    rng = np.random.default_rng(4)
    count, order = 12, np.random.default_rng(9).permutation(12)
    pairs = [(view, (view + step) % count) for view in range(count - 1) for step in (1, 2)]
    costs = rng.uniform(0.3, 1, (len(pairs), count, count))
    for pair, (a, b) in enumerate(pairs):
        costs[pair, order[a], order[b]] = rng.uniform(0, 0.1)
    found = search_permutation(np.array([a for a, _ in pairs]), np.array([b for _, b in pairs]), costs)
    np.testing.assert_array_equal(found, order)


def test_orders_that_have_names():
    names = ["a10", "a2", "a1"]
    orders = {words: order.tolist() for order, words in named_permutations(names)}
    # As text a1, a10, a2; by number a1, a2, a10: the files' order is neither, and rows are paired by their ranks.
    assert orders["the names ordered by their numbers, not as text"] == [1, 0, 2]
    assert orders["the order reversed"] == [2, 1, 0]
    assert orders["every image at the camera 1 place later"] == [1, 2, 0]
    assert orders["every image at the camera 1 place earlier"] == [2, 0, 1]
    assert len(named_permutations(["9" * 5000, "1" * 5000])) == 2


def test_badness_is_a_multiple_of_the_limit():
    assert badness(Check("error", 3.0, "px", 1.5, 10, "matches")) == 2
    assert badness(Check("share", 80.0, "%", 90.0, 10, "matches", at_least=True)) == 2
    assert badness(Check("error", float("nan"), "px", 1.5, 0, "matches")) == 1e6
    assert badness(Check("error", float("inf"), "px", 1.5, 0, "matches")) == 1e6
