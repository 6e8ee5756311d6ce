"""Images of meshes against exact rays, a second way of casting them, and shadows that are known."""

import sys

import numpy as np
import pytest
import torch
import trimesh

from lsmgeo import cameras, scenes
from lsmgeo.data import Mesh, from_trimesh, load_mesh, normalise, render_mesh
from lsmgeo.data.meshes.mesh_rendering import EmbreeCaster, NumpyCaster
from lsmgeo.errors import BackendError, CameraError, DTypeError, OptionError, ShapeError
from tests.data.real_sets import folder_of_meshes
from tests.tolerances import TERMWISE, length_error

pytest.importorskip("embreex")
F32, F64 = torch.float32, torch.float64


def sun(*directions, ambient=0.2):
    rows = torch.nn.functional.normalize(torch.tensor(directions, dtype=F32), dim=-1)
    return scenes.Lights(rows, torch.full((len(rows), 3), 0.6), torch.full((3,), ambient))


def views(count=3, size=48, distance=2.0):
    azimuth = torch.arange(count, dtype=F64) * 70 + 10
    elevation = torch.linspace(-20, 30, count, dtype=F64)
    return cameras.orbit(azimuth, elevation, distance, focal_length=1.875 * size, height=size, width=size)


def rays(camera):
    """Centre (3,) and directions (H, W, 3) of camera z 1 of one view, by inverses rather than transposes."""
    world = np.linalg.inv(camera.cam_from_world.numpy())
    v, u = np.mgrid[: int(camera.height), : int(camera.width)]
    pixels = np.stack((u, v, np.ones_like(u)), -1)
    return world[:3, 3], pixels @ np.linalg.inv(camera.intrinsics.numpy()).T @ world[:3, :3].T


def view_of(all_views, index):
    return cameras.CameraTensors(*(torch.as_tensor(field)[index] for field in all_views))


def test_a_plane_is_exact():
    corners = np.array([[-5, -1, -5], [5, -0.5, -5], [5, 0.7, 5], [-5, 0.2, 5]], float)
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert abs(normal @ (corners[3] - corners[0])) < 1e-12
    many = views()
    image = render_mesh(plane, many, sun((0, 1, 0)))
    for index in range(3):
        center, directions = rays(view_of(many, index))
        expected = (normal @ (corners[0] - center)) / (directions @ normal)
        points = center + expected[..., None] * directions
        inside = (expected > 0) & (np.abs(points[..., [0, 2]]) < 4.999).all(-1)
        outside = (expected < 0) | (np.abs(points[..., [0, 2]]) > 5.001).any(-1)
        assert inside.sum() > 300
        assert image.mask[index].numpy()[inside].all()
        assert not image.mask[index].numpy()[outside].any()
        error = np.abs(image.depth[index].numpy() - expected)[inside]
        assert (error <= length_error(F32, expected[inside] + 2)).all()
        unit = normal / np.linalg.norm(normal) * np.sign(normal @ (center - corners[0]))
        np.testing.assert_allclose(
            image.normals[index].numpy()[:, inside].T, np.broadcast_to(unit, (inside.sum(), 3)), atol=1e-6
        )
        assert not image.depth[index].numpy()[outside].any()
        assert not image.normals[index].numpy()[:, outside].any()


def test_a_sphere_is_seen_where_it_is():
    radius, many = 0.4, views()
    ball = from_trimesh(trimesh.creation.icosphere(subdivisions=5, radius=radius))
    image = render_mesh(ball, many, sun((0, 1, 0)))
    sag = radius * (1 - np.cos(np.deg2rad(1.2)))  # of a chord between neighbouring vertices
    for index in range(3):
        center, directions = rays(view_of(many, index))
        a, b = (directions**2).sum(-1), directions @ center
        root = b**2 - a * (center @ center - radius**2)
        hit = root > 0
        expected = (-b - np.sqrt(np.maximum(root, 0))) / a
        assert abs(int(image.mask[index].sum()) - int(hit.sum())) <= 4
        both = hit & image.mask[index].numpy() & (root > 0.01)  # away from the rim, where depth is steep
        assert both.sum() > 500
        assert (image.depth[index].numpy() - expected)[both].max() < 12 * sag
        assert (image.depth[index].numpy() - expected)[both].min() > -1e-6
        normals = (center + expected[..., None] * directions)[both] / radius
        np.testing.assert_allclose(image.normals[index].numpy()[:, both].T, normals, atol=3e-3)


