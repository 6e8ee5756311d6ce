"""The Triton kernel that takes the gradients of `forward.resample` back. Importing this module imports Triton."""

# mypy: disallow-untyped-defs=False, disallow-incomplete-defs=False, disallow-untyped-decorators=False

from __future__ import annotations

import triton
import triton.language as tl

from lsmgeo.kernels.triton.forward import (
    _addresses,
    _cell,
    _channels,
    _direction,
    _given,
    _kept,
    _locate,
    _moments,
    _share,
    _site,
    _tap,
    _values,
    _variance,
    _view_start,
)
from lsmgeo.kernels.triton.types import (
    EXTRA_SUMS,
    EXTRAS,
    FEATURES,
    FIELDS,
    IMAGES,
    INDEX_SUMS,
    LARGEST,
    LARGEST_DEVIATION,
    OUTSIDE,
    PIXELS,
    UNIT,
    VOLUME,
)

__all__ = ["resample_backward"]


@triton.jit
def _load_gradient(gradient, start, place: tl.constexpr, PART: tl.constexpr, site, n, HOW: tl.constexpr):
    _, exists, channel = _channels(PART, site, n, HOW)
    channel += place * (n.channels + HOW.extras)
    mask = site.keep[:, None] & exists[None, :]
    return tl.load(_addresses(gradient, start, site.k, site.j, site.i, channel), mask=mask, other=0.0).to(tl.float32)


@triton.jit
def _sum_rows(sums, x_gradient, y_gradient, z_gradient, k, site, n, HOW: tl.constexpr):
    """Write the sums of a row's gradient times x, y and 1 for three rows, plane by plane."""
    _sum(sums, x_gradient * site.x, k, n, HOW)
    _sum(sums + 1, x_gradient * site.y, k, n, HOW)
    _sum(sums + 2, x_gradient, k, n, HOW)
    _sum(sums + 3, y_gradient * site.x, k, n, HOW)
    _sum(sums + 4, y_gradient * site.y, k, n, HOW)
    _sum(sums + 5, y_gradient, k, n, HOW)
    _sum(sums + 6, z_gradient * site.x, k, n, HOW)
    _sum(sums + 7, z_gradient * site.y, k, n, HOW)
    _sum(sums + 8, z_gradient, k, n, HOW)


