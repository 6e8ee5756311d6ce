"""The Triton kernels: calls on tensors without derivatives. Triton is imported at the first call.

Everything of the size of the sites is computed in one launch.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lsmgeo._dtypes import saturating_cast
from lsmgeo._torch_compat import as_constant
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.triton.launch_tables import lattice_gradients, site_gradients, tables
from lsmgeo.kernels.triton.launcher import (
    Accumulator,
    Call,
    accumulator,
    allocate_sums,
    channels_last,
    empty_channels_last,
    into_of,
    launch,
    plan,
    strided,
    sums_of,
)


def why_not(operator: str, source: Tensor, options: Options) -> str | None:
    """Why the Triton kernels cannot run a call, or None."""
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


def _without_views(values: Tensor, options: Options) -> Tensor:
    """(B, 1, C'', ...) -> (B, C'', ...) where views are reduced."""
    return values[:, 0] if options.reduce else values


def _with_views(gradient: Tensor, options: Options) -> Tensor:
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
    source = channels_last(source, math.prod(out.shape[3:]) * call.config.corners)
    launch("resample", call, strided(out), visible, strided(source))
    return visible.view(torch.bool)


@torch.no_grad()
def unproject(source: Tensor, sites: Sites, reference: Tensor | None, options: Options) -> tuple[Tensor, Tensor]:
    """As `reference.unproject`; values are channels last in memory."""
    B, V, C = source.shape[:3]
    channels = ((C if reference is None else options.groups) + options.appended()) * max(1, len(options.reduce))
    shape = B, 1 if options.reduce else V, channels, *sites.counts()
    out = source.new_empty(shape) if options.contiguous else empty_channels_last(*shape, like=source)
    other = None if reference is None else reference[:, None]
    visible = _forward(source.unsqueeze(3), out, options, options.appended(), sites, reference=other)
    return _without_views(out, options), visible


@torch.no_grad()
def unproject_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    reference: Tensor | None,
    options: Options,
    needs: tuple[bool, bool, bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Vector-Jacobian product of `unproject` to source, matrix, direction, z and reference, None where not in `needs`.

    The gradient may have any strides. Those to source and reference have their dtype; those to matrices (B, V, 3, 4)
    and z (B, V, D) are float64; that to the depths of each site is float32, of their shape.
    """
    other = None if reference is None else reference[:, None]
    found = _lattice_backward(
        _with_views(gradient, options), source.unsqueeze(3), sites, options, needs, False, reference=other
    )
    to_source = None if found[0] is None else saturating_cast(found[0].squeeze(3), source.dtype)
    to_reference = None if found[4] is None else saturating_cast(found[4][:, 0], source.dtype)
    return to_source, *found[1:4], to_reference


