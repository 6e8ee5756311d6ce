"""Matching costs against loops over pixels in NumPy, and the laws that they keep."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import aggregate_views, matching_costs
from lsmgeo.classical.sweep_options import SCORES
from lsmgeo.errors import CameraError, DTypeError, GridError, OptionError, ShapeError
from tests.oracle import backproject, is_in_image, pixel_lattice, project, resize_intrinsics, sample

SIZE = (9, 12)
DEPTHS = (1.3, 1.9, 2.6)
NOISE = 0.02


def rigid(angles: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    """World-to-camera from small turns about x, y and z."""
    matrix = np.eye(4)
    for axis, angle in enumerate(angles):
        turn = np.eye(3)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn[first, first] = turn[second, second] = np.cos(angle)
        turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
        matrix[:3, :3] = matrix[:3, :3] @ turn
    matrix[:3, 3] = translation
    return matrix


def ugly_cameras(size: tuple[int, int] = SIZE, views: int = 4) -> CameraTensors:
    """Skewed, turned and rolled; the second neighbour is upside down, the third sees little."""
    height, width = size
    K = np.array([[13.0, 0.4, width / 2 - 0.9], [0.0, 14.5, height / 2 - 0.2], [0.0, 0.0, 1.0]])
    poses = [
        rigid((0.02, -0.03, 0.05), (0.1, 0.05, 0.2)),
        rigid((0.03, 0.09, 0.1), (-0.25, 0.06, 0.15)),
        rigid((-0.05, -0.08, np.pi), (0.3, -0.1, 0.25)),
        rigid((0.0, -0.35, 0.3), (0.9, 0.3, 0.1)),
    ]
    intrinsics = np.stack([K + np.diag([view, 0.5 * view, 0.0]) for view in range(views)])
    return CameraTensors(torch.from_numpy(intrinsics), torch.from_numpy(np.stack(poses[:views])), height, width)


def random_images(channels: int, size: tuple[int, int] = SIZE, views: int = 4, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(views, channels, *size, generator=generator, dtype=torch.float64)


def expected_costs(
    images: np.ndarray, cameras: CameraTensors, depths: np.ndarray, size: tuple[int, int], score: str, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Costs and visibility (V-1, P, h, w), pixel by pixel."""
    K, E = cameras.intrinsics.numpy(), cameras.cam_from_world.numpy()
    frame = (int(cameras.height), int(cameras.width))
    if score in ("zncc", "census") and images.shape[1] == 3:
        images = np.einsum("vchw,c->vhw", images, [0.299, 0.587, 0.114])[:, None]
    stored = images.shape[2:]
    pixels = pixel_lattice(size)

    def seen_by(view: int, depth: float) -> tuple[np.ndarray, np.ndarray]:
        first = resize_intrinsics(K[0], frame, size)
        points = backproject(first, E[0, :3, :3], E[0, :3, 3], pixels, np.full(len(pixels), depth))
        there, z = project(resize_intrinsics(K[view], frame, stored), E[view, :3, :3], E[view, :3, 3], points)
        values = sample(images[view], there, padding_mode="border").reshape(-1, *size)
        return values, (is_in_image(there, stored) & (z > 0)).reshape(size)

    reference = seen_by(0, float(depths[0]))[0]
    costs = np.zeros((len(images) - 1, len(depths), *size))
    visible = np.zeros(costs.shape, dtype=bool)
    for view, plane in np.ndindex(*costs.shape[:2]):
        warped, visible[view, plane] = seen_by(view + 1, float(depths[plane]))
        for y, x in np.ndindex(*size):
            rows = slice(max(0, y - window // 2), y + window // 2 + 1)
            columns = slice(max(0, x - window // 2), x + window // 2 + 1)
            r, s = reference[:, rows, columns], warped[:, rows, columns]
            if score == "zncc":
                covariance = ((r - r.mean()) * (s - s.mean())).mean()
                value = 1 - covariance / np.sqrt((r.var() + NOISE**2) * (s.var() + NOISE**2))
            elif score == "sad":
                value = np.abs(r - s).mean()
            elif score == "cosine":
                value = 1 - (r * s).mean() / np.sqrt(((r * r).mean() + NOISE**2) * ((s * s).mean() + NOISE**2))
            else:
                differing = (r < reference[:, y, x]) != (s < warped[:, y, x])
                value = 2 * differing.sum() / max(r.size - 1, 1)
            costs[view, plane, y, x] = value
    return costs, visible


@pytest.mark.parametrize("window", [1, 3, 5])
@pytest.mark.parametrize(("score", "channels"), [("zncc", 3), ("sad", 3), ("census", 1), ("cosine", 4)])
def test_every_pixel_costs_what_a_loop_says(score, channels, window):
    images, cameras = random_images(channels), ugly_cameras()
    expected, seen = expected_costs(images.numpy(), cameras, np.array(DEPTHS), SIZE, score, window)
    found = matching_costs(
        images, cameras, torch.tensor(DEPTHS, dtype=torch.float64), score=score, window=window, noise=NOISE
    )
    assert found.costs.dtype == torch.float64
    assert 0.2 < seen.mean() < 0.9
    np.testing.assert_array_equal(found.visible.numpy(), seen)
    np.testing.assert_allclose(found.costs.numpy(), expected, rtol=1e-9, atol=1e-10)


def test_cameras_of_larger_originals_give_the_same():
    images, cameras = random_images(1), ugly_cameras()
    scale = torch.diag(torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64))
    K = scale @ cameras.intrinsics
    K[:, 0, 2] += 0.5 * 3 - 0.5
    K[:, 1, 2] += 0.5 * 2 - 0.5
    originals = CameraTensors(K, cameras.cam_from_world, 2 * SIZE[0], 3 * SIZE[1])
    depths = torch.tensor(DEPTHS, dtype=torch.float64)
    for expected, found in zip(
        matching_costs(images, cameras, depths), matching_costs(images, originals, depths), strict=True
    ):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("window", [1, 3, 7, 11])
@pytest.mark.parametrize("size", [(23, 31), (4, 5)])
def test_without_derivatives_costs_are_the_same(window, size):
    """OpenCV's sums against tensor operations, also where windows are larger than the image."""
    images = random_images(1, size).float()
    depths = torch.tensor(DEPTHS)
    with torch.no_grad():
        fast = matching_costs(images, ugly_cameras(size), depths, window=window)
    slow = matching_costs(images.requires_grad_(), ugly_cameras(size), depths, window=window)
    assert slow.costs.requires_grad
    torch.testing.assert_close(fast.costs, slow.costs.detach(), rtol=0, atol=2e-4)
    torch.testing.assert_close(fast.visible, slow.visible)


@pytest.mark.parametrize("score", SCORES)
def test_views_at_once_are_views_alone(score):
    images, cameras, depths = random_images(3), ugly_cameras(), torch.tensor(DEPTHS, dtype=torch.float64)
    together = matching_costs(images, cameras, depths, score=score)
    for view in range(1, 4):
        pair = [0, view]
        two = CameraTensors(cameras.intrinsics[pair], cameras.cam_from_world[pair], *SIZE)
        alone = matching_costs(images[pair], two, depths, score=score)
        # The mean of the reference, which is taken away, is the same.
        torch.testing.assert_close(together.costs[view - 1 : view], alone.costs, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(together.visible[view - 1 : view], alone.visible)


def test_correlation_does_not_see_gain_and_offset():
    images, depths = random_images(1), torch.tensor(DEPTHS, dtype=torch.float64)
    gain = torch.tensor([0.3, 2.0, 0.7, 5.0], dtype=torch.float64)[:, None, None, None]
    offset = torch.tensor([0.2, -0.4, 3.0, 0.0], dtype=torch.float64)[:, None, None, None]
    expected = matching_costs(images, ugly_cameras(), depths, noise=1e-9).costs
    found = matching_costs(gain * images + offset, ugly_cameras(), depths, noise=1e-9).costs
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("derivatives", [True, False])
def test_what_has_no_texture_resembles_nothing(derivatives):
    images = torch.full((3, 1, *SIZE), 0.7)
    images[2] = random_images(1, views=1)[0].float()
    with torch.set_grad_enabled(derivatives):
        costs = matching_costs(images, ugly_cameras(views=3), torch.tensor(DEPTHS)).costs
    torch.testing.assert_close(costs, torch.ones_like(costs), rtol=0, atol=1e-4)


def test_an_image_costs_nothing_against_itself():
    """Two cameras in one place: every plane shows the same."""
    images = random_images(3, views=1).repeat(2, 1, 1, 1)
    cameras = ugly_cameras(views=1)
    twice = CameraTensors(cameras.intrinsics.repeat(2, 1, 1), cameras.cam_from_world.repeat(2, 1, 1), *SIZE)
    for score in ("sad", "census"):
        costs = matching_costs(images, twice, torch.tensor(DEPTHS, dtype=torch.float64), score=score).costs
        assert float(costs.abs().max()) < (1e-9 if score == "sad" else 0.5)
    for score in ("zncc", "cosine"):
        costs = matching_costs(images, twice, torch.tensor(DEPTHS, dtype=torch.float64), score=score, noise=1e-6).costs
        torch.testing.assert_close(costs, torch.zeros_like(costs), rtol=0, atol=1e-9)


@pytest.mark.parametrize("score", ["zncc", "sad", "cosine"])
def test_gradients(score):
    """Towards images, depths and cameras, at places that are no kinks."""
    size = (4, 5)
    images = random_images(2 if score != "zncc" else 1, size, views=2, seed=3).requires_grad_()
    cameras = ugly_cameras(size, views=2)
    K = cameras.intrinsics.clone()
    change = torch.zeros_like(K, requires_grad=True)
    E = cameras.cam_from_world.clone()
    translation = E[:, :3, 3].clone().requires_grad_()
    depths = torch.tensor([1.37, 2.11], dtype=torch.float64, requires_grad=True)
    # Entries that a calibration has; the others must stay what they are.
    free = torch.tensor([[1.0, 1, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)

    def costs(images: Tensor, change: Tensor, translation: Tensor, depths: Tensor) -> Tensor:
        moved = torch.cat((torch.cat((E[:, :3, :3], translation[..., None]), -1), E[:, 3:]), 1)
        return matching_costs(
            images, CameraTensors(K + change * free, moved, *size), depths, score=score, window=3
        ).costs

    assert torch.autograd.gradcheck(costs, (images, change, translation, depths), eps=1e-7, atol=1e-5)


def test_aggregation_against_a_loop():
    generator = np.random.default_rng(0)
    costs, visible = generator.random((5, 3, 4, 6)), generator.random((5, 3, 4, 6)) < 0.5
    for best, least in ((1, 1), (3, 1), (3, 2), (5, 4)):
        expected = np.ones(costs.shape[1:])
        for index in np.ndindex(*expected.shape):
            seen = sorted(costs[(slice(None), *index)][visible[(slice(None), *index)]])
            if len(seen) >= least:
                expected[index] = np.mean(seen[:best])
        found, count = aggregate_views(torch.from_numpy(costs), torch.from_numpy(visible), best=best, min_views=least)
        np.testing.assert_array_equal(count.numpy(), visible.sum(0))
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_half_of_the_neighbours_rounded_up_are_taken():
    costs = torch.tensor([0.1, 0.2, 0.6, 0.9, 1.1])
    for number, expected in ((1, 0.1), (2, 0.1), (3, 0.15), (4, 0.15), (5, 0.3)):
        few = costs[:number, None, None, None]
        cost, _ = aggregate_views(few, torch.ones_like(few, dtype=torch.bool))
        assert float(cost) == pytest.approx(expected)


def test_gradients_flow_through_aggregation():
    costs = random_images(2, (2, 3), views=4, seed=5).requires_grad_()
    visible = random_images(2, (2, 3), views=4, seed=6) < 0.7
    assert torch.autograd.gradcheck(lambda costs: aggregate_views(costs, visible)[0], (costs,))
    cost, _ = aggregate_views(costs, torch.zeros_like(visible))
    torch.testing.assert_close(cost.detach(), torch.ones_like(cost))
    assert float(torch.autograd.grad(cost.sum(), costs)[0].abs().sum()) == 0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"score": "ssd"}, OptionError, "score must be one of 'zncc', 'sad', 'census', 'cosine'; got str 'ssd'"),
        ({"window": 4}, OptionError, "window must be odd; got 4"),
        ({"window": 0}, OptionError, "window must be a whole number, at least 1"),
        ({"noise": 0.0}, OptionError, "noise must be a positive number"),
        ({"images": random_images(1)[0]}, ShapeError, r"images must be \(V, C, h, w\)"),
        ({"images": random_images(1)[:1]}, ShapeError, r"V at least 2; got \(1, 1, 9, 12\)"),
        ({"images": random_images(2)}, ShapeError, "for this score"),
        ({"images": random_images(1).numpy()}, DTypeError, "images must be a tensor"),
        ({"images": random_images(1) * float("nan")}, OptionError, "images must be finite"),
        ({"depths": torch.tensor([2.0, 1.0])}, GridError, "strictly ascending"),
        ({"depths": torch.tensor([[2.0, 3.0]])}, ShapeError, r"depths must be \(P,\)"),
        (
            {"cameras": ugly_cameras(views=3)},
            ShapeError,
            r"cameras must have the images' leading shape \(V,\) = \(4,\)",
        ),
        ({"cameras": torch.eye(4)}, DTypeError, "cameras must be"),
        ({"cameras": ugly_cameras()._replace(height=0)}, CameraError, "height must be at least 1 pixel"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    arguments = {
        "images": random_images(1),
        "cameras": ugly_cameras(),
        "depths": torch.tensor(DEPTHS, dtype=torch.float64),
    }
    arguments.update({name: change.pop(name) for name in list(change) if name in arguments})
    with pytest.raises(error, match=message):
        matching_costs(**arguments, **change)


@pytest.mark.parametrize("change", [{"best": 0}, {"best": 4}, {"min_views": 0}, {"min_views": 4}])
def test_wrong_numbers_of_views_are_named(change):
    costs = torch.rand(3, 2, 4, 5)
    with pytest.raises(OptionError, match=f"{next(iter(change))} must be a whole number from 1 to 3"):
        aggregate_views(costs, costs > 0, **change)


def test_costs_without_what_is_seen_are_refused():
    costs = torch.rand(3, 2, 4, 5)
    with pytest.raises(DTypeError, match="costs must be a tensor"):
        aggregate_views(None, costs > 0)
    with pytest.raises(ShapeError, match=r"visible must be of the shape of costs = \(3, 2, 4, 5\); got \(1, 2, 4, 5\)"):
        aggregate_views(costs, costs[:1] > 0)
