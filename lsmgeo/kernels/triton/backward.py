"""The Triton kernel of the vector-Jacobian product of `forward.resample`. Importing this module imports Triton."""

# mypy: disallow-untyped-defs=False, disallow-incomplete-defs=False, disallow-untyped-decorators=False

from __future__ import annotations

import triton
import triton.language as tl

from lsmgeo.kernels.triton.forward import (
    _addresses,
    _cell,
    _channels,
    _chunk,
    _clamped_plane_row,
    _coordinates,
    _direction,
    _extra_offsets,
    _inverse_count,
    _is_unmasked,
    _moments,
    _project,
    _reference,
    _sampled,
    _site,
    _tap,
    _values,
    _variance,
    _view_start,
)
from lsmgeo.kernels.triton.types import (
    DEPTH_SUMS,
    DIRECTION_FIELDS,
    EXTRAS,
    FEATURES,
    FIELDS,
    IMAGES,
    LARGEST,
    LARGEST_DEVIATION,
    OUTSIDE,
    PIXELS,
    ROW,
    ROW_PER_SITE,
    UNIT,
    VOLUME,
)

__all__ = ["resample_backward"]


@triton.jit
def _load_gradient(gradient, start, BLOCK: tl.constexpr, PART: tl.constexpr, site, n, CONFIG: tl.constexpr):
    _, exists, channel = _channels(PART, site, n, CONFIG)
    channel += BLOCK * (n.features + CONFIG.extras)
    mask = site.keep[:, None] & exists[None, :]
    return tl.load(_addresses(gradient, start, site.k, site.j, site.i, channel), mask=mask, other=0.0).to(tl.float32)


@triton.jit
def _sum_row(sums, gradient, w, z, k, site, n, CONFIG: tl.constexpr):
    """Write the sums of a row's gradient times x, y and 1, plane by plane; with depths of sites w x, w y, w and z."""
    flat = gradient * w if CONFIG.per_site else gradient
    _sum(sums, flat * site.x, k, n, CONFIG)
    _sum(sums + 1, flat * site.y, k, n, CONFIG)
    _sum(sums + 2, flat, k, n, CONFIG)
    if CONFIG.per_site:
        _sum(sums + 3, gradient * z, k, n, CONFIG)


@triton.jit
def _sum_rows(sums, x_gradient, y_gradient, z_gradient, w, z, k, site, n, CONFIG: tl.constexpr):
    """`_sum_row` for three rows."""
    STEP: tl.constexpr = ROW_PER_SITE if CONFIG.per_site else ROW
    _sum_row(sums, x_gradient, w, z, k, site, n, CONFIG)
    _sum_row(sums + STEP, y_gradient, w, z, k, site, n, CONFIG)
    _sum_row(sums + 2 * STEP, z_gradient, w, z, k, site, n, CONFIG)


@triton.jit
def _store_depth_gradient(depth_sums, values, number, view, site, n, CONFIG: tl.constexpr):
    """Write the gradients to the depths of the sites: those of tile `number` of the features, or of other channels."""
    parts = n.tiles + (1 if CONFIG.extras > 0 else 0)
    entry = ((view * parts + number) * n.planes + site.k) * (n.height * n.width) + site.pixel
    tl.store(depth_sums + entry, values, mask=site.keep)


