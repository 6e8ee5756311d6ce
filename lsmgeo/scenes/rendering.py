"""Rendering of analytic scenes: colour, exact depth, normals and masks, for many scenes and views in one call."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_devices, check_geometry, check_positive
from lsmgeo.cameras import as_tensors
from lsmgeo.cameras.camera_checks import check_cameras, image_size
from lsmgeo.cameras.matrices import CameraMatrices, camera_matrices
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.errors import DTypeError, ShapeError
from lsmgeo.scenes.inputs import background_array, checked_lights
from lsmgeo.scenes.lighting import Lights, shade
from lsmgeo.scenes.surfaces import albedo, normals
from lsmgeo.scenes.tables import Scene, check_scenes
from lsmgeo.scenes.tracing import CameraRays, FreeRays, Plan, first_hits, make_plan

__all__ = ["Hits", "Rendering", "render", "trace"]

# Shadow rays start at this distance from the surface, relative to its depth: scenes of any scale look alike.
SHADOW_OFFSET = 5e-5
# Plus this many roundings of its coordinates, for surfaces far from the origin.
SHADOW_ROUNDINGS = 16
# Devices where one view fits into the caches, and solids are tested within windows; elsewhere views are batched.
ONE_VIEW_AT_A_TIME = ("cpu",)
VIEWS_AT_ONCE = 64


class Rendering(NamedTuple):
    """V views of S scenes."""

    images: Tensor  # (S, V, 3, H, W) RGB in [0, 1]
    depth: Tensor  # (S, V, H, W) camera z of the surface, 0 where there is none
    normals: Tensor  # (S, V, 3, H, W) unit, world frame, towards the camera's side; 0 where there is no surface
    mask: Tensor  # (S, V, H, W) bool, True on surfaces


class Hits(NamedTuple):
    """The first hits of N rays in S scenes."""

    distance: Tensor  # (S, N) in multiples of the ray's direction, infinite where nothing is hit
    points: Tensor  # (S, N, 3) world; 0 where nothing is hit
    normals: Tensor  # (S, N, 3) unit, world; 0 where nothing is hit
    hit: Tensor  # (S, N) bool


@torch.no_grad()
def render(
    scenes: Sequence[Scene],
    cameras: Cameras,
    lights: Lights,
    *,
    background: Tensor | Sequence[float] = (1.0, 1.0, 1.0),
    shadows: bool = False,
    near: float = 1e-6,
    size: tuple[int, int] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Rendering:
    """Render analytic scenes: first hits in closed form at the pixel centres, shaded by `shade`.

    Convention:
        Depth is camera z. Integer pixel centres. A solid that contains the camera is invisible.

    Args:
        scenes: S scenes.
        cameras: leading shape (S, V), all images of one size; rendering runs on their device.
        lights: directions and colours (S, L, 3), ambient (S, 3); or without S, for all scenes.
        background: RGB (3,), or any array that broadcasts to (S, V, 3, H, W).
        shadows: whether solids block the lights.
        near: surfaces at or below this depth are invisible, world units.
        size: (H, W) of the images; by default the cameras' own. K is resized for it.
        dtype: float32 or float64, of the arithmetic and of the results; matrices are always composed in float64.

    Returns:
        `Rendering`. Not differentiable.

    Raises:
        ShapeError: no scene, or inconsistent shapes.
        DTypeError: a dtype other than float32 and float64.
        OptionError: not a sequence of `Scene`; near not positive.
        CameraError: invalid cameras, or views of different sizes without ``size``.

    Example:
        >>> import torch
        >>> from lsmgeo import cameras, scenes
        >>> ball = scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])
        >>> view = cameras.orbit(torch.zeros(1, 1), 0.0, 2.0, focal_length=60.0, height=33, width=33)
        >>> sun = scenes.Lights(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.8), torch.full((3,), 0.2))
        >>> rendering = scenes.render([ball], view, sun)
        >>> rendering.depth[0, 0, 16, 16]
        tensor(1.5000)
        >>> int(rendering.mask.sum())
        749
    """
    who = "render"
    scenes = check_scenes(who, scenes)
    if dtype not in (torch.float32, torch.float64):
        raise DTypeError(f"{who}: dtype must be torch.float32 or torch.float64; got {dtype}")
    near = check_positive(who, "near", near)
    tensors = as_tensors(cameras, who)
    if tensors.intrinsics.dim() != 4 or len(tensors.intrinsics) != len(scenes):
        raise ShapeError(
            f"{who}: cameras must have the leading shape (S, V) with S = {len(scenes)} scenes; got {tensors.shape}"
        )
    if tensors.intrinsics.shape[1] == 0:
        raise ShapeError(f"{who}: cameras must have at least one view; got V = 0")
    check_cameras(who, tensors)
    size = image_size(who, tensors, size)
    count, per_scene = tensors.intrinsics.shape[:2]
    device = tensors.intrinsics.device
    matrices = CameraMatrices(*(value.flatten(0, 1) for value in camera_matrices(tensors, size)))
    lights = checked_lights(who, lights, count, device, dtype)
    images = background_array(who, background, (count, per_scene, 3, *size), device, dtype)
    depth = images.new_zeros((count, per_scene, *size))
    normal = torch.zeros_like(images)
    mask = torch.zeros_like(depth, dtype=torch.bool)
    flat = Rendering(images.flatten(0, 1), depth.flatten(0, 1), normal.flatten(0, 1), mask.flatten(0, 1))

    for some, owner, views in _blocks(count, per_scene, device):
        plan = make_plan(scenes[some], owner, device)
        for block in views:
            _render_views(
                plan,
                owner,
                CameraMatrices(*(value[block] for value in matrices)),
                Lights(*(value[some] for value in lights)),
                Rendering(*(value[block] for value in flat)),
                shadows=shadows,
                near=near,
            )
    return Rendering(images, depth, normal, mask)


def _blocks(count: int, views: int, device: torch.device) -> Iterator[tuple[slice, list[int], list[slice]]]:
    """What is rendered together: scenes, the index of each view's scene among them, and slices of all views."""
    if device.type in ONE_VIEW_AT_A_TIME:
        for scene in range(count):
            yield slice(scene, scene + 1), [0], [slice(v, v + 1) for v in range(scene * views, (scene + 1) * views)]
        return
    if views > VIEWS_AT_ONCE:
        for scene in range(count):
            starts = range(scene * views, (scene + 1) * views, VIEWS_AT_ONCE)
            for start in starts:
                block = slice(start, min(start + VIEWS_AT_ONCE, starts.stop))
                yield slice(scene, scene + 1), [0] * (block.stop - block.start), [block]
        return
    step = VIEWS_AT_ONCE // views
    for first in range(0, count, step):
        last = min(first + step, count)
        owner = [scene for scene in range(last - first) for _ in range(views)]
        yield slice(first, last), owner, [slice(first * views, last * views)]


