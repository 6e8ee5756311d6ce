"""`cameras.project`, `unproject_depth` and `centers` against the oracle, one view and one point at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lsmgeo import CameraTensors, FrustumGrid, functional
from lsmgeo.cameras import centers, orbit, project, rays, stack, unproject_depth
from lsmgeo.errors import CameraError, DTypeError, GridError, OptionError, ShapeError
from tests import oracle, tolerances
from tests.property import support
from tests.strategies import scenes

NEAR = 1e-3


def narrow(scene, dtype):
    """The scene's cameras and sites, exact in `dtype`: cameras for the oracle and for the library, points (B, N, 3)."""
    exact = scene.rounded(dtype)
    return exact, support.cameras(exact, dtype), torch.from_numpy(scene.sites).to(dtype)


@given(scenes())
def test_pixels_and_depth_are_the_oracles(scene):
    for dtype in support.DTYPES:
        exact, views, points = narrow(scene, dtype)
        actual = project(views, points, near=NEAR)
        assert actual.pixels.dtype == actual.depth.dtype == dtype
        for b, v in np.ndindex(exact.batch, exact.views):
            sites = support.array(points[b])
            pose = exact.rotations[b, v], exact.translations[b, v]
            pixels, depth = oracle.project(exact.intrinsics[b, v], *pose, sites)
            magnitude = np.linalg.norm(sites, axis=-1) + np.linalg.norm(pose[1]) + 1
            norm = np.abs(exact.intrinsics[b, v, :2]).sum(-1).max()
            support.assert_within(support.array(actual.depth[b, v]), depth, tolerances.length_error(dtype, magnitude))
            front = depth > NEAR
            certain = np.abs(depth - NEAR) > tolerances.length_error(dtype, magnitude)
            expected = np.where(front[:, None], pixels, 0.0)
            # Everything but the last rounding is float64, whatever the dtype.
            off = tolerances.coordinate_error(torch.float64, norm, magnitude, depth, expected)
            off += 2 * tolerances.UNIT_ROUNDOFF[dtype] * np.abs(expected).max(-1)
            found = support.array(actual.pixels[b, v])
            support.assert_within(found[certain], expected[certain], off[certain, None] + 1e-12)
            inside = oracle.is_in_image(found, tuple(exact.image_sizes[b, v]))
            np.testing.assert_array_equal(actual.visible[b, v].numpy()[certain], (front & inside)[certain])


@given(scenes())
def test_points_of_depth_are_the_oracles_and_project_back(scene):
    depth = np.random.default_rng(scene.seed).uniform(-1.0, 3.0, (scene.batch, scene.views, *scene.size))
    for dtype in support.DTYPES:
        exact, views, _ = narrow(scene, dtype)
        maps = torch.from_numpy(depth).to(dtype)
        points = unproject_depth(views, maps)
        assert points.dtype == dtype
        intrinsics = support.feature_intrinsics(exact)
        lattice = oracle.pixel_lattice(exact.size)
        for b, v in np.ndindex(exact.batch, exact.views):
            pose = exact.rotations[b, v], exact.translations[b, v]
            z = support.array(maps[b, v]).ravel()
            expected = oracle.backproject(intrinsics[b, v], *pose, lattice, z)
            spread = 1 + np.abs(np.linalg.inv(intrinsics[b, v])).sum(-1).max() * max(exact.size)
            bound = tolerances.length_error(dtype, 8 * (spread * 3 + np.linalg.norm(pose[1])))
            # R^T is not R^-1 for rotations rounded to float32.
            support.assert_within(support.array(points[b, v].flatten(0, 1)), expected, bound)
    # In float64, back to the pixels they came from: of the maps, whose camera is resized.
    points, resized = unproject_depth(views.to(torch.float64), maps.double()), support.array(maps)
    K = torch.from_numpy(support.feature_intrinsics(exact))
    of_maps = CameraTensors(K, views.cam_from_world.double(), *scene.size)
    for b, v in np.ndindex(scene.batch, scene.views):
        back = project(of_maps.at((b, v)).at(None), points[b, v].flatten(0, 1)[None])
        front = resized[b, v].ravel() > 0.1
        np.testing.assert_allclose(back.pixels[0, 0].numpy()[front], lattice[front], atol=1e-4)
        np.testing.assert_allclose(back.depth[0, 0].numpy(), resized[b, v].ravel(), atol=1e-5)


