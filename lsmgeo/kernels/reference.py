"""The reference kernels: vectorised PyTorch, differentiable in everything, twice. The yardstick for all others.

Only this module knows `grid_sample` and its `align_corners`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import product
from math import prod
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo.debugging import is_traced
from lsmgeo.kernels.lattice_geometry import (
    LARGEST_COORDINATE,
    OUTSIDE,
    lattice_directions,
    lattice_extent,
    lattice_rows,
    mask_views,
    per_view,
    perspective_division,
    plane_rows,
    point_directions,
    point_extent,
    point_rows,
    recenter,
    recentered_matrix,
    scale_below_overflow,
    site_coordinates,
    site_depths,
)
from lsmgeo.kernels.recompute import recomputed
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.view_statistics import view_statistics

__all__ = ["OPERATORS", "sample_cells", "why_not"]


def why_not(operator: str, source: Tensor, options: Options) -> str | None:
    """The reference runs everything."""
    return None


# Sampling


def _bounded(index: Tensor, size: int, options: Options) -> Tensor:
    """An array index by mode and padding: the nearest cell's, within the border, finite."""
    if options.mode == "nearest":
        # The cell that contains the sample; grid_sample would round half to even, and floor(u + 0.5) rounds the number
        # just below 0.5 up.
        cell = index.detach().floor()
        index = cell + (index.detach() - cell >= 0.5)
    if options.padding_mode == "border":
        # No gradient at and beyond the outermost centres.
        return torch.where((index > 0) & (index < size - 1), index, index.detach().clamp(0.0, size - 1.0))
    return index.clamp(OUTSIDE, size + 1.0)  # all taps are outside there too; infinity would give NaN


def _coordinate(index: Tensor, size: int, options: Options) -> Tensor:
    """From an array index to `grid_sample`'s coordinate, ``(2 u + 1) / n - 1`` for ``align_corners=False``."""
    index = _bounded(index, size, options)
    # grid_sample undoes this with rounding errors of a few ulp. An index that is an integer must not fall into the cell
    # below, which it does not read and whose derivative it does not have: a nudge lifts it over them.
    origin = torch.full((), 1.0 / size - 1.0, dtype=index.dtype, device=index.device)
    whole = index.detach()
    start = torch.where(whole == whole.floor(), origin + 4.0 * torch.finfo(index.dtype).eps, origin)
    return torch.add(start, index, alpha=2.0 / size)


def sample_cells(source: Tensor, index: Sequence[Tensor], front: Tensor, options: Options) -> tuple[Tensor, Tensor]:
    """Interpolate arrays at fractional indices.

    Args:
        source: (B, V, C, *sizes), sizes (h, w) or (D, H, W).
        index: fractional indices x, y(, z), each (B, V, *sites); `OUTSIDE` where not in front.
        front: broadcasts to (B, V, *sites), False where the source must not be read.
        options: mode and padding_mode.

    Returns:
        Values (B, V, C, *sites), exactly 0 where not in front, and visibility (B, V, *sites).
    """
    sizes = tuple(reversed(source.shape[3:]))  # x, y(, z)
    inside = [(axis >= -0.5) & (axis < size - 0.5) for axis, size in zip(index, sizes, strict=True)]
    visible = reduce(torch.logical_and, inside)
    grid = torch.stack([_coordinate(axis, size, options) for axis, size in zip(index, sizes, strict=True)], -1)
    grid = grid.flatten(0, 1)
    if len(sizes) == 2:  # grid_sample requires as many axes of sites as the source has
        grid = grid.flatten(1, -3) if grid.dim() > 3 else grid[:, None]
    values = grid_sample(
        source.flatten(0, 1),
        grid,
        mode="nearest" if options.mode == "nearest" else "bilinear",
        padding_mode=options.padding_mode,
        align_corners=False,
    ).reshape(*source.shape[:3], *visible.shape[2:])
    if options.padding_mode == "border":
        values = values.masked_fill(~front[:, :, None], 0.0)
    return values, visible


