"""Geometry that the backends share: matrices applied to the sites of a lattice and to points, depths, ray directions.

Vectorised PyTorch, differentiable twice.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo._dtypes import saturating_cast
from lsmgeo.kernels.request import Options, Sites

# The index of sites that read nothing: every tap is outside the array, for any interpolation.
OUTSIDE = -2.0
# Homogeneous coordinates are kept below 2^100, and a site counts as in front, or as away from the camera centre, only
# beyond 2^-60, so that neither the quotient's derivative nor anything before it overflows in float32.
LARGEST_COORDINATE = 2.0**100
SMALLEST_DEPTH = 2.0**-60


def site_coordinates(sites: Sites, matrix: Tensor, dtype: torch.dtype) -> tuple[Tensor | None, Tensor]:
    """The last two coordinates of q, w and z, both of (B, V, D, H, W) where they differ from site to site.

    Homogeneous: with the depth d of a site, ``q = (w x, w y, z, w)``, ``w = min(d, 1)`` and ``z = w / d``, so that
    nothing overflows, whatever the depth is. Otherwise w is None, for 1, and z is (B, V, D).
    """
    if not sites.per_site():
        return None, per_view(sites.z, matrix).to(dtype)
    depth = site_depths(sites, dtype)
    is_close = depth < 1.0
    return torch.where(is_close, depth, 1.0), torch.where(is_close, 1.0, depth).reciprocal()


def site_depths(sites: Sites, dtype: torch.dtype) -> Tensor:
    """The depths of sites that each have their own, (B, V, D, H, W): what is positive and finite stays so."""
    limits = torch.finfo(dtype if sites.z.dtype == torch.float64 else torch.float32)
    depths = sites.z.clamp(limits.tiny, limits.max).to(dtype)
    return depths.expand(*sites.matrix.shape[:2], *depths.shape[2:])


def lattice_rows(matrix: Tensor, sites: Sites, dtype: torch.dtype) -> list[Tensor]:
    """The three coordinates of ``M q``, each (B, V, D, H, W).

    A lattice is separable: the terms in x and y make a plane, those in z a line, and the full array is their sum.
    """
    m = matrix.to(dtype)
    plane = plane_rows(m, sites)  # (B, V, 3, H, W)
    w, z = site_coordinates(sites, matrix, dtype)
    if w is not None:
        return [plane[:, :, row, None] * w + m[:, :, row, 2, None, None, None] * z for row in range(3)]
    line = m[..., 2, None] * z[:, :, None]  # (B, V, 3, D)
    return [plane[:, :, row, None] + line[:, :, row, :, None, None] for row in range(3)]


def plane_rows(m: Tensor, sites: Sites) -> Tensor:
    """The terms of ``M q`` in x, y and 1, (B, V, 3, H, W)."""
    x, y = sites.x.to(m.dtype), sites.y.to(m.dtype)
    return m[..., 0, None, None] * x + (m[..., 1, None, None] * y[:, None] + m[..., 3, None, None])


def point_rows(matrix: Tensor, points: Tensor, dtype: torch.dtype) -> list[Tensor]:
    """The three coordinates of ``M (X, 1)`` for points (B, N, 3), each (B, V, N)."""
    m = matrix.to(dtype)
    x, y, z = (axis[:, None] for axis in points.to(dtype).unbind(-1))  # (B, 1, N)
    return [
        m[..., row, 0, None] * x + m[..., row, 1, None] * y + m[..., row, 2, None] * z + m[..., row, 3, None]
        for row in range(3)
    ]


def per_view(z: Tensor, matrix: Tensor) -> Tensor:
    """(D,), (B, D) or (B, V, D) -> (B, V, D)."""
    if z.dim() == 2:
        z = z[:, None]
    return z.expand(*matrix.shape[:2], z.shape[-1])


def _extent(matrix: Tensor, reach: Sequence[Tensor]) -> Tensor:
    """A bound on the terms of ``M q``, (B, V, ...), for M (B, V, ..., 3, 4) and bounds on |x|, |y| and |z|."""
    m = matrix.detach().abs().amax(-2)  # (B, V, ..., 4)
    return m[..., 0] * reach[0] + m[..., 1] * reach[1] + m[..., 2] * reach[2] + m[..., 3]


def lattice_extent(matrix: Tensor, sites: Sites) -> Tensor:
    """A bound on the terms of ``M q`` over a lattice, (B, V)."""
    if sites.per_site():  # homogeneous: |z| <= 1, see `site_coordinates`
        z = torch.ones(matrix.shape[:2], dtype=torch.float64, device=matrix.device)
    else:
        z = per_view(sites.z.detach(), matrix).abs().amax(-1)
    return _extent(matrix, (sites.x.abs().amax(0), sites.y.abs().amax(0), z))


def point_extent(matrix: Tensor, points: Tensor) -> Tensor:
    """A bound on the terms of ``M (X, 1)`` over points (B, N, 3), (B, V)."""
    reach = points.detach().double().abs().sum(1)  # (B, 3); the sum, unlike the maximum, exists for no points
    return _extent(matrix, reach[:, None].unbind(-1))


def scale_below_overflow(extent: Tensor) -> Tensor:
    """A factor 2^-k that brings `extent` to `LARGEST_COORDINATE` at most, 1 where it is smaller."""
    return torch.exp2(-torch.log2(extent.clamp_min(LARGEST_COORDINATE) / LARGEST_COORDINATE).ceil())


def unit_vectors(rows: Sequence[Tensor], terms: Tensor, view_mask: Tensor | None) -> Tensor:
    """Normalise vectors, three rows (B, V, *sites), to (B, V, 3, *sites); 0 with zero gradient at 0.

    `terms` broadcasts to (B, V, *sites): a bound on the terms that add up to the vector. A vector as short as their
    rounding error, or than `SMALLEST_DEPTH`, has no direction: the site is the camera centre.
    """
    vector = torch.stack(list(rows), 2)
    shortest = (4.0 * torch.finfo(vector.dtype).eps * terms.to(vector.dtype)).clamp_min(SMALLEST_DEPTH)[:, :, None]
    # Scaled, as the square or the derivative of a short vector's inverse length leaves float32.
    factor = 1.0 / power_of_two_above(vector.detach().abs().amax(2, keepdim=True).clamp_min(SMALLEST_DEPTH))
    vector, shortest = vector * factor, shortest * factor
    squares = vector.square().sum(2, keepdim=True)
    away = squares > shortest.square()
    unit = torch.where(away, vector * torch.where(away, squares, 1.0).rsqrt(), 0.0)
    return mask_views(unit, view_mask)


def lattice_directions(sites: Sites, dtype: torch.dtype) -> Tensor:
    """Unit ray directions at the sites of a lattice, (B, V, 3, D, H, W)."""
    assert sites.direction is not None
    matrix = sites.direction / power_of_two_above(sites.direction.detach().abs().amax((-1, -2)))[..., None, None]
    # Bounded plane by plane, so that a slab has the same directions as the whole.
    w, z = site_coordinates(sites, matrix.detach(), torch.float64)
    a = matrix.detach().abs().amax(-2)[..., None, None, None, :]  # (B, V, 1, 1, 1, 4)
    flat = a[..., 0] * sites.x.abs().amax(0) + a[..., 1] * sites.y.abs().amax(0) + a[..., 3]
    z = z.detach().abs()
    terms = flat + a[..., 2] * z[..., None, None] if w is None else flat * w.detach() + a[..., 2] * z
    return unit_vectors(lattice_rows(matrix, sites, dtype), terms, sites.view_mask)


def point_directions(
    direction: Tensor, points: Tensor, part: slice, view_mask: Tensor | None, dtype: torch.dtype
) -> Tensor:
    """Unit ray directions at a part of the points (B, N, 3), (B, V, 3, n)."""
    largest = direction.detach().abs().amax((-1, -2))
    scale = power_of_two_above(torch.maximum(point_extent(direction, points), largest / LARGEST_COORDINATE))
    matrix = direction / scale[..., None, None]
    reach = [axis[:, None] for axis in points[:, part].detach().abs().unbind(-1)]  # (B, 1, N)
    return unit_vectors(point_rows(matrix, points[:, part], dtype), _extent(matrix[:, :, None], reach), view_mask)


def recenter(points: Tensor) -> tuple[Tensor, Tensor]:
    """An origin amid the points of each scene, (B, 3) float64, and the points relative to it.

    Applied to coordinates far from their origin, float32 loses pixels; a matrix composed in float64 takes in the origin
    (`recentered_matrix`). The origin lies on a coarse lattice, so that no digit of a coordinate is lost. It stays where
    it is unless it is many times as far away as the points are from each other: some may be next to it.
    """
    double = points.double()
    known = double.detach()
    count = max(1, points.shape[1]) if isinstance(points.shape[1], int) else points.shape[1]
    mean = known.sum(1) / count
    spread = torch.cat((torch.zeros_like(mean[:, None]), (known - mean[:, None]).abs()), 1).amax((1, 2))[:, None]
    step = power_of_two_above(spread)
    is_far = mean.abs().amax(-1, keepdim=True) > 8.0 * spread
    origin = torch.where(is_far, torch.where(spread > 0, torch.round(mean / step) * step, mean), 0.0)
    return origin, double - origin[:, None]


def recentered_matrix(matrix: Tensor, origin: Tensor) -> Tensor:
    """The matrix (B, V, 3, 4) for points relative to an origin (B, 3)."""
    shift = (matrix[..., :3] * origin[:, None, None]).sum(-1, keepdim=True)
    return torch.cat((matrix[..., :3], matrix[..., 3:] + shift), -1)


def power_of_two_above(value: Tensor) -> Tensor:
    """The power of two at or above a number, 1 for 0: a scale that rounds nothing."""
    return torch.exp2(torch.log2(torch.where(value > 0, value, 1.0)).ceil())


def mask_views(values: Tensor, view_mask: Tensor | None) -> Tensor:
    """(B, V, ...) with 0 for masked views."""
    return values if view_mask is None else torch.where(_aligned(view_mask, values.dim()), values, 0.0)


def _aligned(mask: Tensor, dim: int) -> Tensor:
    """(B, V) -> (B, V, 1, ...) of `dim` axes."""
    return mask.reshape(*mask.shape, *(1,) * (dim - 2))


def perspective_division(
    rows: Sequence[Tensor], unit: Tensor, view_mask: Tensor | None, options: Options
) -> tuple[list[Tensor], Tensor]:
    """Pixels x and y from homogeneous ones, `OUTSIDE` for sites not in front; and which sites are in front."""
    x, y, z = rows
    threshold = (options.near * unit).clamp_min(SMALLEST_DEPTH)
    if view_mask is not None:
        threshold = torch.where(_aligned(view_mask, z.dim()), threshold, torch.inf)
    front = z > threshold
    inverse = torch.where(front, z, 1.0).reciprocal()
    return [torch.where(front, axis * inverse, OUTSIDE) for axis in (x, y)], front


def project_points(
    matrix: Tensor, direction: Tensor | None, points: Tensor, view_mask: Tensor | None, options: Options
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments of `unproject_points` as pixels, front and extra of `reference.sample_pixels`, in float32."""
    origin, points = recenter(points)
    matrix = recentered_matrix(matrix, origin)
    scale = scale_below_overflow(point_extent(matrix, points))[..., None]  # (B, V, 1)
    rows = point_rows(matrix * scale[..., None], points, torch.float32)
    unit = scale.float()
    (x, y), front = perspective_division(rows, unit, view_mask, options)
    extra = []
    if options.depth:
        largest = torch.finfo(torch.float32).max
        extra.append(mask_views(rows[2] / unit, view_mask).clamp(-largest, largest)[:, :, None])
    if direction is not None:
        direction, every = recentered_matrix(direction, origin), slice(0, points.shape[1])
        extra.append(point_directions(direction, points, every, view_mask, torch.float32))
    return torch.stack((x, y), -1), front, torch.cat(extra, 2) if extra else None


