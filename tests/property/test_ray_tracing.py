"""End to end against analytic ray tracing (P34, P35, P36): spheres, boxes and planes whose hits are closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsmgeo import CameraTensors, VoxelGrid, functional, rays
from lsmgeo.cameras import rays as camera_rays
from tests import oracle
from tests.property import support
from tests.strategies import rotations, vectors


@dataclasses.dataclass(frozen=True)
class Shot:
    """One camera and the solid it looks at, at the origin."""

    intrinsics: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    size: tuple[int, int]
    solid: str
    texture: np.ndarray  # (4,): slope and offset
    seed: int

    @property
    def camera(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.intrinsics, self.rotation, self.translation

    def cast(self, pixels: np.ndarray) -> np.ndarray:
        """World hits (N, 3) of pixel rays; NaN where the ray misses."""
        origin = oracle.camera_center(self.rotation, self.translation)
        through = oracle.backproject(*self.camera, pixels, np.ones(len(pixels)))
        origins, directions = np.broadcast_to(origin, through.shape), through - origin
        if self.solid == "sphere":
            s = oracle.hit_sphere(origins, directions, np.zeros(3), 0.7)
        elif self.solid == "box":
            s = oracle.hit_box(origins, directions, np.array([-0.5, -0.3, -0.6]), np.array([0.5, 0.3, 0.6]))
        else:
            s = oracle.hit_plane(origins, directions, np.array([0.2, 0.9, -0.3]), 0.1)
        return origins + np.where(np.isfinite(s), s, np.nan)[:, None] * directions

    def tensors(self) -> CameraTensors:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation, self.translation
        height, width = (torch.tensor([[n]]) for n in self.size)
        return CameraTensors(
            torch.from_numpy(self.intrinsics)[None, None], torch.from_numpy(pose)[None, None], height, width
        )


@st.composite
def shots(draw, solids=("sphere", "box", "plane"), size=(40, 56)):
    rng = np.random.default_rng(draw(st.integers(0, 2**20)))
    eye = rng.normal(size=3)
    eye *= rng.uniform(2.2, 3.5) / np.linalg.norm(eye)
    rotation, _ = oracle.look_at(eye, 0.1 * rng.normal(size=3), np.array([0.1, -1.0, 0.2]))
    rotation = oracle.rotation(np.array([0.0, 0.0, draw(st.sampled_from((0.0, 0.4, 2.0)))])) @ rotation
    focal = rng.uniform(0.8, 1.3) * size[1]
    intrinsics = np.array(
        [
            [focal, rng.uniform(-0.2, 0.2) * focal, size[1] * rng.uniform(0.4, 0.6)],
            [0.0, focal * rng.uniform(0.6, 1.4), size[0] * rng.uniform(0.4, 0.6)],
            [0.0, 0.0, 1.0],
        ]
    )
    solid = draw(st.sampled_from(solids))
    return Shot(intrinsics, rotation, -rotation @ eye, size, solid, rng.normal(size=4), draw(st.integers(0, 2**20)))


@support.FEWER
@given(shots())
def test_ray_traced_image_unprojects_to_the_texture_of_the_surface(shot):
    """P34: a textured solid, traced pixel by pixel; at seen surface points the operator returns the texture.

    The bound is the slope of the texture times how far the pixel's patch of surface is from flat: a half-pixel error, a
    swap of axes or a wrong pose is many times larger.
    """
    slope, offset = shot.texture[:3], shot.texture[3]
    hits = shot.cast(oracle.pixel_lattice(shot.size))
    image = np.where(np.isnan(hits[:, 0]), 0.0, hits @ slope + offset).reshape(shot.size)
    height, width = shot.size
    pixels = np.random.default_rng(shot.seed).uniform(0, 1, (150, 2)) * (np.array([width, height]) - 1.001)
    surface = shot.cast(pixels)

    # The four rays around each sample; all must hit, and nearly on one line (no crease, no rim).
    cell = np.floor(pixels).astype(int)
    grid = hits.reshape(height, width, 3)
    corners = np.stack([grid[cell[:, 1] + j, cell[:, 0] + i] for j in (0, 1) for i in (0, 1)], 1)
    patch = np.linalg.norm(corners - corners[:, :1], axis=-1).max(axis=1)
    fraction = pixels - cell
    weight = np.stack([
        np.where(i, fraction[:, 0], 1 - fraction[:, 0]) * np.where(j, fraction[:, 1], 1 - fraction[:, 1])
        for j in (0, 1) for i in (0, 1)
    ], 1)  # fmt: skip
    bend = np.linalg.norm((weight[..., None] * corners).sum(1) - surface, axis=-1)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(patch) & np.isfinite(surface[:, 0]) & (bend < 0.15 * patch)
    if good.sum() < 20:
        return
    values, visible = functional.unproject_points(
        torch.from_numpy(image)[None, None, None], shot.tensors(), torch.from_numpy(surface[good])[None]
    )
    assert bool(visible.all())
    bound = np.linalg.norm(slope) * (bend[good] + 1e-9)
    support.assert_within(support.array(values[0, 0, 0]), surface[good] @ slope + offset, bound)


def posed_volume(rotation, shape, field):
    """A posed, anisotropic grid over the solid, and a field sampled at its centres."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, (0.05, -0.02, 0.03)
    lower, upper = np.array([-1.3, -1.4, -1.2]), np.array([1.2, 1.3, 1.4])
    sites = oracle.voxel_sites(shape, lower, upper, pose)
    lattice = oracle.world_from_lattice(shape, lower, upper, pose)
    grid = VoxelGrid(shape, tuple(lower), tuple(upper), torch.from_numpy(pose))
    return torch.from_numpy(field(sites))[None, None], grid, lattice


