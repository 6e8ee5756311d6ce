"""The Triton kernel that resamples; `backward` has its vector-Jacobian product, `operators` launches both.

Sites are those of a lattice in images, those of frustums in volumes, or given pixels. A program works on a tile: sites
by channels, of a view, or of all views for a statistic. `PART` says whether of features or of geometric channels.
"""

# mypy: disallow-untyped-defs=False, disallow-incomplete-defs=False, disallow-untyped-decorators=False

from __future__ import annotations

import triton
import triton.language as tl

from lsmgeo.kernels.triton.types import (
    DIRECTION_FIELDS,
    EXTRAS,
    FEATURES,
    FIELDS,
    FOUR_EPS,
    LARGEST,
    LARGEST_COORDINATE,
    LARGEST_DEVIATION,
    OUTSIDE,
    PIXELS,
    SMALLEST_DEPTH,
    TERMS,
    UNIT,
    UNMASKED,
    VOLUME,
    Cell,
    Projection,
    Site,
)

# Projection


@triton.jit
def _site(lattice, n, CONFIG: tl.constexpr):
    program = tl.program_id(0)
    tile = program % n.tiles
    rest = program // n.tiles
    block = rest % n.blocks
    rest = rest // n.blocks
    slab = rest % n.slabs
    owner = rest // n.slabs
    lane = tl.arange(0, CONFIG.sites)
    k = slab * CONFIG.planes + lane % CONFIG.planes
    pixel = block * (CONFIG.sites // CONFIG.planes) + lane // CONFIG.planes
    keep = (k < n.planes) & (pixel < n.height * n.width)
    j = pixel // n.width
    i = pixel % n.width
    if CONFIG.kind == PIXELS:
        x = tl.zeros([CONFIG.sites], tl.float32)
        y = x
    else:
        x = tl.load(lattice.x + i, mask=keep, other=0.0)
        y = tl.load(lattice.y + j, mask=keep, other=0.0)
    return Site(owner.to(tl.int64), tile, slab, block, pixel, k, j, i, keep, x, y)


@triton.jit
def _is_unmasked(table, site):
    """Which sites exist and belong to an unmasked view."""
    return tl.where(site.keep, tl.load(table + UNMASKED), 0.0) != 0.0


@triton.jit
def _plane_row(table, x, y):
    """The terms of one row of a matrix in x, y and 1."""
    return tl.load(table) * x + (tl.load(table + 1) * y + tl.load(table + 3))


@triton.jit
def _coordinates(lattice, view, site, n, CONFIG: tl.constexpr):
    """Coordinates w and z of ``q = (w x, w y, z, w)``, as in `lattice_geometry.site_coordinates`, and the depth."""
    if CONFIG.per_site:
        array = lattice.depths
        offset = site.k.to(tl.int64) * array.z + site.j.to(tl.int64) * array.y + site.i.to(tl.int64) * array.x
        depth = tl.load(array.pointer + _view_start(array, view, n) + offset, mask=site.keep, other=1.0)
        depth = tl.where((depth > 0.0) & (depth <= LARGEST), depth, 1.0)
        w = tl.minimum(depth, 1.0)
        z = tl.div_rn(w, depth)
    else:
        z = tl.load(lattice.z + view * n.planes + site.k, mask=site.keep, other=1.0)
        w = tl.zeros_like(z) + 1.0
        depth = w
    return w, z, depth


@triton.jit
def _row(table, site, w, z, CONFIG: tl.constexpr):
    plane = _plane_row(table, site.x, site.y)
    if CONFIG.per_site:
        plane = plane * w
    return plane + tl.load(table + 2) * z


@triton.jit
def _clamped_plane_row(table, site):
    return tl.minimum(tl.maximum(_plane_row(table, site.x, site.y), -LARGEST_COORDINATE), LARGEST_COORDINATE)


@triton.jit
def _volume_index(table, site, depth, front):
    """An index into a volume: depth (M_x x + M_y y + M_1) + M_z."""
    return tl.where(front, _clamped_plane_row(table, site) * depth + tl.load(table + 2), OUTSIDE)


@triton.jit
def _inside(index, size):
    return (index >= -0.5) & (index < size - 0.5)


@triton.jit
def _reaches(index, size, CONFIG: tl.constexpr):  # whether a sample reads any cell
    MARGIN: tl.constexpr = 0.5 if CONFIG.nearest else 0.0
    return (index >= MARGIN - 1.0) & (index < size - MARGIN) | CONFIG.border


@triton.jit
def _project(lattice, points, view, site, n, near, CONFIG: tl.constexpr):
    """The `Projection` of a program's sites in one view."""
    inverse = tl.zeros([CONFIG.sites], tl.float32)
    distance = inverse
    z = inverse
    if CONFIG.kind == PIXELS:
        entry = view * n.width + site.pixel
        front = tl.load(points.front + entry, mask=site.keep, other=0) != 0
        x = tl.load(points.pixels + 2 * entry, mask=front, other=OUTSIDE)
        y = tl.load(points.pixels + 2 * entry + 1, mask=front, other=OUTSIDE)
    elif CONFIG.kind == VOLUME:
        table = lattice.views + view * FIELDS
        unmasked = _is_unmasked(table, site)
        if CONFIG.per_site:
            _, _, depth = _coordinates(lattice, view, site, n, CONFIG)
            distance = tl.where(unmasked, depth, 0.0)
        else:
            distance = tl.load(lattice.depth + view * n.planes + site.k, mask=unmasked, other=0.0)
        front = unmasked & (distance > near)
        x = _volume_index(table, site, distance, front)
        y = _volume_index(table + 4, site, distance, front)
        z = _volume_index(table + 8, site, distance, front)
        front = front & _reaches(x, n.cells_x, CONFIG) & _reaches(y, n.cells_y, CONFIG) & _reaches(z, n.cells_z, CONFIG)
    else:
        table = lattice.views + view * FIELDS
        unmasked = _is_unmasked(table, site)
        w, along, _ = _coordinates(lattice, view, site, n, CONFIG)
        unit = tl.load(table + UNIT) + tl.zeros_like(along)
        if CONFIG.projective:
            unit = unit * along
        height = _row(table + 8, site, w, along, CONFIG)
        front = unmasked & (height > tl.maximum(near * unit, SMALLEST_DEPTH))
        inverse = tl.div_rn(1.0 + tl.zeros_like(height), tl.where(front, height, 1.0))
        x = tl.where(front, _row(table, site, w, along, CONFIG) * inverse, OUTSIDE)
        y = tl.where(front, _row(table + 4, site, w, along, CONFIG) * inverse, OUTSIDE)
        distance = tl.where(unmasked, tl.div_rn(height, unit), 0.0)
    visible = front & _inside(x, n.cells_x) & _inside(y, n.cells_y)
    if CONFIG.kind == VOLUME:
        visible = visible & _inside(z, n.cells_z)
    return Projection(x, y, z, front, visible, inverse, distance)


@triton.jit
def _direction(lattice, view, site, n, CONFIG: tl.constexpr):
    """The unit vector to the sites, and its inverse length; all 0 in the camera centre and for masked views."""
    table = lattice.views + view * FIELDS
    unmasked = _is_unmasked(table, site)
    w, along, _ = _coordinates(lattice, view, site, n, CONFIG)
    x = _row(table + DIRECTION_FIELDS, site, w, along, CONFIG)
    y = _row(table + DIRECTION_FIELDS + 4, site, w, along, CONFIG)
    z = _row(table + DIRECTION_FIELDS + 8, site, w, along, CONFIG)
    squares = x * x + y * y + z * z
    shortest = FOUR_EPS * (tl.load(table + TERMS) * w + tl.load(table + TERMS + 1) * tl.abs(along))
    away = unmasked & (squares > tl.maximum(shortest * shortest, SMALLEST_DEPTH * SMALLEST_DEPTH))
    inverse = tl.where(away, tl.rsqrt(tl.where(away, squares, 1.0)), 0.0)
    return tl.where(away, x * inverse, 0.0), tl.where(away, y * inverse, 0.0), tl.where(away, z * inverse, 0.0), inverse


# Sampling


@triton.jit
def _axis(index, size, CONFIG: tl.constexpr):
    # Beyond these bounds all cells are outside; clamping keeps infinite indices finite.
    index = tl.minimum(tl.maximum(index, OUTSIDE), size + 1.0)
    if CONFIG.nearest:
        cell = tl.floor(index)
        index = cell + tl.where(index - cell >= 0.5, 1.0, 0.0)
    slope = 1.0 + tl.zeros_like(index)
    if CONFIG.border:
        slope = tl.where((index > 0.0) & (index < size - 1.0), 1.0, 0.0)
        index = tl.minimum(tl.maximum(index, 0.0), size - 1.0)
    lower = tl.floor(index)
    return lower.to(tl.int32), index - lower, slope


@triton.jit
def _cell(projection, n, CONFIG: tl.constexpr):
    x, fraction_x, slope_x = _axis(projection.x, n.cells_x, CONFIG)
    y, fraction_y, slope_y = _axis(projection.y, n.cells_y, CONFIG)
    if CONFIG.kind == VOLUME:
        z, fraction_z, slope_z = _axis(projection.z, n.cells_z, CONFIG)
    else:
        z, fraction_z, slope_z = tl.zeros_like(x), tl.zeros_like(fraction_x), tl.zeros_like(slope_x)
    return Cell(x, y, z, fraction_x, fraction_y, fraction_z, slope_x, slope_y, slope_z)


@triton.jit
def _tap(cell, n, CORNER: tl.constexpr, CONFIG: tl.constexpr):
    """Corner `CORNER` of the cells: its three indices, its weight along each axis, and whether it is in the source."""
    dx: tl.constexpr = CORNER % 2
    dy: tl.constexpr = CORNER // 2 % 2
    dz: tl.constexpr = CORNER // 4
    x, y, z = cell.x + dx, cell.y + dy, cell.z + dz
    weight_x = cell.fraction_x if dx else 1.0 - cell.fraction_x
    weight_y = cell.fraction_y if dy else 1.0 - cell.fraction_y
    weight_z = cell.fraction_z if dz else 1.0 - cell.fraction_z
    inside = (x >= 0) & (x < n.cells_x) & (y >= 0) & (y < n.cells_y)
    if CONFIG.kind == VOLUME:
        inside = inside & (z >= 0) & (z < n.cells_z)
    return x, y, z, weight_x, weight_y, weight_z, inside


@triton.jit
def _view_start(array, view, n):
    return (view // n.views) * array.b + (view % n.views) * array.v


@triton.jit
def _addresses(array, start, z, y, x, channel):
    """Pointers (sites, channels). Offsets in 64 bits: arrays may have more than 2^31 elements."""
    offset = start + z.to(tl.int64) * array.z + y.to(tl.int64) * array.y + x.to(tl.int64) * array.x
    return array.pointer + offset[:, None] + (channel.to(tl.int64) * array.c)[None, :]


@triton.jit
def _channels(PART: tl.constexpr, site, n, CONFIG: tl.constexpr):
    """The channels of a tile, which of them exist, and their indices among the output's."""
    if PART == FEATURES and CONFIG.correlates:
        channel = tl.arange(0, CONFIG.columns)
        return channel, channel < n.features, channel
    elif PART == FEATURES:
        channel = site.tile * CONFIG.channels + tl.arange(0, CONFIG.channels)
        return channel, channel < n.channels, channel
    else:
        channel = tl.arange(0, CONFIG.width)
        return channel, channel < CONFIG.extras, n.features + channel


@triton.jit
def _clamp(values, largest: tl.constexpr):
    """Clamp to [-largest, largest]; NaN passes."""
    return tl.where(values > largest, largest, tl.where(values < -largest, -largest, values))


@triton.jit
def _extra_offsets(points, view, site, n, CONFIG: tl.constexpr):
    """Offsets (sites, width) of the given geometric channels and of their gradients."""
    column = tl.arange(0, CONFIG.width)
    return (view * CONFIG.extras + column)[None, :] * n.width + site.pixel[:, None]


@triton.jit
def _sampled(source, view, projection, channel, exists, n, CONFIG: tl.constexpr):
    """The interpolated channels (sites, channels). Sites not in front read nothing, so that a NaN does no harm."""
    cell, start = _cell(projection, n, CONFIG), _view_start(source, view, n)
    values = tl.zeros([CONFIG.sites, CONFIG.channels], tl.float32)
    for corner in tl.static_range(CONFIG.corners):
        x, y, z, weight_x, weight_y, weight_z, inside = _tap(cell, n, corner, CONFIG)
        mask = (projection.front & inside)[:, None] & exists[None, :]
        value = tl.load(_addresses(source, start, z, y, x, channel), mask=mask, other=0.0).to(tl.float32)
        values += value * (weight_x * weight_y * weight_z)[:, None]
    return values


@triton.jit
def _reference(lattice, view, projection, site, channel, exists, n):
    """The reference's channels (sites, channels) at the sites in front."""
    start, mask = _view_start(lattice.reference, view, n), projection.front[:, None] & exists[None, :]
    addresses = _addresses(lattice.reference, start, site.k, site.j, site.i, channel)
    return tl.load(addresses, mask=mask, other=0.0).to(tl.float32)


@triton.jit
def _chunk(number, n, CONFIG: tl.constexpr):
    channel = number * CONFIG.channels + tl.arange(0, CONFIG.channels)
    return channel, channel < n.channels


@triton.jit
def _correlations(source, lattice, view, projection, site, n, CONFIG: tl.constexpr):
    """Means, or sums, over groups of channels of reference times sample, (sites, groups)."""
    column, size = tl.arange(0, CONFIG.columns)[None, :], tl.maximum(n.channels // n.features, 1)
    values, divisor = tl.zeros([CONFIG.sites, CONFIG.columns], tl.float32), size if CONFIG.averages else 1
    for number in range(n.chunks):
        channel, exists = _chunk(number, n, CONFIG)
        product = _sampled(source, view, projection, channel, exists, n, CONFIG)
        product = _clamp(product * _reference(lattice, view, projection, site, channel, exists, n), LARGEST) / divisor
        for group in range(n.features):
            share = tl.sum(tl.where((channel // size == group)[None, :], product, 0.0), 1)
            values += tl.where(column == group, share[:, None], 0.0)
    return _clamp(values, LARGEST)


@triton.jit
def _values(PART: tl.constexpr, source, lattice, points, view, projection, site, n, CONFIG: tl.constexpr):
    """A view's channels, (sites, channels): sampled or correlated, or geometric."""
    channel, exists, _ = _channels(PART, site, n, CONFIG)
    if PART == FEATURES and CONFIG.correlates:
        return _correlations(source, lattice, view, projection, site, n, CONFIG)
    elif PART == FEATURES:
        return _sampled(source, view, projection, channel, exists, n, CONFIG)
    elif CONFIG.kind == PIXELS:
        mask = site.keep[:, None] & exists[None, :]
        return _clamp(
            tl.load(points.extra + _extra_offsets(points, view, site, n, CONFIG), mask=mask, other=0.0), LARGEST
        )
    else:
        values = tl.zeros([CONFIG.sites, CONFIG.width], tl.float32)
        column = channel[None, :]
        if CONFIG.depth:
            values = tl.where(column == 0, _clamp(projection.distance, LARGEST)[:, None], values)
        if CONFIG.direction:
            x, y, z, _ = _direction(lattice, view, site, n, CONFIG)
            values = tl.where(column == CONFIG.depth, x[:, None], values)
            values = tl.where(column == CONFIG.depth + 1, y[:, None], values)
            values = tl.where(column == CONFIG.depth + 2, z[:, None], values)
        return values


# Statistics over the views


@triton.jit
def _inverse_count(visible, lattice, points, site, n, near, CONFIG: tl.constexpr):
    """One over the number of views that see each site; stores which do in `visible`, unless None."""
    count = tl.zeros([CONFIG.sites], tl.float32)
    for v in range(n.views):
        view = site.owner * n.views + v
        seen = _project(lattice, points, view, site, n, near, CONFIG).visible
        count += seen.to(tl.float32)
        if visible is not None:
            _store_visible(visible, seen, view, site, n)
    return tl.div_rn(1.0 + tl.zeros_like(count), tl.maximum(count, 1.0))


@triton.jit
def _store_visible(visible, seen, view, site, n):
    entry = (view * n.planes + site.k) * (n.height * n.width) + site.pixel
    tl.store(visible + entry, seen.to(tl.uint8), mask=tl.where(site.keep, site.tile, 1) == 0)


@triton.jit
def _moments(PART: tl.constexpr, share, source, lattice, points, site, n, near, CONFIG: tl.constexpr):
    """Mean and maximum (sites, channels), the first view that attains it, and the largest magnitude of the tile."""
    WIDTH: tl.constexpr = CONFIG.columns if PART == FEATURES else CONFIG.width
    mean = tl.zeros([CONFIG.sites, WIDTH], tl.float32)
    best = tl.full([CONFIG.sites, WIDTH], float("-inf"), tl.float32)
    first = tl.full([CONFIG.sites, WIDTH], -1, tl.int32)
    magnitude = tl.zeros([CONFIG.sites, WIDTH], tl.float32)
    for v in range(n.views):
        view = site.owner * n.views + v
        projection = _project(lattice, points, view, site, n, near, CONFIG)
        values = _values(PART, source, lattice, points, view, projection, site, n, CONFIG)
        seen = projection.visible[:, None]
        visible_values = tl.where(seen, values, 0.0)
        mean += visible_values * share[:, None]  # divided before the sum, which could overflow
        # The first visible view, then the larger value; a NaN is above all.
        larger = seen & ((first < 0) | (values > best) | (values != values) & (best == best))
        best = tl.where(larger, values, best)
        first = tl.where(larger, v, first)
        magnitude = tl.maximum(magnitude, tl.abs(visible_values))
    return mean, tl.where(first < 0, 0.0, best), first, tl.max(tl.max(magnitude, 1), 0)


@triton.jit
def _variance(PART: tl.constexpr, mean, share, source, lattice, points, site, n, near, CONFIG: tl.constexpr):
    """Mean of squares about the mean, and the mean deviation of those not clamped: not 0 where others are."""
    variance, drift = tl.zeros_like(mean), tl.zeros_like(mean)
    for v in range(n.views):
        view = site.owner * n.views + v
        projection = _project(lattice, points, view, site, n, near, CONFIG)
        values = _values(PART, source, lattice, points, view, projection, site, n, CONFIG)
        deviation = tl.where(projection.visible[:, None], values - mean, 0.0)
        clamped = _clamp(deviation, LARGEST_DEVIATION)
        variance += clamped * clamped * share[:, None]
        drift += tl.where(tl.abs(deviation) <= LARGEST_DEVIATION, deviation, 0.0) * share[:, None]
    return _clamp(variance, LARGEST), drift


# Forward


@triton.jit
def _store(out, values, start, BLOCK: tl.constexpr, PART: tl.constexpr, site, n, CONFIG: tl.constexpr):
    """Write a tile to block `BLOCK` of the output's channels."""
    _, exists, channel = _channels(PART, site, n, CONFIG)
    channel += BLOCK * (n.features + CONFIG.extras)
    mask = site.keep[:, None] & exists[None, :]
    values = _clamp(values, CONFIG.largest) if CONFIG.largest < LARGEST else values
    addresses = _addresses(out, start, site.k, site.j, site.i, channel)
    tl.store(addresses, values.to(out.pointer.dtype.element_ty), mask=mask)


@triton.jit
def _write(PART: tl.constexpr, share, out, source, lattice, points, site, n, near, CONFIG: tl.constexpr):
    if CONFIG.reduce:
        start = site.owner * out.b
        mean, best, _, _ = _moments(PART, share, source, lattice, points, site, n, near, CONFIG)
        if CONFIG.mean >= 0:
            _store(out, mean, start, CONFIG.mean, PART, site, n, CONFIG)
        if CONFIG.maximum >= 0:
            _store(out, best, start, CONFIG.maximum, PART, site, n, CONFIG)
        if CONFIG.variance >= 0:
            variance, _ = _variance(PART, mean, share, source, lattice, points, site, n, near, CONFIG)
            _store(out, variance, start, CONFIG.variance, PART, site, n, CONFIG)
    else:
        view = site.owner
        projection = _project(lattice, points, view, site, n, near, CONFIG)
        values = _values(PART, source, lattice, points, view, projection, site, n, CONFIG)
        _store(out, values, _view_start(out, view, n), 0, PART, site, n, CONFIG)


@triton.jit
def resample(out, visible, source, lattice, points, n, near, CONFIG: tl.constexpr):
    """Sample, append geometric channels, and reduce over the views.

    Args:
        out: `Strided`, (B, V, C', D, H, W), or (B, C'', D, H, W) with a view's stride of 0.
        visible: (B, V, D, H, W) uint8, contiguous.
        source: `Strided`, (B, V, C, d, h, w), with stride 0 for the views of volumes and the depth of images.
        lattice: `Lattice`, its fields None for given pixels.
        points: `Points`, its fields None for a lattice.
        n: `Sizes`.
        near: least depth of a visible site.
        CONFIG: `Config`.
    """
    site = _site(lattice, n, CONFIG)
    if CONFIG.reduce:
        share = _inverse_count(visible, lattice, points, site, n, near, CONFIG)
    else:
        share = tl.zeros([CONFIG.sites], tl.float32)
        _store_visible(
            visible, _project(lattice, points, site.owner, site, n, near, CONFIG).visible, site.owner, site, n
        )
    _write(FEATURES, share, out, source, lattice, points, site, n, near, CONFIG)
    if CONFIG.extras > 0:
        if site.tile == 0:
            _write(EXTRAS, share, out, source, lattice, points, site, n, near, CONFIG)
