"""Plane sweeps of surfaces known in closed form, and their winners against a loop over pixels."""

from __future__ import annotations

import multiprocessing
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lsmgeo.classical import aggregate_views, matching_costs, sweep, sweep_planes
from lsmgeo.classical.plane_sweep import slab_planes
from lsmgeo.classical.winner_take_all import WinnerTakeAll
from lsmgeo.errors import GridError, OptionError, ShapeError
from tests.classical import analytic
from tests.classical.scored import cameras_of, errors, median_error, swept, within_one_plane


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("surface", analytic.SURFACES)
def test_depth_of_textured_surfaces(surface, seed):
    pictures = analytic.render(surface, seed=seed)
    depths, found = swept(pictures)
    assert within_one_plane(pictures, depths, found) >= (0.98 if surface == "box" else 0.995)
    assert median_error(pictures, found.depth.numpy()) <= 1e-3


@pytest.mark.parametrize("surface", ["slanted", "sphere"])
def test_twice_as_many_planes_halve_the_error(surface):
    pictures = analytic.render(surface)
    medians = []
    for planes in (16, 32, 64):
        depths, found = swept(pictures, planes)
        medians.append(median_error(pictures, depths[found.planes.round().numpy().clip(0).astype(int)]))
    for coarse, fine in pairwise(medians):
        assert 1.7 < coarse / fine < 2.3


@pytest.mark.parametrize("score", ["sad", "census", "cosine"])
def test_the_other_scores_find_the_surface(score):
    pictures = analytic.render("sphere")
    if score == "cosine":  # as features: differences in two directions
        grey = pictures.images[:, 0]
        features = np.stack(np.gradient(grey, axis=(1, 2)), 1).astype(np.float32)
        pictures = pictures._replace(images=features / np.abs(features).max())
    depths, found = swept(pictures, score=score)
    assert within_one_plane(pictures, depths, found) > 0.97
    assert median_error(pictures, found.depth.numpy()) < 3e-3


def test_planes_even_in_depth_are_refined_without_bias():
    pictures = analytic.render("slanted")
    _, found = swept(pictures, 96, "depth")
    assert median_error(pictures, found.depth.numpy()) < 1e-3
    assert abs(np.median(errors(pictures, found.depth.numpy()))) < 2e-4


def test_one_neighbour_is_enough():
    pictures = analytic.render("slanted", views=2)
    depths, found = swept(pictures)
    true = np.interp(-1 / pictures.depth, -1 / depths, np.arange(64))
    near = np.abs(found.planes.round().numpy() - true) <= 1
    assert near[:, 20:-20].mean() > 0.97  # what the neighbour does not see is at the sides