@given(scenes())
def test_centres_are_the_oracles(scene):
    for dtype in support.DTYPES:
        exact, views, _ = narrow(scene, dtype)
        found = centers(views)
        assert found.dtype == dtype
        torch.testing.assert_close(found, rays(views, (2, 3))[0], rtol=0, atol=0)
        for b, v in np.ndindex(exact.batch, exact.views):
            pose = exact.rotations[b, v], exact.translations[b, v]
            tolerance = tolerances.length_error(dtype, 10 * (1 + np.linalg.norm(pose[1])))
            support.assert_within(support.array(found[b, v]), oracle.camera_center(*pose), tolerance)


@support.FEWER
@given(scenes(least=7))
def test_unproject_samples_where_project_says(scene):
    """A ramp read at points is their pixel; visibility is the operator's own where the map is the image."""
    size = tuple(int(side) for side in scene.image_sizes[0, 0])
    views = support.cameras(scene)._replace(height=size[0], width=size[1])
    points = torch.from_numpy(scene.sites)
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    ramps = torch.from_numpy(np.broadcast_to(np.stack([u, v]), (scene.batch, scene.views, 2, *size)).copy())
    read, seen = functional.unproject_points(ramps, views, points, augment="depth", padding_mode="border", near=NEAR)
    found = project(views, points, near=NEAR)
    certain = support.is_certain(support.geometry(scene.replace(size=size), torch.float64), size, NEAR)
    np.testing.assert_array_equal(seen.numpy()[certain], found.visible.numpy()[certain])
    last = torch.tensor([size[1] - 1.0, size[0] - 1.0], dtype=torch.float64)
    pixels = found.pixels.clamp_min(0).minimum(last)
    both = torch.from_numpy(certain) & seen
    torch.testing.assert_close(read[:, :, :2].movedim(2, -1)[both], pixels[both], rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(read[:, :, 2], found.depth, rtol=1e-9, atol=1e-9)


def simple(width: int = 7, height: int = 5, skew: float = 0.0, dtype: torch.dtype = torch.float64) -> CameraTensors:
    """One camera at the origin, looking along z: u = 4 x / z + skew y / z + 3, v = 8 y / z + 2."""
    K = torch.tensor([[4.0, skew, 3.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]], dtype=dtype)
    return CameraTensors(K[None], torch.eye(4, dtype=dtype)[None], height, width)


def test_known_points_with_skew():
    found = project(simple(skew=2.0), torch.tensor([[[1.0, 0.5, 2.0], [1.0, 0.5, -2.0]]], dtype=torch.float64))
    assert found.pixels[0, 0].tolist() == [[5.5, 4.0], [0.0, 0.0]]
    assert found.depth[0, 0].tolist() == [2.0, -2.0]
    points = unproject_depth(simple(skew=2.0), torch.full((1, 1, 5, 7), 2.0, dtype=torch.float64))
    assert points[0, 0, 4, 4].tolist() == [0.25, 0.5, 2.0]  # u = 4: 4 x / 2 + 2 * 0.5 / 2 = 1
    assert project(simple(skew=2.0), points[0, 0, 4:, 4][None]).pixels.flatten().tolist() == [4.0, 4.0]


def test_a_border_belongs_to_the_image_on_the_left_and_above_only():
    below = [float(np.nextafter(np.float32(6.5), np.float32(0))), float(np.nextafter(np.float32(4.5), np.float32(0)))]
    for u, v, is_visible in (
        (-0.5, 2.0, True), (3.0, -0.5, True), (6.5, 2.0, False), (3.0, 4.5, False), (below[0], below[1], True),
        (-0.50001, 2.0, False), (3.0, -0.50001, False),
    ):  # fmt: skip
        for dtype in support.DTYPES:
            point = torch.tensor([[[(u - 3.0) / 4.0, (v - 2.0) / 8.0, 1.0]]], dtype=dtype)
            assert bool(project(simple(dtype=dtype), point).visible) == is_visible, (u, v, dtype)


def test_a_pixel_that_rounds_to_the_border_is_not_visible():
    """Whoever reads an image at visible pixels never reads beside it."""
    below = float(np.nextafter(np.float64(0.875), 0))
    found = project(simple(dtype=torch.float64), torch.tensor([[[below, 0.0, 1.0]]], dtype=torch.float32))
    assert found.pixels[0, 0, 0, 0] == 6.5
    assert not found.visible.any()


def test_points_that_are_not_in_front():
    """At the near plane, in the camera centre, behind: pixel (0, 0) without gradient, and the depth as it is."""
    points = torch.tensor([[[0.3, 0.2, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, -3.0], [0.5, 0.25, 1.0]]], dtype=torch.float64)
    leaves = [*(part.clone().requires_grad_() for part in (points, *simple()[:2]))]
    pixels, depth, visible = project(
        simple()._replace(intrinsics=leaves[1], cam_from_world=leaves[2]), leaves[0], near=0.5
    )
    assert pixels[0, 0].tolist() == [[0.0, 0.0]] * 3 + [[5.0, 4.0]]
    assert depth[0, 0].tolist() == [0.5, 0.0, -3.0, 1.0]
    assert visible[0, 0].tolist() == [False, False, False, True]
    (gradient,) = torch.autograd.grad(pixels.sum(), leaves[0], retain_graph=True)
    assert not gradient[0, :3].any()
    assert gradient[0, 3].all()
    for gradient in torch.autograd.grad(pixels.square().sum() + depth.sum(), leaves):
        assert gradient.isfinite().all()


def test_large_and_small_numbers_stay_finite():
    points = torch.tensor([[[1e30, -1e30, 1e-5], [1e38, 1e38, 1e38], [1e-30, 0.0, 1e-3]]], requires_grad=True)
    found = project(simple(dtype=torch.float32), points)
    assert found.pixels.isfinite().all()
    assert (
        found.pixels[0, 0, 0].abs().tolist() == [torch.finfo(torch.float32).max] * 2 or found.pixels.abs().max() > 1e34
    )
    depth = torch.full((1, 1, 5, 7), 1e38, requires_grad=True)
    points = unproject_depth(simple(dtype=torch.float32), depth)
    assert points.isfinite().all()
    (gradient,) = torch.autograd.grad(points.sum(), depth)
    assert gradient.isfinite().all()


def views(scenes: int = 2, count: int = 3) -> CameraTensors:
    azimuth = torch.linspace(0.0, 200.0, scenes * count, dtype=torch.float64).reshape(scenes, count)
    made = orbit(azimuth, 20.0, 2.0, focal_length=20.0, height=9, width=14)
    K = made.intrinsics.clone()
    K[..., 0, 1] = 1.5
    return CameraTensors(K, made.cam_from_world.clone(), made.height, made.width)


def some_points(scenes: int = 2, count: int = 5) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(scenes, count, 3, generator=generator, dtype=torch.float64) - 0.5


def test_gradients():
    made, depth = views(), 1.0 + torch.rand(2, 3, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def around(K, offset):
        # Perturbing t keeps R a rotation.
        moved = torch.nn.functional.pad(offset[..., None], (3, 0, 0, 1))
        return CameraTensors(K, made.cam_from_world + moved, 9, 14)

    leaves = [part.clone().requires_grad_() for part in (made.intrinsics[..., :2, :], torch.zeros(2, 3, 3).double())]
    last = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(2, 3, 1, 3)

    def run(function):
        return lambda K, offset, *more: function(around(torch.cat((K, last), -2), offset), *more)

    # The skew's neighbour K[1, 0] must stay 0, so K is scaled instead of perturbed entry by entry.
    def scaled(function):
        return lambda scale, offset, *more: run(function)(leaves[0].detach() * scale, offset, *more)

    scale = torch.ones(2, 3, 2, 3, dtype=torch.float64, requires_grad=True)
    points = some_points().requires_grad_()
    assert torch.autograd.gradcheck(scaled(lambda c, p: project(c, p)[:2]), (scale, leaves[1], points))
    assert torch.autograd.gradcheck(scaled(unproject_depth), (scale, leaves[1], depth.requires_grad_()))
    assert torch.autograd.gradcheck(scaled(centers), (scale, leaves[1]), raise_exception=True)
    rotation = made.cam_from_world.clone().requires_grad_()
    for values in (
        project(made._replace(cam_from_world=rotation), some_points()).pixels,
        centers(made._replace(cam_from_world=rotation)),
    ):
        (gradient,) = torch.autograd.grad(values.square().sum(), rotation)
        assert gradient[..., :3, :].abs().sum() > 0
        assert not gradient[..., 3, :].any()


@pytest.mark.parametrize("dtype", support.DTYPES)
def test_batches_are_loops_and_every_form_of_cameras_is_the_same(dtype):
    made, points = views().to(dtype), some_points().to(dtype)
    depth = 1.0 + torch.rand(2, 3, 4, 5, dtype=dtype, generator=torch.Generator().manual_seed(1))
    whole, maps = project(made, points), unproject_depth(made, depth)
    for b, v in np.ndindex(2, 3):
        one = made.at((b, v)).at((None, None))
        for mine, other in zip(project(one, points[b : b + 1]), whole, strict=True):
            torch.testing.assert_close(mine[0, 0], other[b, v], rtol=0, atol=0)
        torch.testing.assert_close(unproject_depth(one, depth[b, v][None, None])[0, 0], maps[b, v], rtol=0, atol=0)
        torch.testing.assert_close(centers(one)[0, 0], centers(made)[b, v], rtol=0, atol=0)
    K = made.to_kornia().intrinsics.unflatten(0, (2, 3))
    shared = type(made.to_kornia())(K, made.cam_from_world, torch.full((2,), 9.0), torch.full((2,), 14.0))
    for form in (
        made.to_kornia(), shared, made._replace(height=9, width=14), made._replace(intrinsics=K),
        made._replace(height=torch.tensor([9, 9])), stack([made.at((slice(None), v)) for v in range(3)], 1),
    ):  # fmt: skip
        torch.testing.assert_close(tuple(project(form, points)), tuple(whole), rtol=0, atol=0)
        torch.testing.assert_close(unproject_depth(form, depth), maps, rtol=0, atol=0)
    assert centers(made.to_kornia()).shape == (6, 3)
    assert centers(made.at((0, 0))).shape == (3,)


def test_views_differ_in_size():
    made = views(1, 2)._replace(height=torch.tensor([[9, 18]]), width=torch.tensor([[14, 14]]))
    K = made.intrinsics[:, :1].expand(1, 2, 3, 3)
    made = made._replace(intrinsics=K, cam_from_world=made.cam_from_world[:, :1].expand(1, 2, 4, 4))
    below = unproject_depth(
        made.at((slice(None), slice(0, 1)))._replace(height=18), torch.full((1, 1, 18, 14), 2.0).double()
    )
    found = project(made, below[:, 0, 12, 3:4])
    assert found.pixels[0, 0].tolist() == found.pixels[0, 1].tolist()
    assert found.visible.flatten().tolist() == [False, True]


def test_a_frustum_grid_is_a_depth_map_per_plane():
    depths = torch.tensor([1.0, 1.5, 2.5], dtype=torch.float64)
    made = views().at((slice(None), 0))
    planes = FrustumGrid(made, depths, (4, 5)).centers()
    for k, depth in enumerate(depths.tolist()):
        flat = torch.full((2, 1, 4, 5), depth, dtype=torch.float64)
        torch.testing.assert_close(unproject_depth(made, flat)[:, 0], planes[:, k], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("scenes", "count"), [(0, 5), (2, 0)])
def test_no_scene_and_no_point(scenes, count):
    made = views(max(scenes, 1)).at(slice(0, scenes))
    found = project(made, some_points(scenes, count))
    assert found.pixels.shape == (scenes, 3, count, 2)
    assert found.visible.shape == found.depth.shape == (scenes, 3, count)
    assert unproject_depth(made, torch.zeros(scenes, 3, 2, 4).double()).shape == (scenes, 3, 2, 4, 3)
    assert centers(made).shape == (scenes, 3, 3)


def test_errors_name_the_argument():
    made, points = views(), some_points()
    mirrored = made._replace(cam_from_world=-made.cam_from_world)
    for error, text, run in (
        (ShapeError, r"project: points must be \(B, N, 3\); got \(2, 3\)", lambda: project(made, points[:, 0])),
        (ShapeError, r"points must be \(B, N, 3\); got \(2, 5, 2\)", lambda: project(made, points[..., :2])),
        (ShapeError, "cameras must be .* the points' B = 1; got", lambda: project(made, points[:1])),
        (DTypeError, "points must be of float32, float64; got torch.float16", lambda: project(made, points.half())),
        (GridError, "points must be finite", lambda: project(made, points / 0.0)),
        (OptionError, "near must be a finite number, at least 0; got", lambda: project(made, points, near=-1.0)),
        (CameraError, "project: cameras.*last row", lambda: project(mirrored, points)),
        (ShapeError, r"unproject_depth: depth must be \(B, V, h, w\)", lambda: unproject_depth(made, points)),
        (ShapeError, "cameras must have leading shape", lambda: unproject_depth(made, torch.ones(3, 2, 4, 4))),
        (GridError, "depth must be finite", lambda: unproject_depth(made, torch.full((2, 3, 4, 4), torch.nan))),
        (DTypeError, "centers: cameras must be a kornia", lambda: centers(points)),
        (CameraError, "centers: cameras", lambda: centers(mirrored)),
    ):
        with pytest.raises(error, match=text):
            run()