def test_depth_reaches_the_same_points_whatever_the_unit_and_place():
    # float32 holds a mesh of this size at this place to 0.06 only; the caster moves it first.
    many = views(1)
    box = trimesh.creation.box((0.4, 0.5, 0.3))
    reference = render_mesh(from_trimesh(box), many, sun((0, 1, 0)))
    far = np.array([1e6, -2e6, 5e5])
    moved = Mesh(np.asarray(box.vertices) * 1e-2 + far, np.asarray(box.faces))
    E = many.cam_from_world.clone()
    E[:, :3, 3] = E[:, :3, 3] * 1e-2 - (E[:, :3, :3] @ torch.from_numpy(far)[:, None])[..., 0]
    image = render_mesh(moved, many._replace(cam_from_world=E), sun((0, 1, 0)))
    both = image.mask & reference.mask
    assert int((image.mask ^ reference.mask).sum()) <= 2
    # What is left is the rounding of the translation itself, in float64.
    torch.testing.assert_close(image.depth[both] * 100, reference.depth[both], atol=1e-5, rtol=0)


@pytest.mark.parametrize("distance", [1e3, 1e5, 1e7])
def test_far_cameras_see_what_near_ones_see(distance):
    # In float32, a camera at this distance says nothing of where on the mesh its rays pass.
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(3, 0.3), trimesh.creation.box((0.8, 0.1, 0.1))])
    azimuth = torch.tensor([30.0, 100.0], dtype=F64)
    far = cameras.orbit(azimuth, 20.0, distance, focal_length=30 * distance, height=36, width=40)
    fast, slow = (
        render_mesh(from_trimesh(mesh), far, sun((0.3, 1, 0.2)), backend=backend) for backend in ("embree", "numpy")
    )
    assert int(slow.mask.sum()) > 500
    assert int((fast.mask ^ slow.mask).sum()) <= 1
    both = fast.mask & slow.mask
    torch.testing.assert_close(fast.depth[both], slow.depth[both], rtol=2 * TERMWISE[F32], atol=0)
    assert int(((fast.images - slow.images).abs().amax(1) > 1e-3)[both].sum()) <= 3