def winners_by_loop(
    costs: np.ndarray, seen: np.ndarray, depths: np.ndarray, apart: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest cost, its place and the lowest elsewhere, along every ray; parabolas by polynomial fits."""
    lowest, places, second = (np.full(costs.shape[1:], value) for value in (1.0, -1.0, 1.0))
    for y, x in np.ndindex(*lowest.shape):
        minima = []
        for k in range(1, len(depths) - 1):
            before, cost, after = costs[k - 1 : k + 2, y, x]
            if seen[k, y, x] and cost <= before and cost < after and cost < 1:
                place = float(k)
                if seen[k - 1, y, x] and seen[k + 1, y, x]:
                    q = 1 / depths[k - 1 : k + 2]
                    a, b, _ = np.polyfit(q - q[1], costs[k - 1 : k + 2, y, x].astype(float), 2)
                    vertex = -b / (2 * a)  # farther planes have the smaller inverse
                    place += vertex / (q[2] - q[1]) if vertex < 0 else -vertex / (q[0] - q[1])
                minima.append((cost, place))
        if not minima:
            continue
        lowest[y, x], places[y, x] = best = min(minima)
        others = [cost for cost, place in minima if abs(place - best[1]) > apart]
        second[y, x] = min([1.0, *others])
    return lowest, places, second


def test_winners_against_a_loop():
    generator = np.random.default_rng(1)
    depths = np.array([1.0, 1.1, 1.3, 1.6, 1.7, 2.0, 2.6, 3.0, 3.1, 4.0, 5.5, 6.0])
    costs = generator.uniform(0, 1.3, (12, 17, 13)).astype(np.float32)
    seen = generator.random(costs.shape) < 0.85
    lowest, places, second = winners_by_loop(costs, seen, depths, 2.5)
    for slab in (1, 2, 5, 12):
        winners = WinnerTakeAll(torch.from_numpy(depths), costs.shape[1:], 1.0)
        for start in range(0, 12, slab):
            winners.push(torch.from_numpy(costs[start : start + slab]), torch.from_numpy(seen[start : start + slab]))
        np.testing.assert_allclose(winners.best, lowest, rtol=1e-6)
        np.testing.assert_allclose(winners.place, places, rtol=0, atol=1e-3)
        found = winners.depth().numpy()
        assert ((found > 0) == (places >= 0)).all()
        expected = 1 / np.interp(places, np.arange(12), 1 / depths)
        np.testing.assert_allclose(found[places >= 0], expected[places >= 0], rtol=1e-4)
        # A minimum that was passed over because it lay beside one that lost later is forgotten; it can only be higher.
        assert (winners.second >= second - 1e-6).all()
        assert (np.abs(winners.second - second) < 1e-6).mean() > 0.9


def test_two_equal_minima_are_not_unique():
    costs = np.ones((9, 1, 3), np.float32)
    costs[2, 0] = 0.2
    costs[6, 0] = (0.2, 0.6, 1.0)
    winners = WinnerTakeAll(torch.arange(1.0, 10.0), (1, 3), 1.0)
    winners.push(torch.from_numpy(costs), torch.ones(costs.shape, dtype=torch.bool))
    np.testing.assert_allclose(winners.place[0], 2, atol=0.3)
    np.testing.assert_allclose(winners.uniqueness()[0], (0, 2 / 3, 0.8), atol=1e-6)


def test_a_sweep_is_its_parts():
    """The costs of OpenCV's sums, aggregated, and their winners, against tensor operations and the loop."""
    pictures = analytic.render("slanted", size=(20, 26), focal=70.0, wavelength=0.16)
    cameras, images = cameras_of(pictures), torch.from_numpy(pictures.images).requires_grad_()
    depths = sweep_planes(cameras, analytic.NEAR, analytic.FAR, 24)
    costs, visible = matching_costs(images, cameras, depths)
    assert 0.5 < float(visible.float().mean()) < 0.99
    for best, least in ((None, 1), (1, 3), (3, 2)):
        cost, count = aggregate_views(costs.detach(), visible, best=best, min_views=least)
        lowest, places, _ = winners_by_loop(cost.numpy(), (count >= least).numpy(), depths.numpy(), 1e9)
        found = sweep(images.detach(), cameras, depths, best=best, min_views=least)
        same = np.abs(found.cost.numpy() - lowest) < 1e-3
        assert same.mean() > 0.995  # elsewhere rounding makes another of two minima the lowest
        agree = np.abs(found.planes.numpy() - places)[same] < 0.1
        assert agree.mean() > 0.99


def test_threads_and_slabs_change_nothing():
    pictures = analytic.render("box")
    _, expected = swept(pictures, 24)
    for threads, memory in ((1, None), (2, None), (3, 1 << 30)):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            _, found = swept(pictures, 24, memory=memory or least_memory(analytic.SIZE))
        finally:
            torch.set_num_threads(before)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)


def least_memory(size: tuple[int, int]) -> int:
    """Bytes without which not even one plane fits, in whole MiB; it depends on the number of threads."""
    with pytest.raises(OptionError) as error:
        slab_planes(3, 1, size, 0)
    return int(str(error.value).split(" MiB")[0].split()[-1]) << 20


def test_what_nobody_sees_has_no_depth():
    pictures = analytic.render("slanted", views=3)
    behind = pictures.E.copy()
    behind[1:, :3] = np.diag([-1.0, 1.0, -1.0]) @ behind[1:, :3]  # the neighbours look the other way
    _, found = swept(pictures._replace(E=behind), 8)
    assert float(found.depth.max()) == float(found.confidence.max()) == 0
    assert float(found.planes.max()) == -1
    torch.testing.assert_close(found.cost, torch.ones_like(found.cost))


def test_sites_that_too_few_see_do_not_win():
    pictures = analytic.render("slanted")
    cameras, depths = cameras_of(pictures), torch.linspace(1.2, 3.6, 16).double()
    images = torch.from_numpy(pictures.images)
    _, visible = matching_costs(images, cameras, depths)
    found = sweep(images, cameras, depths, min_views=3)
    winner = found.planes.round().long()
    count = visible.sum(0).gather(0, winner.clamp_min(0)[None])[0]
    assert bool((count[winner >= 0] == 3).all())
    assert 0 < float((winner < 0).float().mean()) < 0.9


def test_costs_are_filtered_slab_by_slab():
    pictures = analytic.render("slanted")
    shapes = []

    def worse(costs: Tensor) -> Tensor:
        shapes.append((costs.dtype, *costs.shape))
        return costs + 0.25

    _, plain = swept(pictures, 20)
    _, filtered = swept(pictures, 20, cost_filter=worse)
    assert sum(shape[1] for shape in shapes) == 20
    assert {(shape[0], *shape[2:]) for shape in shapes} == {(torch.float32, 72, 96)}
    sure = plain.cost < 0.5
    torch.testing.assert_close(filtered.cost[sure], plain.cost[sure] + 0.25)