@triton.jit
def _along_z(table, x_gradient, y_gradient, z_gradient):
    """The gradient to the z of q from those to three rows of ``M q``."""
    return x_gradient * tl.load(table + 2) + y_gradient * tl.load(table + 6) + z_gradient * tl.load(table + 10)


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
def _tap_gradients(grad, source, into, scale, view, projection, channel, exists, n, CONFIG: tl.constexpr):
    """From the gradient to the sampled channels (sites, channels) to those to the source and to the index."""
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
            product = tl.sum(tl.where(mask, grad, 0.0) * value, 1)  # a NaN counts only where something is read
            grad_x += product * weight_y * weight_z * (1.0 if corner % 2 else -1.0)
            grad_y += product * weight_x * weight_z * (1.0 if corner // 2 % 2 else -1.0)
            grad_z += product * weight_x * weight_y * (1.0 if corner // 4 else -1.0)
    return grad_x * cell.slope_x, grad_y * cell.slope_y, grad_z * cell.slope_z


@triton.jit
def _correlation_gradients(grad, source, into, lattice, view, projection, site, n, CONFIG: tl.constexpr):
    """From the gradient to the correlations (sites, groups) to those to source, reference and index."""
    column, size = tl.arange(0, CONFIG.columns)[None, :], tl.maximum(n.channels // n.features, 1)
    grad_x = tl.zeros([CONFIG.sites], tl.float32)
    grad_y = grad_x
    grad_z = grad_x
    for number in range(n.chunks):
        channel, exists = _chunk(number, n, CONFIG)
        each = tl.zeros([CONFIG.sites, CONFIG.channels], tl.float32)
        for group in range(n.features):
            part = tl.sum(tl.where(column == group, grad, 0.0), 1)
            part = part / size if CONFIG.averages else part
            each += tl.where((channel // size == group)[None, :], part[:, None], 0.0)
        if CONFIG.needs_reference:
            array = into.reference
            addresses = _addresses(array, _view_start(array, view, n), site.k, site.j, site.i, channel)
            sampled = _sampled(source, view, projection, channel, exists, n, CONFIG)
            mask = projection.front[:, None] & exists[None, :]
            _scatter(array, into.reference_scale, addresses, each * sampled, mask)
        each = each * _reference(lattice, view, projection, site, channel, exists, n)
        x, y, z = _tap_gradients(
            each, source, into.source, into.source_scale, view, projection, channel, exists, n, CONFIG
        )
        grad_x += x
        grad_y += y
        grad_z += z
    return grad_x, grad_y, grad_z


@triton.jit
def _feature_gradients(grad, source, into, lattice, sums, view, projection, site, n, CONFIG: tl.constexpr):
    """From a view's gradient (sites, channels) to those to the source, to the reference and to the geometry."""
    if CONFIG.correlates:
        grad_x, grad_y, grad_z = _correlation_gradients(grad, source, into, lattice, view, projection, site, n, CONFIG)
    else:
        channel, exists, _ = _channels(FEATURES, site, n, CONFIG)
        grad_x, grad_y, grad_z = _tap_gradients(
            grad, source, into.source, into.source_scale, view, projection, channel, exists, n, CONFIG
        )
    if CONFIG.needs_geometry and not CONFIG.nearest:
        if CONFIG.kind == PIXELS:
            entry = ((view * n.width + site.pixel) * n.tiles + site.tile) * 2
            tl.store(sums.index + entry, grad_x, mask=site.keep)
            tl.store(sums.index + entry + 1, grad_y, mask=site.keep)
        else:
            if CONFIG.kind == IMAGES:
                # Where the index is out of range the gradient is 0, but 0 times infinity is not.
                x = tl.minimum(tl.maximum(projection.x, OUTSIDE), n.cells_x + 1.0)
                y = tl.minimum(tl.maximum(projection.y, OUTSIDE), n.cells_y + 1.0)
                grad_z = -(grad_x * x + grad_y * y) * projection.inverse
                grad_x, grad_y = grad_x * projection.inverse, grad_y * projection.inverse
            w, along, depth = _coordinates(lattice, view, site, n, CONFIG)
            if CONFIG.per_site:
                table = lattice.views + view * FIELDS
                if CONFIG.kind == IMAGES:
                    # A multiple of q is the same site: as if only z = 1 / depth followed from the depth.
                    to_depth = -_along_z(table, grad_x, grad_y, grad_z) * tl.div_rn(along, depth)
                else:
                    to_depth = grad_x * _clamped_plane_row(table, site) + grad_y * _clamped_plane_row(table + 4, site)
                    to_depth += grad_z * _clamped_plane_row(table + 8, site)
                    w, along = depth, tl.zeros_like(depth) + 1.0
                _store_depth_gradient(sums.depths, to_depth, site.tile, view, site, n, CONFIG)
            STEP: tl.constexpr = ROW_PER_SITE if CONFIG.per_site else ROW
            k = site.slab * CONFIG.planes + tl.arange(0, CONFIG.planes)
            entry = ((view * n.planes + k) * n.blocks + site.block) * n.tiles + site.tile
            _sum_rows(sums.index + entry * 3 * STEP, grad_x, grad_y, grad_z, w, along, k, site, n, CONFIG)


@triton.jit
def _extra_gradients(grad, lattice, points, sums, view, projection, site, n, CONFIG: tl.constexpr):
    """From a view's gradient (sites, geometric channels) to those of the matrices and depths."""
    LIMIT: tl.constexpr = LARGEST if CONFIG.reduce else CONFIG.largest  # no gradient where the channel saturates
    column = tl.arange(0, CONFIG.width)[None, :]
    if CONFIG.kind == PIXELS:
        mask = site.keep[:, None] & (column < CONFIG.extras)
        offset = _extra_offsets(points, view, site, n, CONFIG)
        values = tl.load(points.extra + offset, mask=mask, other=0.0)
        tl.store(sums.extra + offset, tl.where(tl.abs(values) <= LIMIT, grad, 0.0), mask=mask)
    else:
        k = site.slab * CONFIG.planes + tl.arange(0, CONFIG.planes)
        STEP: tl.constexpr = ROW_PER_SITE if CONFIG.per_site else ROW
        table = lattice.views + view * FIELDS
        extra = sums.extra + ((view * n.planes + k) * n.blocks + site.block) * (DEPTH_SUMS + 3 * STEP)
        w, z, own = _coordinates(lattice, view, site, n, CONFIG)
        to_depth = tl.zeros([CONFIG.sites], tl.float32)
        if CONFIG.depth:
            grad_depth = tl.sum(tl.where(column == 0, grad, 0.0), 1)
            has_gradient = (tl.abs(projection.distance) <= LIMIT) & _is_unmasked(table, site)
            grad_depth = tl.where(has_gradient, grad_depth, 0.0)
            if CONFIG.kind == VOLUME:
                to_depth = grad_depth
                if not CONFIG.per_site:
                    _sum(extra + 3, grad_depth, k, n, CONFIG)
            else:
                unit = tl.load(table + UNIT) * (z if CONFIG.projective else 1.0)
                row = tl.div_rn(grad_depth, unit + tl.zeros_like(grad_depth))
                through = tl.where(grad_depth != 0.0, grad_depth * projection.distance, 0.0)
                _sum_row(extra, row, w, z, k, site, n, CONFIG)
                if CONFIG.per_site:
                    to_depth = tl.div_rn(through - row * tl.load(table + 10) * z, own)
                else:
                    _sum(extra + 3, through, k, n, CONFIG)
        if CONFIG.direction:
            unit_x, unit_y, unit_z, inverse = _direction(lattice, view, site, n, CONFIG)
            grad_x = tl.sum(tl.where(column == CONFIG.depth, grad, 0.0), 1)
            grad_y = tl.sum(tl.where(column == CONFIG.depth + 1, grad, 0.0), 1)
            grad_z = tl.sum(tl.where(column == CONFIG.depth + 2, grad, 0.0), 1)
            along = grad_x * unit_x + grad_y * unit_y + grad_z * unit_z
            grad_x = (grad_x - along * unit_x) * inverse
            grad_y = (grad_y - along * unit_y) * inverse
            grad_z = (grad_z - along * unit_z) * inverse
            _sum_rows(extra + DEPTH_SUMS, grad_x, grad_y, grad_z, w, z, k, site, n, CONFIG)
            if CONFIG.per_site:
                inner = _along_z(table + DIRECTION_FIELDS, grad_x, grad_y, grad_z)
                to_depth -= tl.div_rn(inner * z, own)
        if CONFIG.per_site:
            _store_depth_gradient(sums.depths, to_depth, n.tiles, view, site, n, CONFIG)


@triton.jit
def _view_gradients(
    PART: tl.constexpr,
    grad,
    source,
    into,
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
        _feature_gradients(grad, source, into, lattice, sums, view, projection, site, n, CONFIG)
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
            _view_gradients(PART, grad, source, into, sums, lattice, points, view, projection, site, n, CONFIG)
    else:
        view = site.owner
        projection = _project(lattice, points, view, site, n, near, CONFIG)
        grad = _load_gradient(gradient, _view_start(gradient, view, n), 0, PART, site, n, CONFIG)
        if PART == FEATURES and CONFIG.correlates and CONFIG.largest < LARGEST:
            values = _values(PART, source, lattice, points, view, projection, site, n, CONFIG)
            grad = _unsaturated(grad, values, CONFIG)
        _view_gradients(PART, grad, source, into, sums, lattice, points, view, projection, site, n, CONFIG)


@triton.jit
def resample_backward(gradient, source, into, sums, lattice, points, n, near, CONFIG: tl.constexpr):
    """The vector-Jacobian product of `resample`; everything else is recomputed from its inputs.

    Args:
        gradient: `Strided`, as `resample`'s out.
        source: `Strided`, as `resample`'s.
        into: `Into`, what the gradients to source and reference are added to.
        sums: `Sums`.
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
    _backward(FEATURES, share, gradient, source, into, sums, lattice, points, site, n, near, CONFIG)
    if CONFIG.extras > 0 and CONFIG.needs_geometry:
        if site.tile == 0:
            _backward(EXTRAS, share, gradient, source, into, sums, lattice, points, site, n, near, CONFIG)
