"""The Triton backend: the operators, and how the kernels are launched for them.

Tensors in, tensors out, no autograd. Everything of the size of the sites is done in one launch. Triton is imported at
the first call.
"""

from __future__ import annotations

import importlib.util
import math
import os
from typing import Any

import torch
from torch import Tensor

from lsmgeo._dtypes import saturating_cast
from lsmgeo._torch_compat import as_constant
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.triton.launch_tables import lattice_gradients, tables
from lsmgeo.kernels.triton.launcher import (
    Accumulator,
    Call,
    accumulator,
    channels_last,
    empty_channels_last,
    launch,
    plan,
    room_for_sums,
    strided,
)

__all__ = [
    "plane_sweep_project",
    "plane_sweep_project_backward",
    "sample_views",
    "sample_views_backward",
    "unproject",
    "unproject_backward",
    "why_not",
]


def why_not(operator: str, source: Tensor, options: Options) -> str | None:
    """Why these kernels cannot run a call; None if they can."""
    if source.dtype == torch.float64:
        return "float64 stays on the reference path"
    if not _is_installed():
        return "Triton is not installed"
    if source.device.type != "cuda" and not (source.device.type == "cpu" and _is_interpreted()):
        return f"its kernels are for CUDA tensors, these are on {source.device.type} (or TRITON_INTERPRET=1, to debug)"
    return None


@as_constant
def _is_installed() -> bool:
    return importlib.util.find_spec("triton") is not None


def _is_interpreted() -> bool:
    return os.environ.get("TRITON_INTERPRET", "").lower() in ("1", "true", "on", "yes", "y")


def _extras(options: Options) -> int:
    return int(options.depth) + 3 * bool(options.direction)


def _joined(values: Tensor, options: Options) -> Tensor:
    """(B, 1, C'', ...) -> (B, C'', ...) where views are reduced."""
    return values[:, 0] if options.reduce else values


def _split(gradient: Tensor, options: Options) -> Tensor:
    return gradient[:, None] if options.reduce else gradient


def _forward(
    source: Tensor, out: Tensor, options: Options, extras: int, sites: Sites | None = None, **planned: Any
) -> Tensor:
    """Fill `out` (B, V or 1, C', D, H, W) from `source` (B, V, C, d, h, w); returns visibility (B, V, D, H, W)."""
    visible = torch.empty((*source.shape[:2], *out.shape[3:]), dtype=torch.uint8, device=source.device)
    if not visible.numel():
        return visible.view(torch.bool)
    lattice = None if sites is None else tables(sites, options, planned.get("volume", False))
    call = plan(source, out, options, extras, lattice, **planned)
    source = channels_last(source, math.prod(out.shape[3:]) * call.how.corners)
    launch("resample", call, strided(out), visible, strided(source))
    return visible.view(torch.bool)


@torch.no_grad()
def unproject(source: Tensor, sites: Sites, options: Options) -> tuple[Tensor, Tensor]:
    """As `reference.unproject`: images (B, V, C, h, w) at the sites of a lattice.

    Returns:
        (B, V, C', D, H, W), or (B, C'', D, H, W) where options.reduce is set, channels last in memory, and visibility
        (B, V, D, H, W).
    """
    B, V, C = source.shape[:3]
    channels = (C + _extras(options)) * max(1, len(options.reduce))
    shape = (sites.z.shape[-1], len(sites.y), len(sites.x))
    out = empty_channels_last(B, 1 if options.reduce else V, channels, *shape, like=source)
    visible = _forward(source.unsqueeze(3), out, options, _extras(options), sites)
    return _joined(out, options), visible


