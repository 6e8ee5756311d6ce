"""Tables of the sites for the Triton kernels, and from the kernels' sums to the gradients to matrices and depths.

All of it has the size of the matrices and axes, and is float64 until the kernels read it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo.kernels.lattice_geometry import lattice_extent, per_view, power_of_two_above, scale_below_overflow
from lsmgeo.kernels.request import Options, Sites


class Tables(NamedTuple):
    """The sites of a lattice for the kernels, and what the gradients need, float64."""

    views: Tensor  # (B, V, 28), see `types.FIELDS`
    x: Tensor  # these four float32
    y: Tensor
    z: Tensor  # (B, V, D)
    depth: Tensor | None  # (B, V, D), of frustums in volumes
    projective: bool
    matrix: Tensor  # as in `views`
    scale: Tensor  # (B, V), of the matrix
    direction: Tensor | None
    direction_scale: Tensor | None  # (B, V), of the direction's matrix
    exact: Tensor  # z, or the depth of volumes, float64
    depths: Tensor | None  # (B, V, 1, D, H, W) float32, where each site has its own; z and depth are then not used


def tables(sites: Sites, options: Options, volume: bool) -> Tables:
    """The tables of a call. Masked views have matrices of zeros, so that theirs are not read."""
    mask = sites.view_mask
    B, V = sites.matrix.shape[:2]
    depths = None
    if not sites.per_site():
        z = per_view(sites.z, sites.matrix)
    else:
        z, depths = sites.matrix.new_ones(B, V, 1), sites.z
        if depths.dtype == torch.float64:  # what is positive and finite stays so
            limits = torch.finfo(torch.float32)
            depths = depths.clamp(limits.smallest_normal, limits.max).float()
        depths = depths.expand(B, V, *depths.shape[2:])[:, :, None]
    matrix, direction = sites.matrix, sites.direction if options.direction else None
    if mask is not None:
        z = torch.where(mask[..., None], z, 1.0)
        matrix = torch.where(mask[..., None, None], matrix, 0.0)
        direction = None if direction is None else torch.where(mask[..., None, None], direction, 0.0)
    one = matrix.new_ones(matrix.shape[:2])
    kept = one if mask is None else mask.to(one.dtype)
    scale, direction_scale = one, None
    if not volume:  # homogeneous: a factor moves no pixel
        extent = lattice_extent(matrix, sites if sites.per_site() else sites._replace(z=z))
        scale = scale_below_overflow(extent)
        matrix = matrix * scale[..., None, None]
    fields = [matrix.flatten(2), scale[..., None], kept[..., None]]
    if direction is None:
        fields.append(one[..., None].expand(-1, -1, 14))
    else:
        direction_scale = 1.0 / power_of_two_above(direction.abs().amax((-1, -2)))
        direction = direction * direction_scale[..., None, None]
        terms = direction.abs().amax(-2)
        constant = terms[..., 0] * sites.x.abs().amax(0) + terms[..., 1] * sites.y.abs().amax(0) + terms[..., 3]
        fields += [direction.flatten(2), constant[..., None], terms[..., 2, None]]
    depth = 1.0 / z if volume else None
    return Tables(
        torch.cat(fields, -1).float().contiguous(),
        sites.x.float().contiguous(),
        sites.y.float().contiguous(),
        z.float().contiguous(),
        None if depth is None else depth.float().contiguous(),
        sites.projective,
        matrix,
        scale,
        direction,
        direction_scale,
        z if depth is None else depth,
        depths,
    )


def site_gradients(
    tables: Tables, options: Options, index: Tensor | None, extra: Tensor | None, depths: Tensor | None
) -> tuple[Tensor, Tensor | None, Tensor]:
    """As `lattice_gradients`, where each site has its own depth: (B, V, 3, 4) twice and (B, V, D, H, W).

    Args:
        tables: of the call.
        options: of the call.
        index: (B V, D, blocks, tiles, 12), of the rows of M: of each g w x, g w y, g w and g z.
        extra: (B V, D, blocks, 16): of the depth's row, and of the rows of G.
        depths: (B V, parts, D, H, W).
    """
    columns = [0, 1, 3, 2]  # of x, y, z and 1
    matrix, direction = torch.zeros_like(tables.matrix), None
    if index is not None:
        matrix += index.sum((1, 2, 3), dtype=torch.float64).view_as(matrix)[..., columns]
    total = None if extra is None else extra.sum((1, 2), dtype=torch.float64)
    if options.depth and total is not None and tables.depth is None:
        matrix[..., 2, :] += total[:, :4].view(*matrix.shape[:2], 4)[..., columns]
    if tables.direction is not None and tables.direction_scale is not None and total is not None:
        direction = total[:, 4:].view_as(matrix)[..., columns] * tables.direction_scale[..., None, None]
    assert depths is not None
    return matrix * tables.scale[..., None, None], direction, depths.sum(1).unflatten(0, tuple(matrix.shape[:2]))


def lattice_gradients(
    tables: Tables, options: Options, index_sums: Tensor | None, extra_sums: Tensor | None
) -> tuple[Tensor, Tensor | None, Tensor]:
    """From sums over the sites to the gradients of M, G and z: (B, V, 3, 4) twice and (B, V, D).

    Args:
        tables: of the call.
        options: of the call.
        index_sums: (B V, D, blocks, tiles, 9), of the rows of M: of each g x, g y and g.
        extra_sums: (B V, D, blocks, 13): of depth (g x, g y, g, and through s), and of the rows of G.
    """
    shape = (*tables.z.shape, 3, 3)
    rows, through = tables.matrix.new_zeros(shape), tables.matrix.new_zeros(shape[:3])
    if index_sums is not None:
        rows = rows + index_sums.sum((2, 3), dtype=torch.float64).reshape(shape)
    extra = (
        None if extra_sums is None else extra_sums.sum(2, dtype=torch.float64).reshape(*shape[:3], extra_sums.shape[-1])
    )
    if tables.depth is not None:
        depth = tables.exact
        matrix = _matrix_sums(rows, depth, torch.ones_like(depth))
        plane = torch.cat((tables.matrix[..., :2], tables.matrix[..., 3:]), -1)[:, :, None]
        along = (rows * plane).sum((-1, -2))
        if options.depth and extra is not None:
            along = along + extra[..., 3]
        z_gradient = -along * depth.square()
        z = 1.0 / depth
    else:
        z = tables.exact
        if options.depth and extra is not None:
            rows[..., 2, :] += extra[..., :3]
            if tables.projective:
                through = -extra[..., 3] / z
        matrix = _matrix_sums(rows, torch.ones_like(z), z) * tables.scale[..., None, None]
        z_gradient = (rows[..., 2] * tables.matrix[:, :, None, :, 2]).sum(-1) + through
    direction = None
    if tables.direction is not None and tables.direction_scale is not None and extra is not None:
        direction_rows = extra[..., 4:].unflatten(-1, (3, 3))
        direction = _matrix_sums(direction_rows, torch.ones_like(z), z) * tables.direction_scale[..., None, None]
        z_gradient = z_gradient + (direction_rows[..., 2] * tables.direction[:, :, None, :, 2]).sum(-1)
    return matrix, direction, z_gradient


def _matrix_sums(rows: Tensor, plane: Tensor, line: Tensor) -> Tensor:
    """Sums over the planes of (B, V, D, 3, 3) with factors (B, V, D) of the terms in x, y and 1, and in z."""
    x, y, one = (rows * plane[..., None, None]).sum(2).unbind(-1)
    return torch.stack((x, y, (rows[..., 2] * line[..., None]).sum(2), one), -1)