def _render_views(
    plan: Plan, owner: list[int], cameras: CameraMatrices, lights: Lights, out: Rendering, *, shadows: bool, near: float
) -> None:
    """Render V views, view v of scene ``owner[v]``, over the background in the arrays."""
    dtype, device = out.depth.dtype, out.depth.device
    shape = (len(owner), out.depth.shape[1], out.depth.shape[2])
    rays = CameraRays(plan, cameras, shape[1:], near=near, dtype=dtype)
    nearest, surface = first_hits(plan, rays, shape, near, out.depth)
    mask = surface >= 0
    at = mask.flatten().nonzero()[:, 0]  # (K,)
    rows, depth = surface.flatten()[at].long(), nearest.flatten()[at]
    view = at // (shape[1] * shape[2])
    pixel = torch.stack((at % shape[2], at // shape[2] % shape[1], torch.ones_like(at))).to(dtype)

    def each(values: Tensor) -> Tensor:
        """The values of each of the K pixels' views; of a single view, only once."""
        return values if len(owner) == 1 else values[view]

    from_pixel = each(rays.from_pixel.to(dtype)).permute(1, 2, 0)  # (3, 3, K)
    points = each(cameras.center.to(dtype)).T + depth * (from_pixel * pixel).sum(1)  # (3, K)
    tables = plan.tables.to(device, dtype)
    normal = normals(tables, rows, points)
    light = Lights(*(each(value[owner]) for value in lights))
    lit = None
    if shadows and lights.directions.shape[1]:
        rounding = SHADOW_ROUNDINGS * torch.finfo(dtype).eps * points.abs().amax(0)
        start = points + (SHADOW_OFFSET * depth + rounding) * normal
        lit = _lit(plan._replace(tables=tables), owner, start, at, shape, lights)
    _scatter(out.images, at, shade(albedo(tables, rows, points).T, normal.T, light, lit).T)
    _scatter(out.normals, at, normal)
    out.depth.copy_(torch.where(mask, nearest, 0.0))
    out.mask.copy_(mask)


def _scatter(target: Tensor, at: Tensor, values: Tensor) -> None:
    """Write values (3, K) at pixels ``at`` (K,), indices over all views, of a contiguous target (V, 3, H, W)."""
    count = target.shape[2] * target.shape[3]
    first = at + (at // count) * (2 * count)
    for channel, value in enumerate(values):
        target.view(-1)[first + channel * count] = value


def _lit(
    plan: Plan, owner: list[int], start: Tensor, at: Tensor, shape: tuple[int, int, int], lights: Lights
) -> Tensor:
    """Whether points (3, K), at pixels ``at`` of V views, are lit by each light: (K, L) bool."""
    single = len(owner) == 1
    if single:
        origins = start[None, :, None]  # (1, 3, 1, K)
    else:
        origins = start.new_zeros(shape[0], 3, *shape[1:])
        _scatter(origins, at, start)
    columns = []
    for light in range(lights.directions.shape[1]):
        towards = lights.directions[owner, light, :, None, None].expand_as(origins)
        rays = FreeRays(plan, origins, towards)
        nearest, _ = first_hits(plan, rays, (len(owner), *origins.shape[2:]), 0.0, start)
        free = nearest.isinf().flatten()
        columns.append(free if single else free[at])
    return torch.stack(columns, -1)


@torch.no_grad()
def trace(scenes: Sequence[Scene], origins: Tensor, directions: Tensor, *, near: float = 1e-6) -> Hits:
    """The first hits of rays, in closed form.

    Args:
        scenes: S scenes.
        origins: (S, N, 3) world, float32 or float64.
        directions: (S, N, 3) of any length above 0, of the same dtype.
        near: hits at or below this multiple of the direction are ignored.

    Returns:
        `Hits`. A solid that contains a ray's origin is ignored. Not differentiable.

    Raises:
        ShapeError: shapes other than (S, N, 3).
        DTypeError: tensors of another dtype, or of two dtypes.
        OptionError: not a sequence of `Scene`; near not positive.

    Example:
        >>> import torch
        >>> from lsmgeo import scenes
        >>> ball = scenes.Scene([scenes.sphere((0, 0, 0), 0.5)])
        >>> scenes.trace([ball], torch.tensor([[[2.0, 0.0, 0.0]]]), torch.tensor([[[-1.0, 0.0, 0.0]]])).distance
        tensor([[1.5000]])
    """
    who = "trace"
    scenes = check_scenes(who, scenes)
    near = check_positive(who, "near", near)
    for name, value in (("origins", origins), ("directions", directions)):
        check_geometry(who, name, value, "(S, N, 3)")
        if value.dim() != 3 or value.shape[0] != len(scenes) or value.shape[2] != 3:
            raise ShapeError(f"{who}: {name} must be (S, N, 3) with S = {len(scenes)} scenes; got {tuple(value.shape)}")
    if origins.shape != directions.shape or origins.dtype != directions.dtype:
        raise ShapeError(
            f"{who}: origins and directions must agree; got {tuple(origins.shape)} of {origins.dtype} and "
            f"{tuple(directions.shape)} of {directions.dtype}"
        )
    check_devices(who, origins=origins, directions=directions)
    plan = make_plan(scenes, list(range(len(scenes))), origins.device)
    plan = plan._replace(tables=plan.tables.to(origins.device, origins.dtype))
    start, along = origins.transpose(1, 2)[:, :, None], directions.transpose(1, 2)[:, :, None]  # (S, 3, 1, N)
    nearest, surface = first_hits(plan, FreeRays(plan, start, along), (len(scenes), 1, origins.shape[1]), near, origins)
    distance, hit = nearest[:, 0], surface[:, 0] >= 0
    points, normal = torch.zeros_like(origins), torch.zeros_like(origins)
    points[hit] = origins[hit] + distance[hit][:, None] * directions[hit]
    normal[hit] = normals(plan.tables, surface[:, 0][hit].long(), points[hit].T.contiguous()).T
    return Hits(distance, points, normal, hit)