def test_the_casters_agree_on_far_rays():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices, faces = np.asarray(ball.vertices) + 7.0, np.asarray(ball.faces)
    rng = np.random.default_rng(0)
    targets = rng.uniform(-0.7, 0.7, (1000, 3)) + 7.0
    directions = rng.normal(size=(1000, 3))
    directions *= 10.0 ** rng.uniform(-3, 3, (1000, 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
    # From within the ball to far beyond it, before it and behind it.
    origins = targets - directions * rng.choice([-1e8, -1.0, 0.0, 1.0, 1e4, 1e8], (1000, 1))
    fast, slow = (caster(vertices, faces) for caster in (EmbreeCaster, NumpyCaster))
    hits, expected = fast.first_hits(origins, directions), slow.first_hits(origins, directions)
    hit = expected.face >= 0
    assert 200 < hit.sum() < 800
    assert ((hits.face >= 0) == hit).mean() > 0.995
    assert (fast.occluded(origins, directions) == hit).mean() > 0.995
    same = hit & (hits.face == expected.face)
    assert same.sum() > 0.98 * hit.sum()
    # What is lost is the rounding of the origins themselves.
    np.testing.assert_allclose(hits.distance[same], expected.distance[same], rtol=1e-10, atol=1e-6)


def test_shadows_fall_where_they_must():
    # A square above a floor; the light comes from straight above, so the shadow is the square itself.
    floor = np.array([[-0.5, -0.2, -0.5], [-0.5, -0.2, 0.5], [0.5, -0.2, 0.5], [0.5, -0.2, -0.5]])
    square = floor * [0.4, 1, 0.4] + [0.05, 0.3, -0.1]
    mesh = Mesh(np.concatenate((floor, square)), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    near = cameras.orbit(torch.tensor([40.0]), 50.0, 2.0, focal_length=150.0, height=96, width=96)
    far = cameras.orbit(torch.tensor([40.0], dtype=F64), 50.0, 2e4, focal_length=150e4, height=96, width=96)
    for light, shift, camera, rounding in (
        ((0, 1, 0), np.zeros(2), near, 1e-4),
        ((0.3, 1, -0.2), 0.3 * np.array([-0.3, 0.2]), near, 1e-4),
        ((0, 1, 0), np.zeros(2), far, 1e-2),
    ):
        image = render_mesh(mesh, camera, sun(light))
        plain = render_mesh(mesh, camera, sun(light), shadows=False)
        center, directions = rays(view_of(cameras.to(camera, F64), 0))
        on_floor = center + (-0.2 - center[1]) / directions[..., 1:2] * directions
        # Only pixels whose ray meets the floor first, and not within a hair of an edge.
        seen = np.abs(image.depth[0].numpy() - (-0.2 - center[1]) / directions[..., 1]) < rounding
        away = np.abs(on_floor[..., [0, 2]] - (np.array([0.05, -0.1]) + shift)).max(-1) - 0.2
        shadow, lit = seen & (away < -0.003), seen & (away > 0.003)
        assert shadow.sum() > 100
        assert lit.sum() > 500
        cosine = 1 / np.linalg.norm(light)
        grey = image.images[0].numpy()
        np.testing.assert_allclose(grey[:, shadow], 0.7 * 0.2, rtol=1e-5)
        np.testing.assert_allclose(grey[:, lit], 0.7 * (0.2 + 0.6 * cosine), rtol=1e-5)
        torch.testing.assert_close(
            plain.images[0][:, seen], torch.full((3, int(seen.sum())), 0.7 * (0.2 + 0.6 * cosine))
        )


def test_a_convex_solid_casts_no_shadow_on_itself():
    ball = from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=0.5))
    lights = sun((0.2, 1, 0.4), (-1, 0.3, 0.2))
    dark = render_mesh(ball, views(), lights, smooth=False)
    plain = render_mesh(ball, views(), lights, smooth=False, shadows=False)
    torch.testing.assert_close(dark.images, plain.images, rtol=0, atol=0)


def test_shading_is_that_of_the_scenes():
    box = trimesh.creation.box((0.5, 0.4, 0.3))
    box.visual.face_colors = np.repeat(np.array([[200, 100, 50], [30, 60, 90]]), 6, 0)
    lights = sun((0.4, 1, 0.2), (1, 0, 0))
    image = render_mesh(from_trimesh(box), views(), lights, shadows=False, background=(0.1, 0.2, 0.3))
    for index in range(3):
        center, directions = rays(view_of(views(), index))
        points = center + image.depth[index].numpy()[..., None] * directions
        seen = image.mask[index].numpy()
        _, _, face = trimesh.proximity.closest_point_naive(box, points[seen])
        # On an edge the nearest face is a matter of rounding; its normal tells whether it is the face rendered.
        same = (box.face_normals[face] * image.normals[index].numpy()[:, seen].T).sum(1) > 0.999
        assert same.mean() > 0.95
        albedo = torch.from_numpy(box.visual.face_colors[face][:, :3].astype(np.float32) / 255)
        expected = scenes.shade(albedo, torch.from_numpy(box.face_normals[face].astype(np.float32)), lights)
        torch.testing.assert_close(image.images[index][:, seen].T[same], expected[same], atol=1e-5, rtol=0)
        np.testing.assert_allclose(
            image.images[index].numpy()[:, ~seen], np.tile(np.float32([[0.1], [0.2], [0.3]]), (~seen).sum())
        )


def test_normals_face_the_viewer_on_both_sides():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    inside_out = ball.copy()
    inside_out.invert()
    for smooth in (True, False):
        ones, others = (
            render_mesh(from_trimesh(mesh), views(), sun((0.3, 1, 0.2)), smooth=smooth) for mesh in (ball, inside_out)
        )
        torch.testing.assert_close(ones.images, others.images, rtol=0, atol=1e-6)
        for index in range(3):
            _, directions = rays(view_of(views(), index))
            normals = ones.normals[index].permute(1, 2, 0).numpy()
            seen = ones.mask[index].numpy()
            assert (normals * directions).sum(-1)[seen].max() < 1e-6
            np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("smooth", [True, False])
def test_the_two_casters_agree(smooth):
    mesh = trimesh.util.concatenate(
        [trimesh.creation.torus(0.3, 0.1), trimesh.creation.box((0.2, 0.9, 0.1)), trimesh.creation.icosphere(2, 0.2)]
    )
    fast, slow = (
        render_mesh(from_trimesh(mesh), views(2, 32), sun((0.3, 1, 0.2)), smooth=smooth, backend=backend)
        for backend in ("embree", "numpy")
    )
    assert int((fast.mask ^ slow.mask).sum()) <= 1
    both = fast.mask & slow.mask
    same = both & ((fast.depth - slow.depth).abs() < 1e-4)  # an edge against what is behind it may differ
    assert int((both & ~same).sum()) <= 2
    torch.testing.assert_close(fast.depth[same], slow.depth[same], rtol=2 * TERMWISE[F32], atol=0)
    different = ((fast.images - slow.images).abs().amax(1) > 1e-3) & same
    assert int(different.sum()) <= 3


def test_the_numpy_caster_finds_what_trying_every_triangle_finds():
    rng = np.random.default_rng(0)
    for faces in (1, 3, 5, 200):
        corners = rng.uniform(-1, 1, (faces, 3, 3))
        origins, directions = rng.uniform(-2, 2, (300, 3)), rng.normal(size=(300, 3))
        directions[::7, 0] = 0.0
        found = NumpyCaster(corners.reshape(-1, 3), np.arange(3 * faces).reshape(-1, 3)).first_hits(origins, directions)
        # X = A + v B + w C = O + t D, solved by Cramer's rule for every pair.
        a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        system = np.stack(np.broadcast_arrays(b[None], c[None], -directions[:, None]), -1)
        v, w, t = np.moveaxis(np.linalg.solve(system, (origins[:, None] - a)[..., None])[..., 0], -1, 0)
        distance = np.where((v >= 0) & (w >= 0) & (v + w <= 1) & (t > 0), t, np.inf)
        expected = np.where(np.isfinite(distance.min(1)), distance.argmin(1), -1)
        np.testing.assert_array_equal(found.face, expected)
        hit = expected >= 0
        assert hit.any()
        np.testing.assert_allclose(found.distance[hit], distance.min(1)[hit], rtol=1e-9)
        np.testing.assert_allclose(found.weights[hit], np.stack((v, w), -1)[hit, expected[hit]], atol=1e-9)
        fast = EmbreeCaster(corners.reshape(-1, 3), np.arange(3 * faces).reshape(-1, 3))
        assert (fast.first_hits(origins, directions).face == expected).mean() > 0.99
        assert (fast.occluded(origins, directions) == hit).mean() > 0.99


def test_without_embree_numpy_takes_over(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "embreex"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "embreex", None)
    box = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3)))
    assert render_mesh(box, views(1, 16), sun((0, 1, 0))).mask.any()
    with pytest.raises(BackendError, match=r"aarch64; install lsmgeo\[data\], or pass backend=\"numpy\""):
        render_mesh(box, views(1, 16), sun((0, 1, 0)), backend="embree")


