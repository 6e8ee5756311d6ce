"""Depth maps fused into a signed distance, against closed forms."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
import torch

from lsmgeo import VoxelGrid
from lsmgeo.cameras import CameraTensors, select
from lsmgeo.classical import Tsdf, extract_mesh, fuse_depth
from lsmgeo.errors import CameraError, DTypeError, GridError, OptionError, ShapeError
from tests import oracle
from tests.classical.scored import to_box, to_ellipsoid
from tests.classical.seen import Cameras, all_round, is_closed, volume
from tests.oracle.primitives import Ellipsoid, Faces, Part

RADII = np.array([0.41, 0.27, 0.34])
TURN = oracle.rotation(np.array([0.4, -0.7, 0.5]))
BALL = [Part(Ellipsoid(np.zeros(3), np.full(3, 0.4), np.eye(3)))]
EGG = [Part(Ellipsoid(np.zeros(3), RADII, TURN))]
HALF = np.array([0.29, 0.21, 0.25])
BOX = [Part(Faces(-TURN @ HALF, 2 * (TURN * HALF).T))]
POSE = np.block([[oracle.rotation(np.array([0.2, 0.5, -0.3])), np.array([[0.03], [-0.02], [0.01]])], [0, 0, 0, 1]])


def one_camera(size=(40, 48), tilt=(0.1, -0.2, 0.05)):
    K = np.array([[60.0, 1.5, 22.2], [0.0, 52.0, 20.4], [0.0, 0.0, 1.0]])
    R = oracle.rotation(np.array(tilt))
    return Cameras(K[None], R[None], np.array([[0.02, -0.05, 2.0]]), size)


def straight_camera():
    K = np.array([[40.0, 0, 15.5], [0, 40, 15.5], [0, 0, 1]])
    return Cameras(K[None], np.eye(3)[None], np.zeros((1, 3)), (32, 32))


def plane_depth(cameras, normal, offset, size=None):
    """Camera z (h, w) of the plane ``normal . X = offset`` at the pixels of an image resized to ``size``."""
    K = cameras.intrinsics[0] if size is None else oracle.resize_intrinsics(cameras.intrinsics[0], cameras.size, size)
    resized = Cameras(K[None], cameras.rotations, cameras.translations, cameras.size if size is None else size)
    origins, directions = resized.rays(0)
    return oracle.hit_plane(origins, directions, normal, offset).reshape(resized.size)


def centers_of(shape, lower, upper, pose=None):
    return oracle.voxel_sites(shape, np.array(lower), np.array(upper), np.eye(4) if pose is None else pose)


@pytest.mark.parametrize("size", [(40, 48), (31, 60)])
def test_one_view_of_a_plane_gives_the_distance_along_the_ray(size):
    cameras, shape, lower, upper = one_camera(), (13, 9, 11), (-0.4, -0.3, -0.45), (0.35, 0.4, 0.5)
    normal, truncation = np.array([0.5, 0.3, -1.0]), 0.2
    depth = plane_depth(cameras, normal, 0.04, size)
    grid = VoxelGrid(shape, lower, upper, torch.tensor(POSE))
    fused = fuse_depth(torch.tensor(depth)[None], cameras.tensors(), grid, truncation=truncation)

    points = centers_of(shape, lower, upper, POSE).reshape(-1, 3)
    center = oracle.camera_center(cameras.rotations[0], cameras.translations[0])
    length = np.linalg.norm(points - center, axis=1)
    directions = (points - center) / length[:, None]
    along = oracle.hit_plane(np.broadcast_to(center, points.shape), directions, normal, 0.04) - length
    K = oracle.resize_intrinsics(cameras.intrinsics[0], cameras.size, size)
    pixels, _ = oracle.project(K, cameras.rotations[0], cameras.translations[0], points)
    # Where depth is interpolated, not carried on beyond the outermost pixels.
    known = np.all((pixels > 0) & (pixels < np.array(size[::-1]) - 1), axis=1) & (along > -truncation)
    assert known.sum() > 500
    assert ((along > 0) & known).sum() > 200
    assert ((along < 0) & known).sum() > 100
    distance, weight = fused.distance.numpy().reshape(-1), fused.weight.numpy().reshape(-1)
    expected = np.minimum(along, truncation)
    np.testing.assert_allclose(distance[known], expected[known], atol=1e-10)
    assert (weight[known] > 0).all()
    behind = along < -truncation - 1e-9
    assert behind.sum() > 50
    assert (weight[behind] == 0).all()
    assert (distance[behind] == 0).all()

    # The weight is the cosine at the nearest pixel, less behind the surface.
    nearest = oracle.backproject(
        K, cameras.rotations[0], cameras.translations[0], np.floor(pixels + 0.5), np.ones(len(pixels))
    )
    rays = (nearest - center) / np.linalg.norm(nearest - center, axis=1)[:, None]
    cosine = np.abs(rays @ normal) / np.linalg.norm(normal)
    fall = np.clip(1 + along / truncation, 0, 1) ** 2
    np.testing.assert_allclose(weight[known], (cosine * fall)[known], rtol=1e-6)


def test_the_mesh_of_a_plane_is_that_plane():
    cameras = one_camera()
    normal = np.array([0.5, 0.3, -1.0]) / np.linalg.norm([0.5, 0.3, -1.0])
    depth = torch.tensor(plane_depth(cameras, normal, 0.04))[None]
    grid = VoxelGrid((14, 15, 16), -0.2, 0.22, torch.tensor(POSE))
    mesh = extract_mesh(fuse_depth(depth, cameras.tensors(), grid), grid)
    assert len(mesh.vertices) > 150
    # Distance along rays from one centre is not linear between voxels 0.03 apart, 2 away: 0.03^2 / (8 * 2).
    np.testing.assert_allclose(mesh.vertices @ normal, 0.04, atol=1e-4)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    center = oracle.camera_center(cameras.rotations[0], cameras.translations[0])
    towards = np.cross(b - a, c - a) @ (normal * np.sign(normal @ center - 0.04))
    assert (towards > 0).all()


@pytest.mark.parametrize(
    ("parts", "distance", "true_volume", "bound"),
    [
        (BALL, lambda points: np.linalg.norm(points, axis=1) - 0.4, 4 / 3 * np.pi * 0.4**3, 0.2),
        (EGG, lambda points: to_ellipsoid(points @ TURN, RADII), 4 / 3 * np.pi * RADII.prod(), 0.2),
        (BOX, lambda points: to_box(points @ TURN, HALF), 8 * HALF.prod(), 0.5),
    ],
    ids=["ball", "egg", "box"],
)
def test_solids_from_all_round(parts, distance, true_volume, bound):
    cameras, grid = all_round(), VoxelGrid((33, 30, 32), (-0.5, -0.52, -0.49), (0.52, 0.5, 0.5))
    depth, _ = cameras.see(parts)
    fused = fuse_depth(torch.tensor(depth, dtype=torch.float32), cameras.tensors(), grid)
    mesh = extract_mesh(fused, grid)
    voxel = 1.02 / 30
    errors = np.abs(distance(mesh.vertices.astype(np.float64))) / voxel
    assert errors.max() < bound
    # One closed surface: nothing within, where no view looks.
    assert is_closed(mesh.faces)
    assert len(mesh.vertices) - len(mesh.faces) / 2 == 2
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(true_volume, rel=0.02)
    # And the other way: directions spread over the sphere find the surface where it is.
    middle = fused.distance[16, 15, 15]
    assert middle <= 0
    # Half a voxel aside is far beyond the bound.
    off = mesh.vertices.astype(np.float64) + np.array([voxel / 2, 0, 0])
    assert np.abs(distance(off)).max() / voxel > 0.45


def test_half_a_pixel_would_be_seen():
    cameras, grid = all_round(size=(40, 40)), VoxelGrid(24)
    depth = torch.tensor(cameras.see(BALL)[0])
    right = extract_mesh(fuse_depth(depth, cameras.tensors(), grid), grid)
    tensors = cameras.tensors()
    K = tensors.intrinsics.clone()
    K[:, :2, 2] += 0.5
    wrong = extract_mesh(fuse_depth(depth, tensors._replace(intrinsics=K), grid), grid)
    errors = [np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4) * 24 for mesh in (right, wrong)]
    assert errors[0].max() < 0.2
    assert errors[1].max() > 0.3


def test_views_are_weighted():
    """Two walls at depths 1.9 and 2.1 before one camera: in front of both, the mean by weight; between, one alone."""
    camera = straight_camera()
    twice = CameraTensors(*(torch.cat((value, value)) for value in camera.tensors()[:2]), 32, 32)
    depths = torch.stack((torch.full((32, 32), 1.9), torch.full((32, 32), 2.1))).double()
    grid = VoxelGrid((40, 1, 1), (-0.01, -0.01, 1.5), (0.01, 0.01, 2.5))
    fused = fuse_depth(depths, twice, grid, truncation=0.2)
    z = 1.5 + (np.arange(40) + 0.5) / 40
    first, second = 1.9 - z, 2.1 - z
    w = [np.where(d > 0, 1, np.clip(1 + d / 0.2, 0, 1) ** 2) for d in (first, second)]
    expected = (w[0] * np.minimum(first, 0.2) + w[1] * np.minimum(second, 0.2)) / np.maximum(w[0] + w[1], 1e-30)
    np.testing.assert_allclose(fused.distance.numpy().reshape(-1), expected, atol=1e-6)
    np.testing.assert_allclose(fused.weight.numpy().reshape(-1), w[0] + w[1], rtol=1e-3, atol=1e-6)


def test_nothing_floats_between_the_two_sides_of_a_jump():
    """A near wall before a far one: it ends in a rim as deep as the truncation, and beyond that there is nothing."""
    camera = straight_camera()
    depth = np.full((1, 32, 32), 3.0)
    depth[:, :, 16:] = 2.0
    grid = VoxelGrid(40, (-0.7, -0.7, 1.8), (0.7, 0.7, 3.2))
    mesh = extract_mesh(fuse_depth(torch.tensor(depth), camera.tensors(), grid, truncation=0.15), grid)
    z = mesh.vertices[:, 2]
    voxel = 1.4 / 40
    assert ((z > 2 - 1e-4) & (z < 2.15 + voxel) | (np.abs(z - 3) < 1e-4)).all()
    assert (np.abs(z - 2) < 1e-4).sum() > 400
    assert (np.abs(z - 3) < 1e-4).sum() > 400


def test_what_has_no_depth_says_nothing_and_background_is_empty():
    cameras, grid = all_round(), VoxelGrid(24, -0.6, 0.6)
    depth = torch.tensor(cameras.see(BALL)[0])
    unknown = fuse_depth(depth, cameras.tensors(), grid)
    known = fuse_depth(depth, cameras.tensors(), grid, background=depth == 0)
    corner = (0, 0, 0)
    assert unknown.weight[corner] == 0
    assert known.weight[corner] > 0
    assert known.distance[corner] == pytest.approx(3 * 1.2 / 24)
    # Carving takes nothing from the surface: its rim is left out.
    first, second = (extract_mesh(fused, grid) for fused in (unknown, known))
    for mesh in (first, second):
        assert is_closed(mesh.faces)
        assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() * 20 < 0.25


def test_cracks_are_closed_and_holes_are_not():
    cameras, normal = one_camera(), np.array([0.5, 0.3, -1.0])
    depth = torch.tensor(plane_depth(cameras, normal, 0.04))[None]
    grid = VoxelGrid(16, -0.3, 0.3)
    whole = fuse_depth(depth, cameras.tensors(), grid, truncation=0.3)
    cracked = depth.clone()
    cracked[0, :, 20], cracked[0, 17, :] = 0, 0
    cracked[0, range(30), range(8, 38)] = 0
    closed = fuse_depth(cracked, cameras.tensors(), grid, truncation=0.3)
    # Where two cracks cross nothing is opposite; elsewhere a plane is a plane.
    lost = (whole.weight > 0) & (closed.weight == 0)
    assert lost.double().mean() < 0.01
    torch.testing.assert_close(closed.distance[~lost], whole.distance[~lost], rtol=0, atol=0.02)
    assert (closed.distance - whole.distance)[~lost].abs().median() < 1e-9
    # A crack along a jump stays open, and so does one of which it is known that nothing is there.
    step = torch.full((1, 32, 32), 3.0)
    step[:, :, 17:], step[:, :, 16] = 2.0, 0.0
    flat = torch.full((1, 32, 32), 2.0)
    flat[:, :, 16] = 0.0
    column = VoxelGrid((9, 1, 1), (0.5 * 2 / 40 - 0.01, -0.01, 1.9), (0.5 * 2 / 40 + 0.01, 0.01, 2.1))
    camera = straight_camera().tensors()
    assert (fuse_depth(step, camera, column).weight == 0).all()
    assert (fuse_depth(flat, camera, column).weight[:5] > 0).all()
    empty = flat == 0
    empty[:, :, 15:18] = True  # the rim of background is left out
    fused = fuse_depth(flat, camera, column, background=empty, truncation=0.05)
    torch.testing.assert_close(fused.distance, torch.full((9, 1, 1), 0.05))
    # Background counts even where there is depth.
    fused = fuse_depth(torch.full((1, 32, 32), 2.0), camera, column, background=empty, truncation=0.05)
    torch.testing.assert_close(fused.distance, torch.full((9, 1, 1), 0.05))


def test_colours_are_those_of_the_surface():
    cameras, grid = all_round(), VoxelGrid(24)
    depth, points = cameras.see(BALL)
    colours = torch.tensor(np.where(depth[:, None] > 0, 0.5 + points.transpose(0, 3, 1, 2), 0.0))
    mesh = extract_mesh(fuse_depth(torch.tensor(depth), cameras.tensors(), grid, colours=colours), grid)
    assert mesh.colours is not None
    assert mesh.colours.dtype == np.uint8
    # The colour changes by one in a unit, so the error is a length: a voxel is 0.042.
    errors = np.abs(mesh.colours / 255.0 - (0.5 + mesh.vertices)).max(1)
    assert np.median(errors) < 0.005
    assert errors.max() < 0.042


def test_slabs_and_order_of_views_change_nothing():
    cameras, grid = all_round(6), VoxelGrid((9, 10, 11))
    depth, points = cameras.see(EGG)
    depth, colours = torch.tensor(depth).float(), torch.tensor(0.5 + points.transpose(0, 3, 1, 2)).float()
    whole = fuse_depth(depth, cameras.tensors(), grid, colours=colours)
    slabs = fuse_depth(depth, cameras.tensors(), grid, colours=colours, memory=1)
    streamed = fuse_depth((one for one in depth), cameras.tensors(), grid, colours=iter(list(colours)))
    for other in (slabs, streamed):
        for first, second in zip(whole, other, strict=True):
            torch.testing.assert_close(second, first, rtol=0, atol=1e-6)
    tensors = cameras.tensors()
    turned = CameraTensors(*(value.flip(0) for value in tensors[:2]), *cameras.size)
    for first, second in zip(whole, fuse_depth(depth.flip(0), turned, grid, colours=colours.flip(0)), strict=True):
        torch.testing.assert_close(second, first, rtol=1e-5, atol=1e-6)


def test_maps_are_let_go_one_after_another():
    cameras, grid = all_round(6, (12, 12)), VoxelGrid(4)
    alive: list[weakref.ref[torch.Tensor]] = []
    most = 0

    def maps():
        nonlocal most
        for _ in range(6):
            most = max(most, sum(item() is not None for item in alive))
            one = torch.full((12, 12), 2.0)
            alive.append(weakref.ref(one))
            yield one
            del one

    fuse_depth(maps(), cameras.tensors(), grid)
    assert len(alive) == 6
    assert most <= 2  # the one at hand, and the next


def test_moving_grid_and_cameras_together_changes_nothing():
    cameras = all_round(5)
    depth = torch.tensor(cameras.see(EGG)[0])
    here = fuse_depth(depth, cameras.tensors(), VoxelGrid((9, 10, 11)))
    move = torch.tensor(POSE)
    tensors = cameras.tensors()
    moved = tensors._replace(cam_from_world=tensors.cam_from_world @ torch.linalg.inv(move))
    there = fuse_depth(depth, moved, VoxelGrid((9, 10, 11), world_from_grid=move))
    torch.testing.assert_close(there.distance, here.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(there.weight, here.weight, rtol=0, atol=1e-6)


def test_dtypes_and_maps_of_different_sizes():
    cameras, grid = all_round(4), VoxelGrid(12)
    depth = torch.tensor(cameras.see(EGG)[0])
    double, single = (fuse_depth(depth.to(dtype), cameras.tensors(), grid) for dtype in (torch.float64, torch.float32))
    assert double.distance.dtype == torch.float64
    assert single.distance.dtype == single.weight.dtype == torch.float32
    both = (double.weight > 1e-3) & (single.weight > 1e-3)
    assert both.sum() > 100
    torch.testing.assert_close(single.distance[both].double(), double.distance[both], rtol=0, atol=1e-5)
    # A map of half the size, of the same plane, gives the same distances.
    wall, flat = one_camera(), np.array([0.1, 0.2, -1.0])
    twice = CameraTensors(*(torch.cat((value, value)) for value in wall.tensors()[:2]), *wall.size)
    maps = [torch.tensor(plane_depth(wall, flat, 0.0, size)) for size in (wall.size, (20, 24))]
    grid = VoxelGrid(10, -0.2, 0.2)
    together = fuse_depth(maps, twice, grid)
    alone = fuse_depth(maps[:1], wall.tensors(), grid)
    torch.testing.assert_close(together.distance, alone.distance, rtol=0, atol=1e-9)


def test_a_thin_plate_keeps_both_sides():
    """A plate as thin as one and a half voxels, seen from all round, is one closed solid of about its thickness."""
    half = np.array([0.3, 0.3, 0.75 / 32])
    parts = [Part(Faces(-TURN @ half, 2 * (TURN * half).T))]
    cameras, grid = all_round(24, size=(80, 80)), VoxelGrid(32)
    depth = torch.tensor(cameras.see(parts)[0])
    mesh = extract_mesh(fuse_depth(depth, cameras.tensors(), grid), grid)
    local = mesh.vertices.astype(np.float64) @ TURN
    middle = np.abs(local[:, :2]).max(1) < 0.25
    assert middle.sum() > 500
    assert (np.abs(np.abs(local[middle, 2]) - half[2]) * 32).max() < 0.5


def test_bad_input_is_refused():
    cameras, grid = all_round(3, (8, 9)), VoxelGrid(4)
    tensors, depth = cameras.tensors(), torch.ones(3, 8, 9)
    good = fuse_depth(depth, tensors, grid)
    assert isinstance(good, Tsdf)
    for bad, error in (
        ({"depths": depth[:2]}, ShapeError),
        ({"depths": torch.ones(4, 8, 9)}, ShapeError),
        ({"depths": depth.long()}, DTypeError),
        ({"depths": -depth}, OptionError),
        ({"depths": depth * float("nan")}, OptionError),
        ({"depths": [depth[0], depth[1].double(), depth[2]]}, DTypeError),
        ({"colours": torch.ones(3, 3, 8, 8)}, ShapeError),
        ({"colours": torch.ones(2, 3, 8, 9)}, ShapeError),
        ({"colours": torch.full((3, 3, 8, 9), float("nan"))}, OptionError),
        ({"background": torch.ones(3, 8, 9)}, DTypeError),
        ({"truncation": 0.0}, OptionError),
        ({"truncation": float("nan")}, OptionError),
        ({"memory": 0}, OptionError),
        ({"grid": 4}, DTypeError),
        ({"grid": VoxelGrid(4, world_from_grid=torch.eye(4).repeat(2, 1, 1))}, GridError),
        ({"cameras": select(tensors, 0, 0)}, ShapeError),
        ({"cameras": CameraTensors(*(field[:0] for field in tensors[:2]), 8, 9), "depths": depth[:0]}, ShapeError),
        ({"cameras": tensors._replace(intrinsics=torch.zeros(3, 3, 3).double())}, CameraError),
    ):
        arguments = {"depths": depth, "cameras": tensors, "grid": grid} | bad
        with pytest.raises(error, match=r"fuse_depth|unproject|resize"):
            fuse_depth(**arguments)