@torch.no_grad()
def unproject_backward(
    gradient: Tensor, source: Tensor, sites: Sites, options: Options, needs: tuple[bool, bool, bool, bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """The vector-Jacobian product of `unproject`.

    Args:
        gradient: of its values, any strides.
        source: as given to it.
        sites: as given to it.
        options: as given to it.
        needs: which of the gradients below are needed.

    Returns:
        Gradients to the source, in its dtype; to M and G (B, V, 3, 4) and to z (B, V, D), float64. None where not
        needed.
    """
    found = _lattice_backward(_split(gradient, options), source.unsqueeze(3), sites, options, needs, False)
    return None if found[0] is None else saturating_cast(found[0].squeeze(3), source.dtype), *found[1:]


def _lattice_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: tuple[bool, bool, bool, bool],
    volume: bool,
    given: Tensor | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Gradients to a (B, V or 1, C, d, h, w) source, in float32, and to the geometry."""
    wanted = needs[0], any(needs[1:])
    count = math.prod(gradient.shape[3:]) * (source.shape[1] if volume else 1)
    into = accumulator(gradient, source, options, count, volume, given) if needs[0] else None
    if count:
        known = tables(sites, options, volume)
        call = plan(source, gradient, options, _extras(options), known, volume=volume, needs=wanted)
        index_sums, extra_sums = room_for_sums(call, options, wanted[1], source)
        _launch_backward(call, gradient, source, into, index_sums, extra_sums)
        found = lattice_gradients(known, options, index_sums, extra_sums) if wanted[1] else (None,) * 3
    else:
        shape = sites.matrix.shape
        found = torch.zeros_like(sites.matrix), None, sites.matrix.new_zeros((*shape[:2], sites.z.shape[-1]))
    matrix, direction, z = found
    if direction is None and sites.direction is not None:
        direction = torch.zeros_like(sites.direction)
    return (
        None if into is None else into.total(),
        matrix if needs[1] else None,
        direction if needs[2] else None,
        z if needs[3] else None,
    )


def _launch_backward(
    call: Call,
    gradient: Tensor,
    source: Tensor,
    into: Accumulator | None,
    index_sums: Tensor | None,
    extra_sums: Tensor | None,
) -> None:
    if into is None and index_sums is None and extra_sums is None:
        return  # the nearest cell does not depend on the geometry
    if index_sums is not None or call.how.reduce:
        source = channels_last(source, math.prod(gradient.shape[3:]) * call.how.corners)
    array, scale = (source, None) if into is None else (into.array.expand(source.shape), into.scale)
    arrays = strided(gradient), strided(source), strided(array), scale, index_sums, extra_sums
    launch("resample_backward", call, *arrays)


@torch.no_grad()
def sample_views(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """Sample images (B, V, C, h, w) at given pixels; the options' depth and direction have been seen to.

    Args:
        source: the images.
        pixels: (B, V, N, 2).
        front: (B, V, N) bool, where to sample.
        extra: (B, V, E, N), geometric channels to append, or None.
        options: of the call.

    Returns:
        (B, V, C + E, N), or (B, C'', N) where options.reduce is set, channels last in memory, and visibility (B, V, N).
    """
    (B, V, C), N = source.shape[:3], pixels.shape[2]
    extras = 0 if extra is None else extra.shape[2]
    channels = (C + extras) * max(1, len(options.reduce))
    out = empty_channels_last(B, 1 if options.reduce else V, channels, 1, 1, N, like=source)
    visible = _forward(source.unsqueeze(3), out, options, extras, points=_points(pixels, front, extra))
    return _joined(out[:, :, :, 0, 0], options), visible[:, :, 0, 0]


def _points(pixels: Tensor, front: Tensor, extra: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    return (
        pixels.float().contiguous(),
        front.contiguous().view(torch.uint8),
        None if extra is None else extra.float().contiguous(),
    )


@torch.no_grad()
def sample_views_backward(
    gradient: Tensor,
    source: Tensor,
    pixels: Tensor,
    front: Tensor,
    extra: Tensor | None,
    options: Options,
    needs: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """The vector-Jacobian product of `sample_views`: gradients to source, pixels and extra, in their dtypes.

    Args:
        gradient: of its values, any strides.
        source: as given to it.
        pixels: as given to it.
        front: as given to it.
        extra: as given to it.
        options: as given to it.
        needs: which gradients are needed; the others are None.
    """
    (B, V), N = source.shape[:2], pixels.shape[2]
    extras = 0 if extra is None else extra.shape[2]
    target, maps = _split(gradient, options)[:, :, :, None, None], source.unsqueeze(3)
    points = _points(pixels, front, extra)
    call = plan(maps, target, options, extras, points=points, needs=(needs[0], any(needs[1:])))
    into = accumulator(target, maps, options, N, False) if needs[0] else None
    index_sums = extra_sums = None
    if any(needs[1:]) and options.mode != "nearest":
        index_sums = source.new_empty((B, V, N, call.sizes.tiles, 2), dtype=torch.float32)
    if any(needs[1:]) and extras:
        extra_sums = source.new_empty((B, V, extras, N), dtype=torch.float32)
    _launch_backward(call, target, maps, into, index_sums, extra_sums)
    grad_pixels = grad_extra = None
    if needs[1]:
        grad_pixels = torch.zeros_like(pixels) if index_sums is None else index_sums.sum(3).to(pixels.dtype)
    if needs[2] and extra is not None:
        grad_extra = torch.zeros_like(extra) if extra_sums is None else extra_sums.to(extra.dtype)
    return None if into is None else saturating_cast(into.total().squeeze(3), source.dtype), grad_pixels, grad_extra


@torch.no_grad()
def plane_sweep_project(
    source: Tensor, sites: Sites, options: Options, out: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """As `reference.plane_sweep_project`: volumes (B, C, D, H, W) at the sites of the views' frustums.

    Args:
        source: the volumes.
        sites: the frustums, P planes.
        options: of the call; where `stacked`, memory is [B][V][h][w][C'][P], else [B][V][P][h][w][C'].
        out: where to write the maps, any strides, or None.

    Returns:
        Maps (B, V, C', P, h, w) and visibility (B, V, P, h, w).
    """
    (B, C), V = source.shape[:2], sites.matrix.shape[1]
    channels, (P, h, w) = C + _extras(options), (sites.z.shape[-1], len(sites.y), len(sites.x))
    if out is None and options.flatten:
        out = source.new_empty((B, V, h, w, channels, P)).permute(0, 1, 4, 5, 2, 3)
    elif out is None:
        out = empty_channels_last(B, V, channels, P, h, w, like=source)
    views = _seen_by(source, V)
    return out, _forward(views, out, options, _extras(options), sites, volume=True)


def _seen_by(source: Tensor, V: int) -> Tensor:
    """(B, C, D, H, W) -> (B, V, C, D, H, W)."""
    return source[:, None].expand(source.shape[0], V, *source.shape[1:])


@torch.no_grad()
def plane_sweep_project_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: tuple[bool, bool, bool, bool],
    into: Tensor | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """The vector-Jacobian product of `plane_sweep_project`, as `unproject_backward`.

    Args:
        gradient: of its maps, any strides.
        source: as given to it.
        sites: as given to it.
        options: as given to it.
        needs: which gradients are needed.
        into: float32, of the source's shape: the source's gradient is added to it, and it is returned.
    """
    views = _seen_by(source, sites.matrix.shape[1])
    given = None if into is None else into[:, None]
    total, matrix, direction, z = _lattice_backward(gradient, views, sites, options, needs, True, given)
    if total is None:
        found = None
    elif into is None:
        found = saturating_cast(total[:, 0], source.dtype)
    else:
        found = into if total is given else into.add_(total[:, 0])
    return found, matrix, direction, z