def test_without_scipy_normals_are_flat_or_the_extra_is_named(monkeypatch):
    box = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3)))
    for name in ("scipy", "scipy.sparse"):
        monkeypatch.setitem(sys.modules, name, None)
    assert render_mesh(box, views(1, 16), sun((0, 1, 0)), smooth=False).mask.any()
    with pytest.raises(BackendError, match=r"smooth normals .* SciPy; install lsmgeo\[data\]"):
        render_mesh(box, views(1, 16), sun((0, 1, 0)))


def test_the_window_of_the_mesh_loses_nothing():
    box = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3)))
    many = views(3, 40)
    whole = render_mesh(box, many, sun((0, 1, 0)))
    # A speck behind the camera makes the window the whole image.
    speck = np.array([[0, 50, 0], [0, 50, 0.001], [0.001, 50, 0]]) + np.array([-80, 0, -80])
    specks = np.concatenate([speck * [x, 1, z] for x in (-1, 1) for z in (-1, 1)])
    more = Mesh(np.concatenate((box.vertices, specks)), np.concatenate((box.faces, np.arange(8, 20).reshape(-1, 3))))
    image = render_mesh(more, many, sun((0, 1, 0)), shadows=False)
    torch.testing.assert_close(image.mask, whole.mask)
    torch.testing.assert_close(image.depth, whole.depth, rtol=1e-5, atol=0)
    # Partly outside the image, wholly outside, and around the camera.
    close = cameras.orbit(torch.tensor([0.0]), 0.0, 0.5, focal_length=40.0, height=24, width=24)
    assert bool(render_mesh(box, close, sun((0, 1, 0))).mask.all())
    shift = torch.eye(4)[None].clone()
    shift[0, 0, 3] = 30.0
    aside = close._replace(cam_from_world=shift @ close.cam_from_world)
    assert not render_mesh(box, aside, sun((0, 1, 0))).mask.any()
    within = cameras.orbit(torch.tensor([0.0]), 0.0, 0.1, focal_length=40.0, height=24, width=24)
    image = render_mesh(box, within, sun((0, 1, 0)))
    assert bool(image.mask.all())
    torch.testing.assert_close(image.depth[0, 12, 12], torch.tensor(0.35), rtol=1e-5, atol=0)