def _output(values: Tensor, depth: Tensor | None, direction: Tensor | None, dtype: torch.dtype) -> Tensor:
    """Values (B, V, C, *sites), with depth (B, V, *sites) and direction (B, V, 3, *sites) appended, in `dtype`.

    What is finite stays finite: geometry saturates in every dtype, features where they are cast to a smaller one.
    """
    blocks = [saturating_cast(values, dtype)]
    if depth is not None:
        largest = torch.finfo(depth.dtype).max
        blocks.append(saturating_cast(depth.clamp(-largest, largest), dtype)[:, :, None])
    if direction is not None:
        blocks.append(saturating_cast(direction, dtype))
    return torch.cat(blocks, 2) if len(blocks) > 1 else blocks[0]


def _correlate(values: Tensor, reference: Tensor, front: Tensor, groups: int) -> Tensor:
    """Means over groups of channels of reference times sample: (B, V, C, *sites) -> (B, V, groups, *sites).

    The reference (B, C, *sites) is not read at sites that are not in front. Products saturate.
    """
    reference = torch.where(front[:, :, None], reference[:, None], 0.0)
    largest = torch.finfo(values.dtype).max
    size = values.shape[2] // groups
    products = (values * reference).clamp(-largest, largest) / max(size, 1)
    return products.unflatten(2, (groups, size)).sum(3).clamp(-largest, largest)


