"""The Triton kernel of the vector-Jacobian product of `forward.resample`. Importing this module imports Triton."""

# mypy: disallow-untyped-defs=False, disallow-incomplete-defs=False, disallow-untyped-decorators=False

from __future__ import annotations

import triton
import triton.language as tl

from lsmgeo.kernels.triton.forward import (
    _addresses,
    _cell,
    _channels,
    _direction,
    _extra_offsets,
    _inverse_count,
    _is_unmasked,
    _moments,
    _project,
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
def _load_gradient(gradient, start, BLOCK: tl.constexpr, PART: tl.constexpr, site, n, CONFIG: tl.constexpr):
    _, exists, channel = _channels(PART, site, n, CONFIG)
    channel += BLOCK * (n.channels + CONFIG.extras)
    mask = site.keep[:, None] & exists[None, :]
    return tl.load(_addresses(gradient, start, site.k, site.j, site.i, channel), mask=mask, other=0.0).to(tl.float32)


@triton.jit
def _sum_rows(sums, x_gradient, y_gradient, z_gradient, k, site, n, CONFIG: tl.constexpr):
    """Write the sums of a row's gradient times x, y and 1 for three rows, plane by plane."""
    _sum(sums, x_gradient * site.x, k, n, CONFIG)
    _sum(sums + 1, x_gradient * site.y, k, n, CONFIG)
    _sum(sums + 2, x_gradient, k, n, CONFIG)
    _sum(sums + 3, y_gradient * site.x, k, n, CONFIG)
    _sum(sums + 4, y_gradient * site.y, k, n, CONFIG)
    _sum(sums + 5, y_gradient, k, n, CONFIG)
    _sum(sums + 6, z_gradient * site.x, k, n, CONFIG)
    _sum(sums + 7, z_gradient * site.y, k, n, CONFIG)
    _sum(sums + 8, z_gradient, k, n, CONFIG)


@triton.jit
def _sum(sums, values, k, n, CONFIG: tl.constexpr):
    total = tl.sum(tl.reshape(values, (CONFIG.sites // CONFIG.planes, CONFIG.planes)), 0)
    tl.store(sums, total, mask=k < n.planes)


@triton.jit
def _scatter(into, scale, addresses, values, mask):
    if into.pointer.dtype.element_ty == tl.int64:
        # Sums of integers do not depend on their order.
        tl.atomic_add(addresses, (values * tl.load(scale)).to(tl.int64), mask=mask, sem="relaxed")
    else:
        tl.atomic_add(addresses, values, mask=mask, sem="relaxed")


@triton.jit
def _feature_gradients(grad, source, into, scale, sums, view, projection, site, n, CONFIG: tl.constexpr):
    """From a view's gradient (sites, channels) to those of the source and of the index."""
    channel, exists, _ = _channels(FEATURES, site, n, CONFIG)
    cell = _cell(projection, n, CONFIG)
    grad_x = tl.zeros([CONFIG.sites], tl.float32)
    grad_y = grad_x
    grad_z = grad_x
    for corner in tl.static_range(CONFIG.corners):
        x, y, z, weight_x, weight_y, weight_z, inside = _tap(cell, n, corner, CONFIG)
        mask = (projection.front & inside)[:, None] & exists[None, :]
        if CONFIG.needs_source:
            addresses = _addresses(into, _view_start(into, view, n), z, y, x, channel)
            _scatter(into, scale, addresses, grad * (weight_x * weight_y * weight_z)[:, None], mask)
        if CONFIG.needs_geometry and not CONFIG.nearest:
            addresses = _addresses(source, _view_start(source, view, n), z, y, x, channel)
            value = tl.load(addresses, mask=mask, other=0.0).to(tl.float32)
            product = tl.sum(grad * value, 1)
            grad_x += product * weight_y * weight_z * (1.0 if corner % 2 else -1.0)
            grad_y += product * weight_x * weight_z * (1.0 if corner // 2 % 2 else -1.0)
            grad_z += product * weight_x * weight_y * (1.0 if corner // 4 else -1.0)
    if CONFIG.needs_geometry and not CONFIG.nearest:
        grad_x, grad_y, grad_z = grad_x * cell.slope_x, grad_y * cell.slope_y, grad_z * cell.slope_z
        if CONFIG.kind == PIXELS:
            entry = ((view * n.width + site.pixel) * n.tiles + site.tile) * 2
            tl.store(sums + entry, grad_x, mask=site.keep)
            tl.store(sums + entry + 1, grad_y, mask=site.keep)
        else:
            if CONFIG.kind == IMAGES:
                # Where the index is out of range the gradient is 0, but 0 times infinity is not.
                x = tl.minimum(tl.maximum(projection.x, OUTSIDE), n.cells_x + 1.0)
                y = tl.minimum(tl.maximum(projection.y, OUTSIDE), n.cells_y + 1.0)
                grad_z = -(grad_x * x + grad_y * y) * projection.inverse
                grad_x, grad_y = grad_x * projection.inverse, grad_y * projection.inverse
            k = site.slab * CONFIG.planes + tl.arange(0, CONFIG.planes)
            entry = ((view * n.planes + k) * n.blocks + site.block) * n.tiles + site.tile
            _sum_rows(sums + entry * INDEX_SUMS, grad_x, grad_y, grad_z, k, site, n, CONFIG)


@triton.jit
def _extra_gradients(grad, lattice, points, sums, view, projection, site, n, CONFIG: tl.constexpr):
    """From a view's gradient (sites, geometric channels) to those of the matrices and depths."""
    LIMIT: tl.constexpr = LARGEST if CONFIG.reduce else CONFIG.largest  # no gradient where the channel saturates
    column = tl.arange(0, CONFIG.width)[None, :]
    if CONFIG.kind == PIXELS:
        mask = site.keep[:, None] & (column < CONFIG.extras)
        offset = _extra_offsets(points, view, site, n, CONFIG)
        values = tl.load(points.extra + offset, mask=mask, other=0.0)
        tl.store(sums + offset, tl.where(tl.abs(values) <= LIMIT, grad, 0.0), mask=mask)
    else:
        k = site.slab * CONFIG.planes + tl.arange(0, CONFIG.planes)
        sums += ((view * n.planes + k) * n.blocks + site.block) * EXTRA_SUMS
        if CONFIG.depth:
            grad_depth = tl.sum(tl.where(column == 0, grad, 0.0), 1)
            has_gradient = (tl.abs(projection.distance) <= LIMIT) & _is_unmasked(lattice.views + view * FIELDS, site)
            grad_depth = tl.where(has_gradient, grad_depth, 0.0)
            if CONFIG.kind == VOLUME:
                _sum(sums + 3, grad_depth, k, n, CONFIG)
            else:
                along = tl.load(lattice.z + view * n.planes + site.k, mask=site.keep, other=1.0)
                unit = tl.load(lattice.views + view * FIELDS + UNIT) * (along if CONFIG.projective else 1.0)
                row = tl.div_rn(grad_depth, unit + tl.zeros_like(grad_depth))
                _sum(sums, row * site.x, k, n, CONFIG)
                _sum(sums + 1, row * site.y, k, n, CONFIG)
                _sum(sums + 2, row, k, n, CONFIG)
                _sum(sums + 3, tl.where(grad_depth != 0.0, grad_depth * projection.distance, 0.0), k, n, CONFIG)
        if CONFIG.direction:
            x, y, z, inverse = _direction(lattice, view, site, n, CONFIG)
            grad_x = tl.sum(tl.where(column == CONFIG.depth, grad, 0.0), 1)
            grad_y = tl.sum(tl.where(column == CONFIG.depth + 1, grad, 0.0), 1)
            grad_z = tl.sum(tl.where(column == CONFIG.depth + 2, grad, 0.0), 1)
            along = grad_x * x + grad_y * y + grad_z * z
            grad_x = (grad_x - along * x) * inverse
            grad_y = (grad_y - along * y) * inverse
            grad_z = (grad_z - along * z) * inverse
            _sum_rows(sums + 4, grad_x, grad_y, grad_z, k, site, n, CONFIG)


@triton.jit
def _view_gradients(
    PART: tl.constexpr,
    grad,
    source,
    into,
    scale,
    sums,
    lattice,
    points,
    view,
    projection,
    site,
    n,
    CONFIG: tl.constexpr,
):
    if PART == FEATURES:
        _feature_gradients(grad, source, into, scale, sums, view, projection, site, n, CONFIG)
    else:
        _extra_gradients(grad, lattice, points, sums, view, projection, site, n, CONFIG)


@triton.jit
def _unsaturated(grad, values, CONFIG: tl.constexpr):
    """The gradient, 0 where the value saturates in a smaller dtype."""
    return tl.where(tl.abs(values) <= CONFIG.largest, grad, 0.0) if CONFIG.largest < LARGEST else grad


@triton.jit
def _backward(
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
    CONFIG: tl.constexpr,
):
    if CONFIG.reduce:
        start = site.owner * gradient.b
        mean, best, first, magnitude = _moments(PART, share, source, lattice, points, site, n, near, CONFIG)
        grad_mean, grad_square, grad_max = tl.zeros_like(mean), tl.zeros_like(mean), tl.zeros_like(mean)
        if CONFIG.mean >= 0:
            grad_mean = _load_gradient(gradient, start, CONFIG.mean, PART, site, n, CONFIG) * share[:, None]
            grad_mean = _unsaturated(grad_mean, mean, CONFIG)
        if CONFIG.maximum >= 0:
            grad_max = _load_gradient(gradient, start, CONFIG.maximum, PART, site, n, CONFIG)
            grad_max = _unsaturated(grad_max, best, CONFIG)
        if CONFIG.variance >= 0:
            grad_square = _load_gradient(gradient, start, CONFIG.variance, PART, site, n, CONFIG) * share[:, None]
            if magnitude > CONFIG.largest**0.5 / 2.0:  # deviations may be clamped, or the variance saturate
                variance, drift = _variance(PART, mean, share, source, lattice, points, site, n, near, CONFIG)
                grad_square = tl.where(variance <= CONFIG.largest, grad_square, 0.0)
                grad_mean -= 2.0 * grad_square * drift
        for v in range(n.views):
            view = site.owner * n.views + v
            projection = _project(lattice, points, view, site, n, near, CONFIG)
            grad = grad_mean + tl.where(first == v, grad_max, 0.0)
            if CONFIG.variance >= 0:
                deviation = _values(PART, source, lattice, points, view, projection, site, n, CONFIG) - mean
                grad += tl.where(tl.abs(deviation) <= LARGEST_DEVIATION, 2.0 * deviation * grad_square, 0.0)
            grad = tl.where(projection.visible[:, None], grad, 0.0)
            _view_gradients(PART, grad, source, into, scale, sums, lattice, points, view, projection, site, n, CONFIG)
    else:
        view = site.owner
        projection = _project(lattice, points, view, site, n, near, CONFIG)
        grad = _load_gradient(gradient, _view_start(gradient, view, n), 0, PART, site, n, CONFIG)
        _view_gradients(PART, grad, source, into, scale, sums, lattice, points, view, projection, site, n, CONFIG)


@triton.jit
def resample_backward(
    gradient, source, into, scale, index_sums, extra_sums, lattice, points, n, near, CONFIG: tl.constexpr
):
    """The vector-Jacobian product of `resample`; everything else is recomputed from its inputs.

    Args:
        gradient: `Strided`, as `resample`'s out.
        source: `Strided`, as `resample`'s.
        into: `Strided`, to whose elements the source's gradient is added: float32, or int64 in units of 1 / scale.
        scale: (1,) float32, or None for float32.
        index_sums: float32: (B V, D, blocks, tiles, INDEX_SUMS), or the pixels' gradients (B V, N, tiles, 2).
        extra_sums: float32: (B V, D, blocks, EXTRA_SUMS), or the given channels' gradients (B V, E, N).
        lattice: as `resample`'s.
        points: as `resample`'s.
        n: `Sizes`.
        near: least depth of a visible site.
        CONFIG: `Config`.
    """
    site = _site(lattice, n, CONFIG)
    if CONFIG.reduce:
        share = _inverse_count(None, lattice, points, site, n, near, CONFIG)
    else:
        share = tl.zeros([CONFIG.sites], tl.float32)
    _backward(FEATURES, share, gradient, source, into, scale, index_sums, lattice, points, site, n, near, CONFIG)
    if CONFIG.extras > 0 and CONFIG.needs_geometry:
        if site.tile == 0:
            _backward(EXTRAS, share, gradient, source, into, scale, extra_sums, lattice, points, site, n, near, CONFIG)