def test_sizes_views_and_bits():
    mesh = from_trimesh(trimesh.creation.torus(0.3, 0.1))
    many = views(2, 64)
    image = render_mesh(mesh, many, sun((0, 1, 0)), size=(20, 30))
    assert image.images.shape == image.normals.shape == (2, 3, 20, 30)
    assert image.depth.shape == image.mask.shape == (2, 20, 30)
    resized = render_mesh(mesh, cameras.resize(many, 20, 30), sun((0, 1, 0)))
    for one, other in zip(image, resized, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
    none = render_mesh(
        mesh, cameras.CameraTensors(*(torch.as_tensor(field)[:0] for field in many)), sun((0, 1, 0)), size=(4, 4)
    )
    assert none.images.shape == (0, 3, 4, 4)
    behind = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    image = render_mesh(mesh, many, sun((0, 1, 0)), background=behind)
    assert torch.equal(image.images.movedim(1, -1)[~image.mask], behind.movedim(1, -1)[~image.mask])


def test_what_requires_gradients_is_rendered_all_the_same():
    mesh, many, lights = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3))), views(2, 16), sun((0.3, 1, 0.2))
    behind = torch.tensor([0.1, 0.2, 0.3])
    expected = render_mesh(mesh, many, lights, background=behind)
    tracked = many._replace(
        intrinsics=many.intrinsics.clone().requires_grad_(), cam_from_world=many.cam_from_world.clone().requires_grad_()
    )
    lights = scenes.Lights(*(field.clone().requires_grad_() for field in lights))
    image = render_mesh(mesh, tracked, lights, background=behind.requires_grad_())
    for one, other in zip(image, expected, strict=True):
        assert torch.equal(one, other)
        assert not one.requires_grad


def test_options_are_checked():
    mesh, many, light = from_trimesh(trimesh.creation.box((0.5, 0.4, 0.3))), views(2, 16), sun((0, 1, 0))
    with pytest.raises(DTypeError, match="from_trimesh"):
        render_mesh(trimesh.creation.box(), many, light)
    with pytest.raises(ShapeError, match=r"leading shape \(V,\)"):
        render_mesh(mesh, cameras.stack([many]), light)
    with pytest.raises(DTypeError, match="lights must be Lights"):
        render_mesh(mesh, many, tuple(light))
    with pytest.raises(ShapeError, match=r"colours must agree; got \(1, 3\) and \(2, 3\)"):
        render_mesh(mesh, many, light._replace(colours=torch.ones(2, 3)))
    with pytest.raises(OptionError, match="crease must be degrees"):
        render_mesh(mesh, many, light, crease=181)
    with pytest.raises(OptionError, match="backend must be one of"):
        render_mesh(mesh, many, light, backend="opengl")
    with pytest.raises(ShapeError, match="background must be RGB"):
        render_mesh(mesh, many, light, background=(1.0, 1.0))
    with pytest.raises(CameraError, match="last row"):
        render_mesh(mesh, many._replace(cam_from_world=2 * many.cam_from_world), light)


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.long)])
def test_154_meshes_are_rendered(every):
    many = views(2, 64)
    for path in sorted(folder_of_meshes().glob("*.ply"))[::every]:
        mesh = normalise(load_mesh(path))
        image = render_mesh(mesh, many, sun((0.3, 1, 0.2)))
        assert (image.mask.float().mean((1, 2)) > 0.01).all(), path.name
        seen = image.depth[image.mask]
        # The mesh fits a ball of radius 0.5 at distance 2.
        assert float(seen.min()) > 1.4999, path.name
        assert float(seen.max()) < 2.5001, path.name
        assert image.images.isfinite().all()
        assert float(image.images.min()) >= 0
        assert float(image.images.max()) <= 1
        lengths = image.normals.norm(dim=1)[image.mask]
        torch.testing.assert_close(lengths, torch.ones_like(lengths), rtol=1e-5, atol=0)