def volume_index(
    matrix: Tensor, planes: Tensor | None, points: Tensor, options: Options, dtype: torch.dtype
) -> tuple[list[Tensor], Tensor]:
    """The index x, y, z in a volume of points (B, N, 3), each (B, 1, N), and which points are in front.

    The matrix (B, 1, 3, 4) maps (X, 1) to the index where `planes` is None, and else to the homogeneous pixel of a
    frustum with planes at these depths, (P,) or (B, P).
    """
    origin, points = recenter(points)
    matrix = recentered_matrix(matrix, origin)
    scale = scale_below_overflow(point_extent(matrix, points))[..., None]  # (B, 1, 1)
    rows, unit = point_rows(matrix * scale[..., None], points, dtype), scale.to(dtype)
    if planes is None:
        return [row / unit for row in rows], torch.ones_like(rows[0], dtype=torch.bool)
    index, front = perspective_division(rows, unit, None, options)
    depth = torch.where(front, rows[2] / unit, 1.0)
    return [*index, plane_index(depth[:, 0], planes)[:, None]], front


def plane_index(depth: Tensor, planes: Tensor) -> Tensor:
    """The fractional plane (B, N) of depths (B, N), linear in 1/depth between neighbours; 0 if there is one plane.

    In the cell of planes at a and b it is ``k + (1/a - 1/d) / (1/a - 1/b) = k + b / (b - a) (d - a) / d``: exact at a.
    """
    if planes.shape[-1] == 1:
        return torch.zeros_like(depth)
    planes = planes.expand(depth.shape[0], planes.shape[-1])
    lower, upper = planes[:, :-1], planes[:, 1:]
    slope = (upper / (upper - lower)).to(depth.dtype)
    lower = saturating_cast(lower, depth.dtype)
    cell = torch.searchsorted(lower.detach().contiguous(), depth.detach().contiguous(), right=True)
    cell = (cell - 1).clamp_min(0)  # the end cells go on outside
    start = lower.gather(1, cell)
    # Bounded, so that the quotient and its derivatives are finite; so far from the planes nothing is interpolated.
    depth = torch.maximum(depth.clamp_max(torch.finfo(depth.dtype).max), 2.0**-40 * start)
    return cell + slope.gather(1, cell) * ((depth - start) / depth)


def pixels_in_front(
    pixels: Tensor, depth: Tensor, valid: Tensor, options: Options
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments of `sample_views` as pixels, front and extra of `reference.sample_pixels`, in float32."""
    distance, largest = depth.float(), torch.finfo(torch.float32).max
    extra = torch.where(valid, distance.clamp(-largest, largest), 0.0)[:, :, None] if options.depth else None
    return pixels.float(), valid & (distance > options.near), extra
