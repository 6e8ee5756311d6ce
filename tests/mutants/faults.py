"""The faults: realistic mistakes in operators of this kind, each a context manager that breaks the library."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lsmgeo import functional, grids, rays
from lsmgeo._linalg import transform
from lsmgeo._sites import direction_matrix
from lsmgeo.cameras import matrices, projection
from lsmgeo.kernels import lattice_geometry, reference, request
from lsmgeo.kernels import view_statistics as statistics
from tests.mutants import patching
from tests.mutants.patching import (
    Patch,
    around,
    around_method,
    both,
    cameras,
    image_matrix,
    options,
    outcome,
    rows,
    sweep_sites,
)

BOTH = ("unproject", "unproject_points", "plane_sweep_project", "project_reduce")
IMAGES = (*patching.IMAGE_OPERATORS, "sample_views")


def _entry(K: Tensor, row: int, column: int, value: Tensor) -> Tensor:
    changed = K.clone()
    changed[..., row, column] = value
    return changed


def _on_intrinsics(change):
    return cameras(lambda m: m._replace(intrinsics=change(m.intrinsics)))


def _transposed(matrix: Tensor) -> Tensor:
    return matrix.transpose(-1, -2)


def _coordinate(change):
    return around(reference._coordinate, change)


def _align_corners(inner, index, size, *rest):
    return inner(index * (size / max(size - 1, 1)) - 0.5 / max(size - 1, 1), size, *rest)


def _lower_cell(inner, index, size, call, *rest):
    whole = index.detach()
    eps = 16.0 * torch.finfo(index.dtype).eps
    return inner(index, size, call, *rest) - eps * (whole == whole.floor()) * (call.mode != "nearest")


def _sample_unmasked(inner, source, index, front, call):
    values, visible = inner(source, index, torch.ones_like(front), call)
    return values * front[:, :, None], visible


def _closed_image(inner, source, index, front, call):
    values, _ = inner(source, index, front, call)
    sizes = source.shape[3:][::-1]
    inside = [(axis >= -0.5) & (axis <= size - 0.5) for axis, size in zip(index, sizes, strict=True)]
    visible = inside[0]
    for axis in inside[1:]:
        visible = visible & axis
    return values, visible


def _centres_only(inner, source, index, front, call):
    values, visible = inner(source, index, front, call)
    for axis, size in zip(index, source.shape[3:][::-1], strict=True):
        visible = visible & (axis >= 0) & (axis <= size - 1)
    return values, visible


def _everything_in_front_is_visible(inner, source, index, front, call):
    values, visible = inner(source, index, front, call)
    return values, front.expand(visible.shape)


def _divided(is_front, divisor):
    """Other rules of what is in front and of what is divided by."""

    def divide(inner, homogeneous, unit, mask, call):
        x, y, z = homogeneous
        front = is_front(z, call.near * unit)
        if mask is not None:
            front = front & mask.reshape(*mask.shape, *(1,) * (z.dim() - 2))
        return [torch.where(front, axis / divisor(z), lattice_geometry.OUTSIDE) for axis in (x, y)], front

    return around(lattice_geometry.perspective_division, divide)


def _depth_plus_epsilon(inner, homogeneous, unit, mask, call):
    x, y, z = homogeneous
    return inner((x, y, z + 1e-3), unit, mask, call)


def _ray_length(inner, features, sampled_cameras, sites, **call):
    """The distance along the ray instead of camera z: z / cos of the angle to the optical axis."""
    asked = call.get("augment", ())
    asked = (asked,) if isinstance(asked, str) else asked
    result = inner(features, sampled_cameras, sites, **call)
    if "depth" not in asked or call.get("reduce"):
        return result
    angled = inner(
        features, sampled_cameras, sites, **{**call, "augment": ("depth", "direction"), "direction_frame": "camera"}
    )
    channel = features.shape[2]
    volume = result.volume.clone()
    cosine = angled.volume[:, :, channel + 3]
    volume[:, :, channel] = volume[:, :, channel] / torch.where(cosine == 0, 1.0, cosine)
    return result._replace(volume=volume)


def _output(change):
    return around(reference._output, change)


def _unit(change):
    return around(lattice_geometry.unit_vectors, change)


def _voxel_lattice(change):
    return around_method(
        grids.VoxelGrid, "_world_from_lattice", lambda inner, self, device: change(self, inner(self, device))
    )


def _endpoints_included(grid, T):
    counts = T.new_tensor([max(n - 1, 1) / n for n in reversed(grid.shape)])
    corner = T[..., :3, 3] - 0.5 * T[..., :3, :3].sum(-1)
    linear = T[..., :3, :3] / counts
    return torch.cat([torch.cat([linear, corner[..., None]], -1), T[..., 3:, :]], -2)


def _first_scene(grid, T):
    return T[:1].expand_as(T) if T.dim() == 3 else T


def _inverted_pose(inner, self, device):
    pose = self.world_from_grid
    if pose is None:
        return inner(self, device)
    other = object.__new__(grids.VoxelGrid)
    for name in ("shape", "lower", "upper"):
        object.__setattr__(other, name, getattr(self, name))
    object.__setattr__(other, "world_from_grid", torch.linalg.inv(pose))
    return inner(other, device)


def _frustum_lattice(change):
    return around_method(grids.FrustumGrid, "lattice", lambda inner, self: change(self, inner(self)))


def _mixed_views(matrix, _):
    return matrix.transpose(0, 1).reshape(matrix.shape)


def _flatten_planes_first(inner, *args, flatten=True, **kwargs):
    result = inner(*args, flatten=False, **kwargs)
    if not flatten:
        return result
    return result._replace(maps=result.maps.transpose(2, 3).flatten(2, 3))


def _statistics(change):
    return around(statistics.view_statistics, change)


def _unbiased_variance(inner, values, visible, names):
    count = visible.sum(1, keepdim=True)[:, :, None].clamp_min(2).to(values.dtype)
    blocks = [inner(values, visible, (name,)) for name in names]
    scale = (count / (count - 1))[:, 0]
    return torch.cat([b * scale if n == "variance" else b for n, b in zip(names, blocks, strict=True)], 1)


def _max_counts_blind_views(inner, values, visible, names):
    seen = visible[:, :, None]
    return torch.cat(
        [torch.where(seen, values, 0.0).amax(1) if n == "max" else inner(values, visible, (n,)) for n in names], 1
    )


def _max_to_the_last_view(inner, values, visible, names):
    return inner(values.flip(1), visible.flip(1), names)


def _interleaved_blocks(inner, values, visible, names):
    reduced = inner(values, visible, names)
    return reduced.unflatten(1, (len(names), -1)).transpose(1, 2).flatten(1, 2)


def _before_augmentation(inner, values, visible, names):
    """Statistics of the features, the geometric channels of the first view."""
    reduced = inner(values, visible, names)
    return torch.where(visible.any(1)[:, None], reduced, values[:, 0].repeat(1, len(names), *(1,) * (values.dim() - 3)))


def _unmasked(inner, *args):
    changed = [None if isinstance(a, Tensor) and a.dtype == torch.bool and a.dim() == 2 else a for a in args]
    if isinstance(changed[1], request.Sites):
        changed[1] = changed[1]._replace(view_mask=None)
    return inner(*changed)


def _hidden_augmentation(values, visible, source, sites, *rest):
    call = rest[-1]
    if not (call.depth or call.direction) or call.reduce:
        return values, visible
    channels = source.shape[2]
    kept = torch.where(visible[:, :, None], values[:, :, channels:], 0.0)
    return torch.cat([values[:, :, :channels], kept], 2), visible


def _inclusive_transmittance(inner, alpha, values, depths, visible=None):
    found = inner(alpha, values, depths, visible)
    opacity = alpha if visible is None else torch.where(visible, alpha, 0.0)
    weights = found.weights * (1 - opacity)
    return found._replace(values=(weights[..., None, :, :, :] * values).sum(-3), weights=weights)


def _from_slab_start(inner, self, start, stop):
    return inner(self, 0, stop - start)


def _changed_index(change):
    """Change the index x, y, z of points in a volume."""

    def wrapper(inner, *args):
        index, front = inner(*args)
        return change(index), front

    return around(lattice_geometry.volume_index, wrapper)


def _linear_in_depth(inner, depth, planes):
    index = inner(depth, planes)
    cell = index.detach().floor().clamp(0, max(planes.shape[-1] - 2, 0)).long()
    table = planes.to(depth.dtype).expand(depth.shape[0], planes.shape[-1])
    lower, upper = (table.gather(1, (cell + step).clamp_max(planes.shape[-1] - 1)) for step in (0, 1))
    return cell + (depth - lower) / torch.where(upper > lower, upper - lower, 1.0)


def _splat(change: Callable[..., Any]) -> Patch:
    return around(reference.splat, change)


def _truncated(inner: Any, index: Tensor, size: int, options: Any) -> Tensor:
    found = inner(index, size, options)
    return found if options.mode != "nearest" else torch.where((found == -1) & (index > -1.5), 0.0, found)


FAULTS = {
    # projection
    "pixel centres at half integers": image_matrix(
        lambda M, f: rows(M, lambda x, y, z: x + 0.5 * z, lambda x, y, z: y + 0.5 * z)
    ),
    "x and y of the image swapped": image_matrix(lambda M, f: rows(M, lambda x, y, z: y, lambda x, y, z: x)),
    "image x mirrored": image_matrix(lambda M, f: rows(M, lambda x, y, z: (f.shape[-1] - 1) * z - x)),
    "z axis backwards": image_matrix(lambda M, f: rows(M, z=lambda x, y, z: -z)),
    "y axis up": cameras(lambda m: m._replace(rotation=m.rotation * m.rotation.new_tensor([1.0, -1.0, 1.0])[:, None])),
    "rotation transposed": cameras(lambda m: m._replace(rotation=_transposed(m.rotation))),
    "translation taken for the camera centre": cameras(
        lambda m: m._replace(translation=-transform(m.rotation, m.translation))
    ),
    "extrinsics inverted": cameras(lambda m: m._replace(rotation=_transposed(m.rotation), translation=m.center)),
    "skew ignored": _on_intrinsics(lambda K: _entry(K, 0, 1, torch.zeros_like(K[..., 0, 1]))),
    "skew with the wrong sign": _on_intrinsics(lambda K: _entry(K, 0, 1, -K[..., 0, 1])),
    "fx used for fy": _on_intrinsics(lambda K: _entry(K, 1, 1, K[..., 0, 0])),
    "cx and cy swapped": _on_intrinsics(lambda K: _entry(_entry(K, 0, 2, K[..., 1, 2]), 1, 2, K[..., 0, 2])),
    "depth plus epsilon": around(lattice_geometry.perspective_division, _depth_plus_epsilon),
    "cameras of scene and view mixed up": image_matrix(_mixed_views),
    "first camera for all views": image_matrix(lambda M, f: M[:, :1].expand_as(M)),
    # resizing
    "intrinsics not resized to the feature map": around(
        matrices.resize_matrix, lambda inner, h, w, nh, nw, *a: inner(torch.ones_like(h), torch.ones_like(w), 1, 1, *a)
    ),
    "resizing scales cx without the half pixel": around(
        matrices.resize_matrix, lambda inner, *a: inner(*a) * inner(*a).new_tensor([[1.0, 1, 0], [1, 1, 0], [1, 1, 1]])
    ),
    "resizing swaps height and width": around(
        matrices.resize_matrix, lambda inner, h, w, nh, nw, *a: inner(w, h, nh, nw, *a)
    ),
    "resizing forgets the skew": around(
        matrices.camera_matrices,
        lambda inner, c, size=None, mask=None: inner(c, size, mask)._replace(
            intrinsics=_entry(inner(c, size, mask).intrinsics, 0, 1, inner(c, None, mask).intrinsics[..., 0, 1])
        ),
    ),
    # sampling
    "align_corners stretch": _coordinate(_align_corners),
    "nearest for bilinear": options(IMAGES, mode="nearest"),
    "bilinear for nearest": options(IMAGES, mode="bilinear"),
    "nearest rounds half to even": _coordinate(
        lambda inner, i, n, call, *r: inner(torch.round(i) if call.mode == "nearest" else i, n, call, *r)
    ),
    "nearest takes the floor": _coordinate(
        lambda inner, i, n, call, *r: inner(torch.floor(i) if call.mode == "nearest" else i, n, call, *r)
    ),
    "border always": options(BOTH, padding_mode="border"),
    "zeros always": options(BOTH, padding_mode="zeros"),
    "derivative of the cell below at integers": _coordinate(_lower_cell),
    # visibility
    "no depth test": _divided(
        lambda z, near: torch.ones_like(z, dtype=torch.bool), lambda z: torch.where(z == 0, 1.0, z)
    ),
    "near plane ignored": options(BOTH, near=0.0),
    "everything in front counts as visible": around(reference.sample_cells, _everything_in_front_is_visible),
    "far image border counts as visible": around(reference.sample_cells, _closed_image),
    "outer half pixel counts as invisible": around(reference.sample_cells, _centres_only),
    "hidden samples masked by multiplication": around(reference.sample_cells, _sample_unmasked),
    "division before the guard": _divided(lambda z, near: z > near, lambda z: z),
    "view mask ignored": both(*(around(reference.OPERATORS[name], _unmasked) for name in BOTH)),
    # geometric channels
    "ray length for depth": both(
        around(functional.unproject, _ray_length), around(functional.unproject_points, _ray_length)
    ),
    "depth negated": _output(lambda inner, v, depth, d, t: inner(v, None if depth is None else -depth, d, t)),
    "inverse depth for depth": _output(
        lambda inner, v, depth, d, t: inner(v, None if depth is None else 1 / torch.where(depth == 0, 1, depth), d, t)
    ),
    "direction before depth": _output(
        lambda inner, v, depth, d, t: (
            torch.cat([inner(v, None, None, t), d.to(t), depth[:, :, None].to(t)], 2)
            if depth is not None and d is not None
            else inner(v, depth, d, t)
        )
    ),
    "geometric channels only where visible": outcome(("unproject", "unproject_points"), _hidden_augmentation),
    "direction not normalised": _unit(
        lambda inner, vector, *a: lattice_geometry.mask_views(torch.stack(list(vector), 2), *a)
    ),
    "direction towards the camera": _unit(lambda inner, *a: -inner(*a)),
    "direction in z, y, x order": _unit(lambda inner, *a: inner(*a).flip(2)),
    "direction frames exchanged": around(
        direction_matrix, lambda inner, m, T, frame: inner(m, T, "world" if frame == "camera" else "camera")
    ),
    "direction from the world's origin": around(
        direction_matrix,
        lambda inner, m, T, frame: inner(m._replace(center=0 * m.center, translation=0 * m.translation), T, frame),
    ),
    # grids
    "voxel corners for centres": _voxel_lattice(
        lambda g, T: torch.cat([T[..., :3], T[..., 3:] - 0.5 * T[..., :3].sum(-1, keepdim=True)], -1)
    ),
    "outermost voxels on the bounds": _voxel_lattice(_endpoints_included),
    "grid axes in z, y, x order": _voxel_lattice(lambda g, T: T[..., [2, 1, 0, 3]]),
    "grid pose inverted": around_method(grids.VoxelGrid, "_world_from_lattice", _inverted_pose),
    "first scene's grid for all": _voxel_lattice(_first_scene),
    "grid pose gets no gradient": _voxel_lattice(lambda g, T: T.detach()),
    "frustum planes in descending depth": _frustum_lattice(lambda g, lattice: lattice._replace(z=lattice.z.flip(-1))),
    "frustum spaced in depth, not in its inverse": _frustum_lattice(
        lambda g, lattice: lattice._replace(
            z=lattice.z[..., :1]
            + (lattice.z[..., -1:] - lattice.z[..., :1])
            * torch.linspace(0, 1, lattice.z.shape[-1], dtype=lattice.z.dtype) ** 2
        )
    ),
    "frustum depth not divided by its scale": _frustum_lattice(lambda g, lattice: lattice._replace(projective=False)),
    "slabs restart at the first plane": around_method(request.Sites, "slab", _from_slab_start),
    # volumes at points
    "half a voxel off at points": _changed_index(lambda index: [axis + 0.5 for axis in index]),
    "x and z of points in a volume swapped": _changed_index(lambda index: index[::-1]),
    "planes at points linear in depth": around(lattice_geometry.plane_index, _linear_in_depth),
    "end planes hold outside": around(
        lattice_geometry.plane_index, lambda inner, depth, planes: inner(depth, planes).clamp(0, planes.shape[-1] - 1)
    ),
    "depths at points get no gradient": around(
        lattice_geometry.plane_index, lambda inner, depth, planes: inner(depth, planes.detach())
    ),
    # sweep
    "half a voxel off in the sweep": sweep_sites(
        lambda s: s._replace(matrix=s.matrix + 0.5 * s.matrix.new_tensor([0.0, 0, 1, 0]))
    ),
    "sweep planes in descending order": sweep_sites(lambda s: s._replace(z=s.z.flip(-1))),
    "sweep rays not turned into the world": around_method(
        matrices.CameraMatrices,
        "world_from_frustum",
        lambda inner, self: inner(self._replace(rotation=_transposed(self.rotation))),
    ),
    "planes before channels": around(functional.plane_sweep_project, _flatten_planes_first),
    "depths get no gradient": both(
        sweep_sites(lambda s: s._replace(z=s.z.detach())),
        _frustum_lattice(lambda g, lattice: lattice._replace(z=lattice.z.detach())),
    ),
    # splat
    "half a voxel off in the splat": _splat(
        lambda inner, f, sites, *rest: inner(
            f, sites._replace(matrix=sites.matrix + 0.5 * sites.matrix.new_tensor([0.0, 0, 1, 0])), *rest
        )
    ),
    "truncation for floor in the splat": around(reference._bounded, _truncated),
    "splat divided by the planes": _splat(
        lambda inner, f, sites, w, *rest: inner(f, sites, w / w.shape[2] if w is not None else w, *rest)
    ),
    "weights of the planes in reverse": _splat(
        lambda inner, f, sites, w, *rest: inner(f, sites, w.flip(2) if w is not None else w, *rest)
    ),
    "weights get no gradient": _splat(
        lambda inner, f, sites, w, *rest: inner(f, sites, w.detach() if w is not None else w, *rest)
    ),
    "near ignored by the splat": _splat(lambda inner, *rest: inner(*rest[:-1], rest[-1]._replace(near=0.0))),
    # depths of pixels, correlation
    "one pixel's depths for all": around(
        lattice_geometry.site_depths, lambda inner, *a: (lambda d: d[..., :1, :1].expand_as(d))(inner(*a))
    ),
    "inverse depths of pixels not inverted": around(
        lattice_geometry.site_coordinates,
        lambda inner, sites, *a: (lambda w, z: (w, z if w is None else w * z))(*inner(sites, *a)),
    ),
    "depths of pixels get no gradient": around(lattice_geometry.site_depths, lambda inner, *a: inner(*a).detach()),
    "correlation summed": around(
        reference._correlate, lambda inner, v, r, f, groups: inner(v, r, f, groups) * (v.shape[2] // groups)
    ),
    "channels dealt out to groups": around(
        reference._correlate,
        lambda inner, v, r, f, groups: inner(
            *(x.unflatten(x.dim() - 4, (-1, groups)).transpose(-5, -4).flatten(-5, -4) for x in (v, r)), f, groups
        ),
    ),
    "reference gets no gradient": around(
        reference._correlate, lambda inner, v, r, f, groups: inner(v, r.detach(), f, groups)
    ),
    "reference read behind the camera": around(
        reference._correlate, lambda inner, v, r, f, groups: inner(v, r, torch.ones_like(f), groups)
    ),
    # views
    "statistics count views that see nothing": _statistics(
        lambda inner, v, seen, n: inner(v, torch.ones_like(seen), n)
    ),
    "variance divides by n - 1": _statistics(_unbiased_variance),
    "maximum counts views that see nothing": _statistics(_max_counts_blind_views),
    "gradient of the maximum to the last view": _statistics(_max_to_the_last_view),
    "statistics interleaved": _statistics(_interleaved_blocks),
    "unseen sites keep the first view": _statistics(_before_augmentation),
    # precision and gradients
    "matrices in bfloat16": image_matrix(lambda M, f: M.bfloat16().double()),
    "matrices in float32": image_matrix(lambda M, f: M.float().double()),
    "float32 arithmetic for float64 features": around(reference.computing_dtype, lambda inner, source: torch.float32),
    "cameras get no gradient": image_matrix(lambda M, f: M.detach()),
    "features get no gradient": both(
        *(around(reference.OPERATORS[n], lambda inner, source, *a: inner(source.detach(), *a)) for n in BOTH)
    ),
    # rays and planes
    "pixel rays through corners": around(
        projection.rays,
        lambda inner, c, size=None: inner(
            c._replace(intrinsics=c.intrinsics - 0.5 * c.intrinsics.new_tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])),
            size,
        ),
    ),
    "soft-argmax weighs invisible planes": around(rays.expected_depth, lambda inner, s, d, visible=None: inner(s, d)),
    "transmittance includes its own plane": around(rays.composite, _inclusive_transmittance),
    "inverse spacing is even spacing": around(
        grids.depth_planes, lambda inner, near, far, num, spacing="depth": inner(near, far, num, "depth")
    ),
}
