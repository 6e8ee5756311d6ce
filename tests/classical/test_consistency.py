"""Agreement between depth maps, against loops over pixels and against planes known in closed form."""

import numpy as np
import pytest
import torch

from lsmgeo.cameras import CameraTensors
from lsmgeo.classical import consistent_views
from lsmgeo.errors import OptionError, ShapeError
from tests.data.writers import make_scene


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def camera_of(scene, view):
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = scene.R[view], scene.t[view]
    return CameraTensors(torch.from_numpy(scene.K[view]), torch.from_numpy(E), *scene.size)


def depth_between(depth, x, y):
    """The plane through four pixels' points, by inverse depth; None outside, or where one of the four has none."""
    height, width = depth.shape
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    total = 0.0
    for row, column in ((y0, x0), (y0, x0 + 1), (y0 + 1, x0), (y0 + 1, x0 + 1)):
        weight = (1 - abs(x - column)) * (1 - abs(y - row))
        if weight <= 1e-12:
            continue
        if not (0 <= row < height and 0 <= column < width) or depth[row, column] == 0:
            return None
        total += weight / depth[row, column]
    return 1 / total


def counted(scene, depths, first, others, pixels, relative):
    """What consistent_views computes, pixel by pixel."""
    height, width = scene.size
    count = np.zeros((height, width), int)
    for other in others:
        for y in range(height):
            for x in range(width):
                d = depths[first][y, x]
                if d == 0:
                    continue
                X = scene.R[first].T @ (d * np.linalg.solve(scene.K[first], (x, y, 1.0)) - scene.t[first])
                seen = scene.K[other] @ (scene.R[other] @ X + scene.t[other])
                if seen[2] <= 0:
                    continue
                u, v = seen[:2] / seen[2]
                found = depth_between(depths[other], u, v)
                if found is None:
                    continue
                X = scene.R[other].T @ (found * np.linalg.solve(scene.K[other], (u, v, 1.0)) - scene.t[other])
                back = scene.K[first] @ (scene.R[first] @ X + scene.t[first])
                distance = np.hypot(back[0] / back[2] - x, back[1] / back[2] - y)
                count[y, x] += distance <= pixels and abs(back[2] - d) <= relative * d
    return count


@pytest.mark.parametrize(("pixels", "relative"), [(1.0, 0.01), (0.3, 0.1), (5.0, 0.004)])
def test_counts_are_those_of_loops_over_pixels(scene, pixels, relative):
    generator = np.random.default_rng(0)
    depths = [depth * generator.uniform(0.97, 1.03, depth.shape) for depth in scene.depth]
    for depth in depths:
        depth[generator.random(depth.shape) < 0.1] = 0
    expected = counted(scene, depths, 0, (1, 2), pixels, relative)
    assert len(np.unique(expected)) == 3
    found = consistent_views(
        torch.from_numpy(depths[0]),
        camera_of(scene, 0),
        [torch.from_numpy(depths[view]) for view in (1, 2)],
        [camera_of(scene, view) for view in (1, 2)],
        pixels=pixels,
        relative=relative,
    )
    np.testing.assert_array_equal(found.numpy(), expected)


def test_exact_maps_of_a_plane_agree_wherever_both_see_it(scene):
    height, width = scene.size
    for other in (1, 2, 3, 4):
        v, u = np.mgrid[:height, :width]
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(scene.K[0]).T
        points = (scene.depth[0][..., None] * rays - scene.t[0]) @ scene.R[0]
        seen = (points @ scene.R[other].T + scene.t[other]) @ scene.K[other].T
        pixels = seen[..., :2] / seen[..., 2:]
        expected = ((pixels >= 0) & (pixels <= (width - 1, height - 1))).all(-1)
        found = consistent_views(
            torch.from_numpy(scene.depth[0]),
            camera_of(scene, 0),
            [torch.from_numpy(scene.depth[other])],
            [camera_of(scene, other)],
            pixels=1e-6,
            relative=1e-9,
        )
        assert expected.mean() > 0.5
        np.testing.assert_array_equal(found.numpy(), expected)


def test_float32_maps_and_other_sizes_are_read(scene):
    """A map of half the size, with the camera of that size, agrees to the rounding of its floats."""
    from lsmgeo.cameras import resize

    small = resize(camera_of(scene, 1), 36, 48)
    v, u = np.mgrid[:36, :48]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(small.intrinsics.numpy()).T @ scene.R[1]
    center = -scene.R[1].T @ scene.t[1]
    normal = np.array([0.25, -0.15, 1.0])
    depth = torch.from_numpy(-(center @ normal) / (rays @ normal)).float()
    first = torch.from_numpy(scene.depth[0]).float()
    found = consistent_views(first, camera_of(scene, 0), [depth], [small], pixels=1e-3, relative=1e-5)
    assert float((found == 1).double().mean()) > 0.6


def test_cameras_of_the_originals_give_what_resized_ones_give(scene):
    from lsmgeo.cameras import resize

    maps = [torch.from_numpy(scene.depth[view])[::2, ::2].contiguous() for view in (0, 1)]
    originals = [camera_of(scene, view) for view in (0, 1)]
    small = [resize(camera, *maps[0].shape) for camera in originals]
    expected = consistent_views(maps[0], small[0], maps[1:], small[1:], pixels=0.5, relative=0.05)
    found = consistent_views(maps[0], originals[0], maps[1:], originals[1:], pixels=0.5, relative=0.05)
    assert 0 < int(expected.sum()) < expected.numel()
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_another_depth_does_not_agree(scene):
    maps = [torch.from_numpy(scene.depth[view]) for view in (0, 1)]
    cameras = [camera_of(scene, view) for view in (0, 1)]
    off = consistent_views(maps[0], cameras[0], [1.03 * maps[1]], cameras[1:], pixels=9.0, relative=0.02)
    assert int(off.sum()) == 0


def test_nothing_agrees_with_nothing(scene):
    maps, camera = torch.from_numpy(scene.depth[0]), camera_of(scene, 0)
    assert int(consistent_views(torch.zeros_like(maps), camera, [maps], [camera]).sum()) == 0
    assert int(consistent_views(maps, camera, [torch.zeros_like(maps)], [camera]).sum()) == 0
    assert int(consistent_views(maps, camera, [], []).sum()) == 0


@pytest.mark.parametrize("missing", [float("nan"), float("inf"), -1.0])
def test_no_number_agrees_with_nothing(scene, missing):
    maps, camera = torch.from_numpy(scene.depth[0]), camera_of(scene, 0)
    holes = maps.clone()
    holes[::2] = missing
    for own, other in ((holes, maps), (maps, holes)):
        found = consistent_views(own, camera, [other], [camera])
        assert int(found[::2].sum()) == 0
    assert int(consistent_views(holes, camera, [maps], [camera])[1::2].sum()) > 0


def test_wrong_arguments_are_named(scene):
    depth, camera = torch.from_numpy(scene.depth[0]), camera_of(scene, 0)
    with pytest.raises(ShapeError, match="other_cameras must be as many as other_depths, 1; got 0"):
        consistent_views(depth, camera, [depth], [])
    with pytest.raises(ShapeError, match=r"depth must be \(h, w\)"):
        consistent_views(depth[None], camera, [depth], [camera])
    with pytest.raises(OptionError, match="pixels must be a positive number; got int 0"):
        consistent_views(depth, camera, [depth], [camera], pixels=0)
    with pytest.raises(OptionError, match="relative must be a positive number; got float nan"):
        consistent_views(depth, camera, [depth], [camera], relative=float("nan"))