def test_confidence_orders_errors():
    pictures = analytic.render("corner")
    noisy = pictures.images + np.random.default_rng(0).normal(0, 0.1, pictures.images.shape).astype(np.float32)
    _, found = swept(pictures._replace(images=noisy))
    order = np.argsort(-found.confidence.numpy()[pictures.mask])
    best, worst = np.array_split(np.abs(errors(pictures, found.depth.numpy()))[order], 2)
    assert (best > 0.02).mean() < 0.5 * (worst > 0.02).mean()


# Memory


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(key)).split()[1]) * 1024


def _measure(connection: Any, size: tuple[int, int]) -> None:
    torch.set_num_threads(2)
    memory = least_memory(size)
    pictures = analytic.render("slanted", size=size)
    swept(pictures, 10, memory=memory)  # what libraries take once
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    swept(pictures, 40, memory=memory)
    connection.send((_status("VmHWM") - before, memory))


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="this system tells no peak")
def test_a_sweep_stays_within_its_memory():
    size = (160, 200)
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(sender, size))
    process.start()
    sender.close()
    added, bound = receiver.recv()
    process.join()
    volume = 4 * 40 * 3 * size[0] * size[1]
    assert 0 < added < bound
    assert added < volume  # of all neighbours' costs


# Planes


def test_planes_of_a_disparity_step():
    """Samples of the centre move by no more than a pixel, and by nearly as much in the view that moves most."""
    pictures = analytic.render("slanted")
    depths = sweep_planes(cameras_of(pictures), 1.5, 3.0, spacing="disparity").numpy()
    height, width = analytic.SIZE
    ray = np.linalg.inv(pictures.K[0]) @ ((width - 1) / 2, (height - 1) / 2, 1)
    longest = 0.0
    for K, E in zip(pictures.K[1:], pictures.E[1:], strict=True):
        points = (depths[:, None] * ray - pictures.E[0, :3, 3]) @ pictures.E[0, :3, :3]
        pixels = (points @ E[:3, :3].T + E[:3, 3]) @ K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        longest = max(longest, float(np.linalg.norm(np.diff(pixels, axis=0), axis=1).mean()))
    assert 0.9 < longest <= 1


def test_three_hundred_planes_by_default():
    cameras = cameras_of(analytic.render("slanted"))
    inverse = sweep_planes(cameras, 1.0, 4.0)
    assert len(inverse) == 300
    np.testing.assert_allclose(np.diff(1 / inverse.numpy()), -0.75 / 299)
    np.testing.assert_allclose(np.diff(sweep_planes(cameras, 1.0, 4.0, 31, "depth").numpy()), 0.1)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"spacing": "log"}, OptionError, "spacing must be one of"),
        ({"num": 2}, OptionError, "num must be a whole number from 3"),
        ({"near": "1"}, OptionError, "near must be a number; got str '1'"),
        ({"far": None}, OptionError, "far must be a number; got NoneType"),
        ({"near": 1e-6, "spacing": "disparity"}, OptionError, "near must be larger for steps of a pixel: "),
        ({"near": 4.0}, GridError, "near and far must be positive, finite and ascending"),
        ({"near": -1.0, "spacing": "disparity"}, GridError, "near and far must be positive, finite and ascending"),
    ],
)
def test_wrong_planes_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        sweep_planes(cameras_of(analytic.render("slanted")), **{"near": 1.0, "far": 3.0, **arguments})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"depths": torch.tensor([1.0, 2.0])}, OptionError, "depths must hold at least 3 planes; got 2"),
        ({"depths": torch.tensor([3.0, 2.0, 1.0])}, GridError, "strictly ascending"),
        ({"min_views": 4}, OptionError, "min_views must be a whole number from 1 to 3; got int 4"),
        ({"min_views": 0}, OptionError, "min_views must be a whole number from 1 to 3; got int 0"),
        ({"best": 4}, OptionError, "best must be a whole number from 1 to 3; got int 4"),
        ({"memory": 1 << 20}, OptionError, r"memory must be at least \d+ MiB for 4 views of 96 x 72; got 1 MiB"),
        ({"score": "ncc"}, OptionError, "score must be one of"),
        ({"window": 2}, OptionError, "window must be odd"),
        ({"images": torch.rand(4, 72, 96)}, ShapeError, r"images must be \(V, C, h, w\)"),
        ({"images": torch.rand(1, 1, 72, 96)}, ShapeError, "V at least 2"),
    ],
)
def test_wrong_arguments_are_named(arguments, error, message):
    pictures = analytic.render("slanted")
    given = {"images": torch.from_numpy(pictures.images), "depths": torch.tensor([1.0, 2.0, 3.0]), **arguments}
    with pytest.raises(error, match=message):
        sweep(given.pop("images"), cameras_of(pictures), given.pop("depths"), **given)
