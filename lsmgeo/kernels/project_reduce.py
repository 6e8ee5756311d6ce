"""A plane sweep and a linear map of its stacked channels: tile by tile, with a matrix product for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor

from lsmgeo._dtypes import saturating_cast, saturation_limit
from lsmgeo.kernels.native import library
from lsmgeo.kernels.request import Options, Sites

__all__ = ["project_reduce", "project_reduce_backward"]

LARGEST_TILE = {"cpu": 16 << 20, "triton": 256 << 20}  # bytes
LEAST_TILES = 32


def _tiles(
    volume: Tensor, weight: Tensor, sites: Sites, backend: str
) -> Iterator[tuple[int, int, slice, Sites, Tensor]]:
    """Scene, view, rows of the maps, their sites, and memory (pixels, planes * channels) for their stacked channels."""
    (B, V), (_, channels, planes), (_, height, width) = sites.matrix.shape[:2], weight.shape, sites.counts()
    row = max(1, 4 * channels * planes * width)
    most = min(LARGEST_TILE[backend], B * V * height * row // LEAST_TILES)
    step = min(max(1, most // row), max(1, height))
    memory = volume.new_empty((step * width, planes * channels), dtype=torch.float32)
    for b, v, start in product(range(B), range(V), range(0, height, step)):
        rows = slice(start, min(start + step, height))
        yield b, v, rows, _tile_sites(sites, b, v, rows), memory[: (rows.stop - start) * width]


def _tile_sites(sites: Sites, b: int, v: int, rows: slice) -> Sites:
    z = sites.z if sites.z.dim() == 1 else sites.z[b] if sites.z.dim() == 2 else sites.z[b, v]
    one = (slice(b, b + 1), slice(v, v + 1))
    direction = None if sites.direction is None else sites.direction.expand_as(sites.matrix)[one]
    mask = None if sites.view_mask is None else sites.view_mask[one]
    return Sites(sites.matrix[one], direction, sites.x, sites.y[rows], z, sites.projective, mask)


def _unstacked(tile: Tensor, weight: Tensor, width: int) -> Tensor:
    """A tile (rows * width, planes * channels) as (1, 1, C', P, rows, width), without a copy."""
    _, channels, planes = weight.shape
    rows = tile.shape[0] // max(1, width)
    return tile.view(rows, width, planes, channels).permute(3, 2, 0, 1)[None, None]


def _linear_map(weight: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor]:
    """The matrix (P C', O) and the offset (O,) in float32."""
    outputs, channels, planes = weight.shape
    offset = weight.new_zeros(outputs, dtype=torch.float32) if bias is None else bias.float()
    return weight.permute(2, 1, 0).reshape(planes * channels, outputs).float(), offset


def _can_saturate(
    dtype: torch.dtype, volume: Tensor, sites: Sites, matrix: Tensor, offset: Tensor, options: Options
) -> bool:
    """Whether maps may exceed their dtype; backward then recomputes them to find where they do."""
    if dtype == torch.float32 or not offset.numel():
        return False
    if volume.device.type != "cpu":  # reading values would synchronise; bfloat16 has the range of float32
        return dtype == torch.float16
    channels = [volume.new_ones(1)]  # those of a direction
    if volume.numel():
        channels.append(volume.abs().amax()[None])
    if options.depth:
        channels.append((1.0 / sites.z).amax()[None])
    largest = float(torch.cat([channel.float() for channel in channels]).amax())
    return not largest * float(matrix.abs().sum(0).amax()) + float(offset.abs().amax()) <= saturation_limit(dtype)


def project_reduce(
    kernels: Any, volume: Tensor, weight: Tensor, bias: Tensor | None, sites: Sites, options: Options
) -> tuple[Tensor, Tensor]:
    """As `reference.project_reduce`, by these kernels' `plane_sweep_project`."""
    volume = library.channels_last(volume, 1)  # copied once, not for each tile
    (B, V), (P, h, w), outputs = sites.matrix.shape[:2], sites.counts(), weight.shape[0]
    if kernels is library:
        maps = library.empty((B, V, outputs, h, w), volume.dtype, (0, 1, 3, 4, 2))
    else:
        maps = volume.new_empty((B, V, h, w, outputs)).movedim(-1, 2)
    visible = volume.new_empty((B, V, P, h, w), dtype=torch.bool)
    matrix, offset = _linear_map(weight, bias)
    with torch.autocast(volume.device.type, enabled=False):
        for b, v, rows, part, tile in _tiles(volume, weight, sites, options.backend):
            _, visible[b : b + 1, v : v + 1, :, rows] = kernels.plane_sweep_project(
                volume[b : b + 1], part, options, _unstacked(tile, weight, w)
            )
            target = maps[b, v, :, rows].permute(1, 2, 0).view(tile.shape[0], outputs)
            if target.dtype == torch.float32:
                torch.addmm(offset, tile, matrix, out=target)
            else:
                target.copy_(saturating_cast(torch.addmm(offset, tile, matrix), target.dtype))
    return maps, visible


def project_reduce_backward(
    kernels: Any,
    gradient: Tensor,
    volume: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    sites: Sites,
    options: Options,
    needs: Sequence[bool],
) -> tuple[Tensor | None, ...]:
    """Gradients to volume, weight, bias, matrix, direction and z; None where not needed."""
    original, volume = volume, library.channels_last(volume, 1)
    (B, V), (P, _, w), outputs = sites.matrix.shape[:2], sites.counts(), weight.shape[0]
    matrix, offset = _linear_map(weight, bias)
    saturates = _can_saturate(gradient.dtype, volume, sites, matrix, offset, options)
    needs_sites = needs[0], *needs[3:]
    to_volume = None
    if needs[0]:
        to_volume = volume.new_zeros(volume.movedim(1, -1).shape, dtype=torch.float32).movedim(-1, 1)
    to_sites = [sites.matrix.new_zeros(shape) for shape in ((B, V, 3, 4), (B, V, 3, 4), (B, V, P))]
    to_matrix = torch.zeros_like(matrix) if needs[1] else None
    to_bias = torch.zeros_like(offset) if needs[2] else None
    with torch.autocast(volume.device.type, enabled=False):
        for b, v, rows, part, tile in _tiles(volume, weight, sites, options.backend):
            scene, swept = volume[b : b + 1], _unstacked(tile, weight, w)
            incoming = gradient[b, v, :, rows].permute(1, 2, 0).reshape(tile.shape[0], outputs).float()
            if to_matrix is not None or saturates:
                kernels.plane_sweep_project(scene, part, options, swept)
            if saturates:
                kept = torch.addmm(offset, tile, matrix).abs() <= saturation_limit(gradient.dtype)
                incoming = torch.where(kept, incoming, 0.0)
            if to_matrix is not None:
                to_matrix.addmm_(tile.t(), incoming)
            if to_bias is not None:
                to_bias += incoming.sum(0)
            if any(needs_sites):
                torch.mm(incoming, matrix.t(), out=tile)
                into = None if to_volume is None else to_volume[b : b + 1]
                _, *found = kernels.plane_sweep_project_backward(swept, scene, part, options, needs_sites, into)
                for total, gradient_part in zip(to_sites, found, strict=True):
                    if gradient_part is not None:
                        total[b, v] += gradient_part[0, 0]
    to_weight = None
    if to_matrix is not None:
        to_weight = to_matrix.view(*weight.permute(2, 1, 0).shape).permute(2, 1, 0).contiguous().to(weight.dtype)
    to_bias = None if to_bias is None or bias is None else to_bias.to(bias.dtype)
    to_volume = None if to_volume is None else saturating_cast(to_volume, original.dtype)
    return to_volume, to_weight, to_bias, *to_sites