def _over_pieces(
    piece: Callable[..., tuple[Tensor, Tensor]],
    total: int,
    inputs: Sequence[Tensor | None],
    options: Options,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """`piece(start, stop, *inputs)` over all `total` sites of the first axis, reduced over the views if requested.

    With a reduction the values of all views exist for one piece of the axis at a time; backward recomputes them.
    """
    if not options.reduce:
        return piece(0, total, *inputs)

    def reduced(start: int, stop: int, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
        values, visible = piece(start, stop, *inputs)
        return saturating_cast(view_statistics(values, visible, options.reduce), dtype), visible

    if is_traced():  # no loop whose length depends on a size, no recomputation by hand
        return reduced(0, total, *inputs)
    views = inputs[0].shape[1]  # type: ignore[union-attr]
    step = max(1, -(-total // views))
    pieces = [
        recomputed(partial(reduced, start, min(start + step, total)), *inputs)
        for start in range(0, max(1, total), step)
    ]
    return torch.cat([values for values, _ in pieces], 2), torch.cat([visible for _, visible in pieces], 2)


# Operators


def unproject(source: Tensor, sites: Sites, reference: Tensor | None, options: Options) -> tuple[Tensor, Tensor]:
    """Sample images (B, V, C, h, w) at the sites of a lattice.

    Args:
        source: the images.
        sites: the lattice.
        reference: (B, C, D or 1, H, W), to correlate the samples with, or None.
        options: of the call.

    Returns:
        (B, V, C', D, H, W), or (B, C'', D, H, W) where options.reduce is set, and visibility (B, V, D, H, W).
    """
    dtype, output = computing_dtype(source), source.dtype
    source = source.to(dtype)
    scale = scale_below_overflow(lattice_extent(sites.matrix, sites))[..., None]  # (B, V, 1)

    def piece(
        start: int,
        stop: int,
        source: Tensor,
        matrix: Tensor,
        direction: Tensor | None,
        z: Tensor,
        reference: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        matrix = matrix * scale[..., None]  # homogeneous: a factor moves no pixel
        part = sites.with_geometry(matrix, direction, sites.planes(z, start, stop))
        rows, unit = lattice_rows(matrix, part, dtype), _unit(part, scale, dtype)
        index, front = perspective_division(rows, unit, part.view_mask, options)
        values, visible = sample_cells(source, index, front, options)
        depth = None
        if options.depth:
            depth = _own_depths(part, scale, dtype) if part.per_site() else rows[2] / unit
            depth = mask_views(depth, part.view_mask)
        if reference is not None:
            at_planes = reference if reference.shape[2] == 1 else reference[:, :, start:stop]
            values = _correlate(values, at_planes.to(dtype), front, options.groups)
        vectors = lattice_directions(part, dtype) if options.direction else None
        return _output(values, depth, vectors, dtype if options.reduce else output), visible

    inputs = source, sites.matrix, sites.direction, sites.z, reference
    return _over_pieces(piece, sites.counts()[0], inputs, options, output)


def _unit(sites: Sites, scale: Tensor, dtype: torch.dtype) -> Tensor:
    """The third coordinate of ``M q`` at depth 1, M times `scale` (B, V, 1): broadcasts to (B, V, D, H, W)."""
    if sites.per_site():
        return site_coordinates(sites, sites.matrix, dtype)[1] * scale.to(dtype)[..., None, None]
    return (per_view(sites.z, sites.matrix) * scale if sites.projective else scale).to(dtype)[..., None, None]


def _own_depths(sites: Sites, scale: Tensor, dtype: torch.dtype) -> Tensor:
    """The views' depths of sites that each have their own: no division by a number next to 0. M is times `scale`."""
    m = (sites.matrix[..., 2:, :] / scale[..., None]).to(dtype)  # (B, V, 1, 4)
    plane = plane_rows(m, sites)[:, :, :, None] * site_depths(sites, dtype)[:, :, None]
    return plane[:, :, 0] + m[..., 2, None, None]


def unproject_points(
    source: Tensor, matrix: Tensor, direction: Tensor | None, points: Tensor, view_mask: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """Sample images (B, V, C, h, w) at points (B, N, 3), with matrices (B, V, 3, 4) on (X, 1).

    Returns:
        (B, V, C', N), or (B, C'', N) where options.reduce is set, and visibility (B, V, N).
    """
    dtype, output = computing_dtype(source), source.dtype
    source = source.to(dtype)
    origin, points = recenter(points)
    matrix = recentered_matrix(matrix, origin)
    direction = None if direction is None else recentered_matrix(direction, origin)
    scale = scale_below_overflow(point_extent(matrix, points))[..., None]  # (B, V, 1)

    def piece(
        start: int, stop: int, source: Tensor, matrix: Tensor, direction: Tensor | None, points: Tensor
    ) -> tuple[Tensor, Tensor]:
        rows, unit = point_rows(matrix * scale[..., None], points[:, start:stop], dtype), scale.to(dtype)
        index, front = perspective_division(rows, unit, view_mask, options)
        values, visible = sample_cells(source, index, front, options)
        depth = mask_views(rows[2] / unit, view_mask) if options.depth else None
        vectors = None
        if direction is not None:
            vectors = point_directions(direction, points, slice(start, stop), view_mask, dtype)
        return _output(values, depth, vectors, dtype if options.reduce else output), visible

    return _over_pieces(piece, points.shape[1], (source, matrix, direction, points), options, output)


def sample_views(
    source: Tensor, pixels: Tensor, depth: Tensor, valid: Tensor, options: Options
) -> tuple[Tensor, Tensor]:
    """Sample images (B, V, C, h, w) at pixels (B, V, N, 2) of given depth (B, V, N), where valid.

    Returns:
        (B, V, C', N), or (B, C'', N) where options.reduce is set, and visibility (B, V, N).
    """
    dtype, output = computing_dtype(source), source.dtype
    source = source.to(dtype)

    def piece(start: int, stop: int, source: Tensor, pixels: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        part = slice(start, stop)
        distance, domain = depth[..., part].to(dtype), valid[..., part]
        front = domain & (distance > options.near)
        index = [torch.where(front, axis, OUTSIDE) for axis in pixels[:, :, part].to(dtype).unbind(-1)]
        values, visible = sample_cells(source, index, front, options)
        distance = torch.where(domain, distance, 0.0)
        return _output(values, distance if options.depth else None, None, dtype if options.reduce else output), visible

    return _over_pieces(piece, pixels.shape[2], (source, pixels, depth), options, output)


def sample_pixels(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """What the fused kernels compute for pixels, in the reference's operations: for second derivatives.

    Args:
        source: (B, V, C, h, w).
        pixels: (B, V, N, 2).
        front: (B, V, N) bool; nothing is read elsewhere.
        extra: (B, V, E, N), channels to append, or None.
        options: mode, padding_mode and reduce.

    Returns:
        (B, V, C + E, N), or (B, C'', N) where options.reduce is set, and visibility (B, V, N).
    """
    dtype = computing_dtype(source)
    index = [torch.where(front, axis, OUTSIDE) for axis in pixels.to(dtype).unbind(-1)]
    values, visible = sample_cells(source.to(dtype), index, front, options)
    if extra is not None:
        values = torch.cat((values, extra.to(dtype)), 2)
    if options.reduce:
        values = view_statistics(values, visible, options.reduce)
    return saturating_cast(values, source.dtype), visible


def _sweep_index(sites: Sites, options: Options, dtype: torch.dtype) -> tuple[list[Tensor], Tensor, Tensor]:
    """The index x, y, z of the frustums' sites in a volume, each (B, V, P, h, w), which are in front, their depth."""
    m = sites.matrix.to(dtype)
    if sites.per_site():
        depth = site_depths(sites, dtype)
    else:
        depth = (1.0 / per_view(sites.z, sites.matrix)).to(dtype)[..., None, None]  # (B, V, P, 1, 1)
    front = depth > options.near
    if sites.view_mask is not None:
        front = front & sites.view_mask[..., None, None, None]
    # M q / s = depth (M_x x + M_y y + M_1) + M_z. Planes not in front get an index outside the volume.
    plane = plane_rows(m, sites).clamp(-LARGEST_COORDINATE, LARGEST_COORDINATE)
    reach = torch.where(front, depth, 0.0)
    offset = torch.where(front[:, :, None], m[..., 2, None, None, None], OUTSIDE)  # (B, V, 3, P, 1, 1) or at each site
    return [torch.addcmul(offset[:, :, row], plane[:, :, row, None], reach) for row in range(3)], front, depth


def _sweep(source: Tensor, sites: Sites, options: Options, output: torch.dtype) -> tuple[Tensor, Tensor]:
    dtype = source.dtype
    index, front, depth = _sweep_index(sites, options, dtype)
    views = source[:, None].expand(source.shape[0], sites.matrix.shape[1], *source.shape[1:])
    values, visible = sample_cells(views, index, front, options)
    channel = mask_views(depth, sites.view_mask).expand(visible.shape)
    directions = lattice_directions(sites, dtype) if options.direction else None
    return _output(values, channel if options.depth else None, directions, output), visible


def plane_sweep_project(source: Tensor, sites: Sites, options: Options) -> tuple[Tensor, Tensor]:
    """Sample volumes (B, C, D, H, W) at the sites of the views' frustums.

    Returns:
        (B, V, C', P, h, w) and visibility (B, V, P, h, w).
    """
    return _sweep(source.to(computing_dtype(source)), sites, options, source.dtype)


def project_reduce(
    source: Tensor, sites: Sites, weight: Tensor, bias: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """`plane_sweep_project` and a linear map of its stacked channels, a few planes at a time.

    Args:
        source: (B, C, D, H, W).
        sites: the views' frustums, P planes.
        weight: (O, C', P).
        bias: (O,) or None.
        options: of the call.

    Returns:
        (B, V, O, h, w), and visibility (B, V, P, h, w).
    """
    dtype = computing_dtype(source)
    volume = source.to(dtype)
    total = sites.z.shape[-1]
    step = max(1, min(total // 8, 256 // max(1, weight.shape[1])))

    def piece(
        start: int, stop: int, volume: Tensor, matrix: Tensor, direction: Tensor | None, z: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor]:
        part = sites.with_geometry(matrix, direction, z[..., start:stop])
        maps, visible = _sweep(volume, part, options, dtype)
        stacked = maps.flatten(2, 3).flatten(3, 4)  # (B, V, C' p, h w)
        with torch.autocast(maps.device.type, enabled=False):
            mapped = torch.matmul(weight[:, :, start:stop].flatten(1).to(dtype), stacked)
        return mapped.unflatten(3, maps.shape[-2:]), visible

    inputs = (volume, sites.matrix, sites.direction, sites.z, weight)
    maps, visible = recomputed(partial(piece, 0, min(step, total)), *inputs)
    seen = [visible]
    for start in range(step, total, step):
        part, visible = recomputed(partial(piece, start, min(start + step, total)), *inputs)
        maps = maps + part
        seen.append(visible)
    if bias is not None:
        maps = maps + bias.to(dtype)[:, None, None]
    return saturating_cast(maps, source.dtype), torch.cat(seen, 2)


def splat(features: Tensor, sites: Sites, weights: Tensor | None, shape: Sequence[int], options: Options) -> Tensor:
    """The transpose of `plane_sweep_project`: add features to the cells of a volume at the sites of views' frustums.

    Args:
        features: (B, V, C, P, h, w), or (B, V, C, h, w) with weights.
        sites: the views' frustums.
        weights: (B, V, P, h, w), to multiply the features with, or None.
        shape: (D, H, W) of the volume.
        options: of the call.

    Returns:
        (B, C, D, H, W), float64 for float64, else float32.
    """
    dtype = computing_dtype(features)
    index, front, _ = _sweep_index(sites, options, dtype)
    sizes = tuple(reversed(shape))  # x, y, z
    index = [_bounded(axis, size, options) for axis, size in zip(index, sizes, strict=True)]
    lower = [axis.detach().floor() for axis in index]
    # What has no cell to be added to is not read.
    first = 0 if options.mode == "nearest" else -1
    exists = [(cell >= first) & (cell < size) for cell, size in zip(lower, sizes, strict=True)]
    read = reduce(torch.logical_and, exists, front)[:, :, None]
    values = torch.where(read, features.to(dtype) if weights is None else features.to(dtype)[:, :, :, None], 0.0)
    if weights is not None:
        values = values * torch.where(read, weights.to(dtype)[:, :, None], 0.0)
    fraction = [axis - cell for axis, cell in zip(index, lower, strict=True)]
    B, C, total = features.shape[0], features.shape[2], prod(shape)
    scene = torch.arange(B, device=features.device)[:, None, None, None, None] * total
    volume = values.new_zeros(B * total, C)
    for corner in [(0, 0, 0)] if options.mode == "nearest" else product((0, 1), repeat=3):
        weight, inside, cell = torch.ones_like(index[0]), torch.ones_like(index[0], dtype=torch.bool), scene
        for axis, (step, size) in enumerate(zip(corner, sizes, strict=True)):
            if options.mode != "nearest":
                weight = weight * (fraction[axis] if step else 1.0 - fraction[axis])
            at = lower[axis].long() + step
            inside = inside & (at >= 0) & (at < size)
            cell = cell + at * prod(sizes[:axis])
        part = torch.where(inside[:, :, None], values * weight[:, :, None], 0.0).movedim(2, -1)
        volume = volume.index_add(0, torch.where(inside, cell, 0).flatten(), part.flatten(0, 4))
    return volume.view(B, *shape, C).movedim(-1, 1)


OPERATORS: dict[str, Callable[..., Any]] = {
    "unproject": unproject,
    "unproject_points": unproject_points,
    "sample_views": sample_views,
    "plane_sweep_project": plane_sweep_project,
    "project_reduce": project_reduce,
    "splat": splat,
}