@triton.jit
def _sum(sums, values, k, n, HOW: tl.constexpr):
    total = tl.sum(tl.reshape(values, (HOW.sites // HOW.planes, HOW.planes)), 0)
    tl.store(sums, total, mask=k < n.planes)


@triton.jit
def _scatter(into, scale, addresses, values, mask):
    if into.pointer.dtype.element_ty == tl.int64:
        # Sums of integers do not depend on their order.
        tl.atomic_add(addresses, (values * tl.load(scale)).to(tl.int64), mask=mask, sem="relaxed")
    else:
        tl.atomic_add(addresses, values, mask=mask, sem="relaxed")


@triton.jit
def _pull_back_features(g, source, into, scale, sums, view, place, site, n, HOW: tl.constexpr):
    """From a view's gradient (sites, channels) to those of the source and of the index."""
    channel, exists, _ = _channels(FEATURES, site, n, HOW)
    cell = _cell(place, n, HOW)
    gx = tl.zeros([HOW.sites], tl.float32)
    gy = gx
    gz = gx
    for corner in tl.static_range(HOW.corners):
        x, y, z, weight_x, weight_y, weight_z, there = _tap(cell, n, corner, HOW)
        mask = (place.front & there)[:, None] & exists[None, :]
        if HOW.needs_source:
            addresses = _addresses(into, _view_start(into, view, n), z, y, x, channel)
            _scatter(into, scale, addresses, g * (weight_x * weight_y * weight_z)[:, None], mask)
        if HOW.needs_geometry and not HOW.nearest:
            addresses = _addresses(source, _view_start(source, view, n), z, y, x, channel)
            value = tl.load(addresses, mask=mask, other=0.0).to(tl.float32)
            product = tl.sum(g * value, 1)
            gx += product * weight_y * weight_z * (1.0 if corner % 2 else -1.0)
            gy += product * weight_x * weight_z * (1.0 if corner // 2 % 2 else -1.0)
            gz += product * weight_x * weight_y * (1.0 if corner // 4 else -1.0)
    if HOW.needs_geometry and not HOW.nearest:
        gx, gy, gz = gx * cell.slope_x, gy * cell.slope_y, gz * cell.slope_z
        if HOW.kind == PIXELS:
            entry = ((view * n.width + site.pixel) * n.tiles + site.tile) * 2
            tl.store(sums + entry, gx, mask=site.keep)
            tl.store(sums + entry + 1, gy, mask=site.keep)
        else:
            if HOW.kind == IMAGES:
                # Where the index is out of range the gradient is 0, but 0 times infinity is not.
                x = tl.minimum(tl.maximum(place.x, OUTSIDE), n.cells_x + 1.0)
                y = tl.minimum(tl.maximum(place.y, OUTSIDE), n.cells_y + 1.0)
                gz = -(gx * x + gy * y) * place.inverse
                gx, gy = gx * place.inverse, gy * place.inverse
            k = site.slab * HOW.planes + tl.arange(0, HOW.planes)
            entry = ((view * n.planes + k) * n.blocks + site.block) * n.tiles + site.tile
            _sum_rows(sums + entry * INDEX_SUMS, gx, gy, gz, k, site, n, HOW)


@triton.jit
def _pull_back_extras(g, lattice, points, sums, view, place, site, n, HOW: tl.constexpr):
    """From a view's gradient (sites, geometric channels) to those of the matrices and depths."""
    LIMIT: tl.constexpr = LARGEST if HOW.reduce else HOW.largest  # no gradient where the channel saturates
    column = tl.arange(0, HOW.width)[None, :]
    if HOW.kind == PIXELS:
        mask = site.keep[:, None] & (column < HOW.extras)
        offset = _given(points, view, site, n, HOW)
        values = tl.load(points.extra + offset, mask=mask, other=0.0)
        tl.store(sums + offset, tl.where(tl.abs(values) <= LIMIT, g, 0.0), mask=mask)
    else:
        k = site.slab * HOW.planes + tl.arange(0, HOW.planes)
        sums += ((view * n.planes + k) * n.blocks + site.block) * EXTRA_SUMS
        if HOW.depth:
            gd = tl.sum(tl.where(column == 0, g, 0.0), 1)
            held = (tl.abs(place.distance) <= LIMIT) & _kept(lattice.views + view * FIELDS, site)
            gd = tl.where(held, gd, 0.0)
            if HOW.kind == VOLUME:
                _sum(sums + 3, gd, k, n, HOW)
            else:
                along = tl.load(lattice.z + view * n.planes + site.k, mask=site.keep, other=1.0)
                unit = tl.load(lattice.views + view * FIELDS + UNIT) * (along if HOW.projective else 1.0)
                row = tl.div_rn(gd, unit + tl.zeros_like(gd))
                _sum(sums, row * site.x, k, n, HOW)
                _sum(sums + 1, row * site.y, k, n, HOW)
                _sum(sums + 2, row, k, n, HOW)
                _sum(sums + 3, tl.where(gd != 0.0, gd * place.distance, 0.0), k, n, HOW)
        if HOW.direction:
            x, y, z, inverse = _direction(lattice, view, site, n, HOW)
            gx = tl.sum(tl.where(column == HOW.depth, g, 0.0), 1)
            gy = tl.sum(tl.where(column == HOW.depth + 1, g, 0.0), 1)
            gz = tl.sum(tl.where(column == HOW.depth + 2, g, 0.0), 1)
            along = gx * x + gy * y + gz * z
            gx, gy, gz = (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse
            _sum_rows(sums + 4, gx, gy, gz, k, site, n, HOW)


@triton.jit
def _pull_back_view(
    PART: tl.constexpr, g, source, into, scale, sums, lattice, points, view, place, site, n, HOW: tl.constexpr
):
    if PART == FEATURES:
        _pull_back_features(g, source, into, scale, sums, view, place, site, n, HOW)
    else:
        _pull_back_extras(g, lattice, points, sums, view, place, site, n, HOW)


@triton.jit
def _unsaturated(g, values, HOW: tl.constexpr):
    """Nothing comes back through what saturates in a smaller dtype."""
    return tl.where(tl.abs(values) <= HOW.largest, g, 0.0) if HOW.largest < LARGEST else g


@triton.jit
def _pull_back(
    PART: tl.constexpr,
    share,
    gradient,
    source,
    into,
    scale,
    sums,
    lattice,
    points,
    site,
    n,
    near,
    HOW: tl.constexpr,
):
    if HOW.reduce:
        start = site.owner * gradient.b
        mean, best, first, top = _moments(PART, share, source, lattice, points, site, n, near, HOW)
        of_mean, of_square, of_best = tl.zeros_like(mean), tl.zeros_like(mean), tl.zeros_like(mean)
        if HOW.mean >= 0:
            of_mean = _load_gradient(gradient, start, HOW.mean, PART, site, n, HOW) * share[:, None]
            of_mean = _unsaturated(of_mean, mean, HOW)
        if HOW.maximum >= 0:
            of_best = _load_gradient(gradient, start, HOW.maximum, PART, site, n, HOW)
            of_best = _unsaturated(of_best, best, HOW)
        if HOW.variance >= 0:
            of_square = _load_gradient(gradient, start, HOW.variance, PART, site, n, HOW) * share[:, None]
            if top > HOW.largest**0.5 / 2.0:  # deviations may be held or the variance saturate: look again
                variance, drift = _variance(PART, mean, share, source, lattice, points, site, n, near, HOW)
                of_square = tl.where(variance <= HOW.largest, of_square, 0.0)
                of_mean -= 2.0 * of_square * drift
        for v in range(n.views):
            view = site.owner * n.views + v
            place = _locate(lattice, points, view, site, n, near, HOW)
            g = of_mean + tl.where(first == v, of_best, 0.0)
            if HOW.variance >= 0:
                deviation = _values(PART, source, lattice, points, view, place, site, n, HOW) - mean
                g += tl.where(tl.abs(deviation) <= LARGEST_DEVIATION, 2.0 * deviation * of_square, 0.0)
            g = tl.where(place.visible[:, None], g, 0.0)
            _pull_back_view(PART, g, source, into, scale, sums, lattice, points, view, place, site, n, HOW)
    else:
        view = site.owner
        place = _locate(lattice, points, view, site, n, near, HOW)
        g = _load_gradient(gradient, _view_start(gradient, view, n), 0, PART, site, n, HOW)
        _pull_back_view(PART, g, source, into, scale, sums, lattice, points, view, place, site, n, HOW)


@triton.jit
def resample_backward(
    gradient, source, into, scale, index_sums, extra_sums, lattice, points, n, near, HOW: tl.constexpr
):
    """The vector-Jacobian product of `resample`; everything but the gradient and its inputs is computed again.

    Args:
        gradient: `Strided`, as `resample`'s out.
        source: `Strided`, as `resample`'s.
        into: `Strided`, to whose elements the source's gradient is added: float32, or int64 in units of 1 / scale.
        scale: (1,) float32, or None for float32.
        index_sums: float32: (B V, D, blocks, tiles, INDEX_SUMS), or the pixels' gradients (B V, N, tiles, 2).
        extra_sums: float32: (B V, D, blocks, EXTRA_SUMS), or the given channels' gradients (B V, E, N).
        lattice: `Lattice`, or None's.
        points: `Points`, or None's.
        n: `Sizes`.
        near: least depth of a visible site.
        HOW: `How`.
    """
    site = _site(lattice, n, HOW)
    if HOW.reduce:
        share = _share(None, lattice, points, site, n, near, HOW)
    else:
        share = tl.zeros([HOW.sites], tl.float32)
    _pull_back(FEATURES, share, gradient, source, into, scale, index_sums, lattice, points, site, n, near, HOW)
    if HOW.extras > 0 and HOW.needs_geometry:
        if site.tile == 0:
            _pull_back(EXTRAS, share, gradient, source, into, scale, extra_sums, lattice, points, site, n, near, HOW)