def swept_points(shot, depths, size):
    """World points (P, h, w, 3) on the rays of ``lsmgeo.cameras.rays``, at the planes' camera depth."""
    origin, direction = (support.array(part[0, 0]) for part in camera_rays(shot.tensors(), size))
    along = direction @ shot.rotation[2]
    return origin + direction * (depths[:, None, None] / along)[..., None]


@support.FEWER
@given(shots(), rotations(), vectors())
def test_swept_fields_are_read_at_the_analytic_ray_points(shot, rotation, slope):
    """P35: linear fields to rounding, a signed distance within its second derivative times h^2 / 8."""
    shape, size = (20, 18, 22), (6, 9)
    depths = np.linspace(1.0, 4.5, 7)
    points = swept_points(shot, depths, size)
    for field, curvature in (
        (lambda sites: sites @ slope + 0.3, lambda where: np.full(where.shape[:-1], 1e-9)),
        (lambda sites: np.linalg.norm(sites, axis=-1) - 0.7, lambda where: 1.0 / np.linalg.norm(where, axis=-1)),
    ):
        volume, grid, lattice = posed_volume(rotation, shape, field)
        maps, _ = functional.plane_sweep_project(
            volume, shot.tensors(), grid, torch.from_numpy(depths), size, flatten=False
        )
        index = np.linalg.solve(lattice[:3, :3], (points - lattice[:3, 3]).reshape(-1, 3).T).T.reshape(points.shape)
        inside = np.all((index > 1e-6) & (index < np.array(shape[::-1]) - 1.000001), axis=-1)
        inside &= np.linalg.norm(points, axis=-1) > 0.4
        spacing = np.linalg.norm(lattice[:3, :3], axis=0)
        # The curvature may be that of a neighbouring site, closer to the centre by at most a cell's diagonal.
        bound = (spacing**2).sum() / 8 * curvature(points) * 2.0 + 1e-8
        support.assert_within(support.array(maps[0, 0, 0])[inside], field(points)[inside], bound[inside])
        assert inside.any()


@support.FEWER
@given(shots(solids=("sphere",)), rotations())
def test_depth_of_a_swept_solid_is_the_analytic_hit(shot, rotation):
    """P36: first crossing, alpha compositing and soft-argmax of a swept solid hit within one plane."""
    size = (12, 17)
    intrinsics = oracle.resize_intrinsics(shot.intrinsics, shot.size, size)
    small = dataclasses.replace(shot, intrinsics=intrinsics, size=size)
    hits = small.cast(oracle.pixel_lattice(size))
    depth = (hits @ shot.rotation[2] + shot.translation[2]).reshape(size)
    centre = float(np.linalg.norm(shot.translation))
    planes = np.linspace(centre - 1.0, centre + 0.5, 50)
    step = planes[1] - planes[0]
    volume, grid, lattice = posed_volume(rotation, (40, 44, 36), lambda sites: 0.7 - np.linalg.norm(sites, axis=-1))
    maps, visible = functional.plane_sweep_project(
        volume, shot.tensors(), grid, torch.from_numpy(planes), size, flatten=False, padding_mode="border"
    )
    inside = maps[0, 0, 0]
    offset = hits.reshape(*size, 3)
    ray = offset - oracle.camera_center(shot.rotation, shot.translation)
    facing = -(ray * offset).sum(-1) / np.linalg.norm(ray, axis=-1) / 0.7
    with np.errstate(invalid="ignore"):
        good = facing > 0.4  # interpolation moves a grazing surface along the ray
    # Trilinear interpolation lifts the surface by at most its curvature times h^2 / 8, and a ray meets it askew.
    sag = (np.linalg.norm(lattice[:3, :3], axis=0) ** 2).sum() / 8 / 0.6
    solid = (inside > 0).double()
    first = planes[np.argmax(solid.numpy(), axis=0)]
    blended = rays.composite(solid, solid[None], torch.from_numpy(planes), visible[0, 0])
    arrival = 0.05 - inside.abs()
    earlier = (torch.cumsum(solid, 0) - solid) > 0
    scores = torch.where(earlier, torch.full_like(arrival, -10.0), arrival) * 1000
    soft = rays.expected_depth(scores, torch.from_numpy(planes), visible[0, 0])
    hit = rays.max_along_rays(solid, visible[0, 0])
    assert bool((hit[torch.from_numpy(good)] == 1).all())
    for found in (first, support.array(blended.depth), support.array(soft)):
        support.assert_within(found[good], depth[good], (step + sag / facing)[good])
    missed = torch.from_numpy(np.isnan(depth)) & (inside.amax(0) < 0)
    support.assert_same(blended.transmittance[missed], torch.ones_like(blended.transmittance[missed]))
    assert good.any()


def test_fronto_parallel_plane_is_traced_and_read_exactly():
    """A camera above a checker ramp: pixel (u, v) sees (u - 3, v - 2) / 2 at depth 2 with focal length 4."""
    K = np.array([[4.0, 0.0, 3.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    shot = Shot(K, np.eye(3), np.array([0.0, 0.0, 2.0]), (5, 7), "plane", np.zeros(4), 0)
    points = oracle.backproject(*shot.camera, oracle.pixel_lattice((5, 7)), np.full(35, 2.0))
    np.testing.assert_allclose(points[8], [-1.0, -0.5, 0.0], atol=1e-15)
    image = (3.0 * points[:, 0] - points[:, 1]).reshape(1, 1, 1, 5, 7)
    where = torch.tensor([[[0.3, -0.2, 0.0], [-1.0, 0.75, 0.0]]], dtype=torch.float64)
    values, _ = functional.unproject_points(torch.from_numpy(image), shot.tensors(), where)
    torch.testing.assert_close(values[0, 0, 0], torch.tensor([1.1, -3.75], dtype=torch.float64))