def _lattice_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: Sequence[bool],
    volume: bool,
    given: Tensor | None = None,
    reference: Tensor | None = None,
    averages: bool = True,
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Gradients to a (B, V or 1, C, d, h, w) source, in float32, to the geometry, and to the reference, in float32.

    The reference is (B, V or 1, C, D or 1, H, W).
    """
    wanted, of_reference = (needs[0], any(needs[1:4])), needs[4]
    planes, *pixels = gradient.shape[3:]
    count = planes * math.prod(pixels) * (source.shape[1] if volume else 1)
    into = accumulator(gradient, source, options, count, volume, given, reference) if needs[0] else None
    other = None
    if reference is not None and of_reference:
        adds = (source.shape[1] if reference.shape[1] == 1 else 1) * (planes if reference.shape[3] == 1 else 1)
        other = accumulator(gradient, reference, options, adds, False, factor=source)
    if count:
        known = tables(sites, options, volume)
        call = plan(
            source,
            gradient,
            options,
            options.appended(),
            known,
            volume=volume,
            needs=wanted,
            reference=reference,
            needs_reference=of_reference,
            averages=averages,
        )
        sums = allocate_sums(call, options, wanted[1], source)
        _launch_backward(call, gradient, source, into, sums, other)
        found: tuple[Tensor | None, ...] = (None,) * 3
        if wanted[1] and sites.per_site():
            found = site_gradients(known, options, *sums)
        elif wanted[1]:
            found = lattice_gradients(known, options, *sums[:2])
    else:
        shape = sites.z.shape if sites.per_site() else (*sites.matrix.shape[:2], sites.z.shape[-1])
        found = torch.zeros_like(sites.matrix), None, sites.matrix.new_zeros(shape)
    matrix, direction, z = found
    if z is not None and sites.per_site():
        z = (z.sum(1, keepdim=True) if sites.z.shape[1] < z.shape[1] else z).float()
    if direction is None and sites.direction is not None:
        direction = torch.zeros_like(sites.direction)
    return (
        None if into is None else into.total(),
        matrix if needs[1] else None,
        direction if needs[2] else None,
        z if needs[3] else None,
        None if other is None else other.total(),
    )


def _launch_backward(
    call: Call,
    gradient: Tensor,
    source: Tensor,
    into: Accumulator | None,
    sums: tuple[Tensor | None, Tensor | None, Tensor | None],
    other: Accumulator | None = None,
) -> None:
    if into is None and other is None and sums[0] is None and sums[1] is None:
        return  # the nearest cell does not depend on the geometry
    if sums[0] is not None or call.config.reduce or call.config.correlates:
        source = channels_last(source, math.prod(gradient.shape[3:]) * call.config.corners)
    array, scale = (source, None) if into is None else (into.array.expand(source.shape), into.scale)
    launch("resample_backward", call, strided(gradient), strided(source), into_of(array, scale, other), sums_of(*sums))


@torch.no_grad()
def sample_views(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """As `reference.sample_pixels`; values are channels last in memory."""
    (B, V, C), N = source.shape[:3], pixels.shape[2]
    extras = 0 if extra is None else extra.shape[2]
    channels = (C + extras) * max(1, len(options.reduce))
    out = empty_channels_last(B, 1 if options.reduce else V, channels, 1, 1, N, like=source)
    visible = _forward(source.unsqueeze(3), out, options, extras, points=_points(pixels, front, extra))
    return _without_views(out[:, :, :, 0, 0], options), visible[:, :, 0, 0]


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
    """Vector-Jacobian product of `sample_views` to source, pixels and extra, in their dtypes, None where not needed."""
    (B, V), N = source.shape[:2], pixels.shape[2]
    extras = 0 if extra is None else extra.shape[2]
    target, maps = _with_views(gradient, options)[:, :, :, None, None], source.unsqueeze(3)
    points = _points(pixels, front, extra)
    call = plan(maps, target, options, extras, points=points, needs=(needs[0], any(needs[1:])))
    into = accumulator(target, maps, options, N, False) if needs[0] else None
    index_sums = extra_sums = None
    if any(needs[1:]) and options.mode != "nearest":
        index_sums = source.new_empty((B, V, N, call.sizes.tiles, 2), dtype=torch.float32)
    if any(needs[1:]) and extras:
        extra_sums = source.new_empty((B, V, extras, N), dtype=torch.float32)
    _launch_backward(call, target, maps, into, (index_sums, extra_sums, None))
    grad_pixels = grad_extra = None
    if needs[1]:
        grad_pixels = torch.zeros_like(pixels) if index_sums is None else index_sums.sum(3).to(pixels.dtype)
    if needs[2] and extra is not None:
        grad_extra = torch.zeros_like(extra) if extra_sums is None else extra_sums.to(extra.dtype)
    return None if into is None else saturating_cast(into.total().squeeze(3), source.dtype), grad_pixels, grad_extra


@torch.no_grad()
def plane_sweep_project(
    source: Tensor, sites: Sites, options: Options, out: Tensor | None = None, factor: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """As `reference.plane_sweep_project`; `out` is memory of the maps' shape, any strides, to write to.

    Otherwise memory is [B][V][h][w][C'][P] with `options.flatten`, else [B][V][P][h][w][C'].
    With a `factor` (B, V, C, 1, h, w) the one channel is the sum of its products with the samples.
    """
    B, V, C = source.shape[0], sites.matrix.shape[1], source.shape[1] if factor is None else 1
    channels, (P, h, w) = C + options.appended(), sites.counts()
    if out is None and options.contiguous:
        out = source.new_empty(B, V, channels, P, h, w)
    elif out is None and options.flatten:
        out = source.new_empty((B, V, h, w, channels, P)).permute(0, 1, 4, 5, 2, 3)
    elif out is None:
        out = empty_channels_last(B, V, channels, P, h, w, like=source)
    views = _per_view(source, V)
    planned = {"volume": True, "reference": factor, "averages": False}
    return out, _forward(views, out, options, options.appended(), sites, **planned)


def _per_view(source: Tensor, V: int) -> Tensor:
    """(B, C, D, H, W) -> (B, V, C, D, H, W)."""
    return source[:, None].expand(source.shape[0], V, *source.shape[1:])


@torch.no_grad()
def plane_sweep_project_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: Sequence[bool],
    into: Tensor | None = None,
    factor: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Vector-Jacobian product of `plane_sweep_project` to source, matrix, direction, z, and factor if in `needs`.

    `into` is float32 memory of the source's shape: the source's gradient is added to it, and it is returned.
    """
    views = _per_view(source, sites.matrix.shape[1])
    given = None if into is None else into[:, None]
    every = (*needs, False)[:5]
    total, *others = _lattice_backward(gradient, views, sites, options, every, True, given, factor, False)
    if total is None:
        found = None
    elif into is None:
        found = saturating_cast(total[:, 0], source.dtype)
    else:
        found = into if total is given else into.add_(total[:, 0])
    if len(needs) == 5 and others[3] is not None:
        others[3] = saturating_cast(others[3], factor.dtype)  # type: ignore[union-attr]
    return (found, *others)[: len(needs)]
