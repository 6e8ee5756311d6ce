"""The Triton kernel that resamples; `backward` has the one that takes gradients back, `operators` launches both.

Both serve three kinds of sites: those of a lattice in images, those of frustums in volumes, and given pixels. A program
works on a tile: a block of consecutive sites by a block of channels, of one view, or of all views one after another
where a statistic over them is asked for. What is recomputed instead of kept (places, moments over the views) costs
arithmetic alone. Features and geometric channels are two tiles of different width that share all of the code but
`_values` and its derivative; `PART` tells them apart.

Importing this module imports Triton.
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
    KEPT,
    LARGEST,
    LARGEST_COORDINATE,
    LARGEST_DEVIATION,
    OUTSIDE,
    PIXELS,
    SMALLEST_DEPTH,
    TERMS,
    UNIT,
    VOLUME,
    Cell,
    Place,
    Site,
)

__all__ = ["resample"]

# Places


@triton.jit
def _site(lattice, n, HOW: tl.constexpr):
    program = tl.program_id(0)
    tile = program % n.tiles
    rest = program // n.tiles
    block = rest % n.blocks
    rest = rest // n.blocks
    slab = rest % n.slabs
    owner = rest // n.slabs
    lane = tl.arange(0, HOW.sites)
    k = slab * HOW.planes + lane % HOW.planes
    pixel = block * (HOW.sites // HOW.planes) + lane // HOW.planes
    keep = (k < n.planes) & (pixel < n.height * n.width)
    j = pixel // n.width
    i = pixel % n.width
    if HOW.kind == PIXELS:
        x = tl.zeros([HOW.sites], tl.float32)
        y = x
    else:
        x = tl.load(lattice.x + i, mask=keep, other=0.0)
        y = tl.load(lattice.y + j, mask=keep, other=0.0)
    return Site(owner.to(tl.int64), tile, slab, block, pixel, k, j, i, keep, x, y)


@triton.jit
def _kept(table, site):
    """Which sites exist and belong to a view that is not left out."""
    return tl.where(site.keep, tl.load(table + KEPT), 0.0) != 0.0


@triton.jit
def _plane_row(table, x, y):
    """The terms of one row of a matrix in x, y and 1."""
    return tl.load(table) * x + (tl.load(table + 1) * y + tl.load(table + 3))


@triton.jit
def _row(table, x, y, z):
    return _plane_row(table, x, y) + tl.load(table + 2) * z


@triton.jit
def _swept(table, site, reach, front):
    """An index into a volume: depth (M_x x + M_y y + M_1) + M_z."""
    plane = tl.minimum(tl.maximum(_plane_row(table, site.x, site.y), -LARGEST_COORDINATE), LARGEST_COORDINATE)
    return tl.where(front, plane * reach + tl.load(table + 2), OUTSIDE)


@triton.jit
def _inside(index, size):
    return (index >= -0.5) & (index < size - 0.5)


@triton.jit
def _locate(lattice, points, view, site, n, near, HOW: tl.constexpr):
    """The `Place` of a program's sites in one view."""
    inverse = tl.zeros([HOW.sites], tl.float32)
    distance = inverse
    z = inverse
    if HOW.kind == PIXELS:
        entry = view * n.width + site.pixel
        front = tl.load(points.front + entry, mask=site.keep, other=0) != 0
        x = tl.load(points.pixels + 2 * entry, mask=front, other=OUTSIDE)
        y = tl.load(points.pixels + 2 * entry + 1, mask=front, other=OUTSIDE)
    elif HOW.kind == VOLUME:
        table = lattice.views + view * FIELDS
        kept = _kept(table, site)
        distance = tl.load(lattice.depth + view * n.planes + site.k, mask=kept, other=0.0)
        front = kept & (distance > near)
        x = _swept(table, site, distance, front)
        y = _swept(table + 4, site, distance, front)
        z = _swept(table + 8, site, distance, front)
    else:
        table = lattice.views + view * FIELDS
        kept = _kept(table, site)
        along = tl.load(lattice.z + view * n.planes + site.k, mask=site.keep, other=1.0)
        unit = tl.load(table + UNIT) + tl.zeros_like(along)
        if HOW.projective:
            unit = unit * along
        third = _row(table + 8, site.x, site.y, along)
        front = kept & (third > tl.maximum(near * unit, SMALLEST_DEPTH))
        inverse = tl.div_rn(1.0 + tl.zeros_like(third), tl.where(front, third, 1.0))
        x = tl.where(front, _row(table, site.x, site.y, along) * inverse, OUTSIDE)
        y = tl.where(front, _row(table + 4, site.x, site.y, along) * inverse, OUTSIDE)
        distance = tl.where(kept, tl.div_rn(third, unit), 0.0)
    visible = front & _inside(x, n.cells_x) & _inside(y, n.cells_y)
    if HOW.kind == VOLUME:
        visible = visible & _inside(z, n.cells_z)
    return Place(x, y, z, front, visible, inverse, distance)


@triton.jit
def _direction(lattice, view, site, n, HOW: tl.constexpr):
    """The unit vector to the sites, and its inverse length; all 0 in the camera's centre and for views left out."""
    table = lattice.views + view * FIELDS
    kept = _kept(table, site)
    along = tl.load(lattice.z + view * n.planes + site.k, mask=site.keep, other=1.0)
    x = _row(table + DIRECTION_FIELDS, site.x, site.y, along)
    y = _row(table + DIRECTION_FIELDS + 4, site.x, site.y, along)
    z = _row(table + DIRECTION_FIELDS + 8, site.x, site.y, along)
    squares = x * x + y * y + z * z
    shortest = FOUR_EPS * (tl.load(table + TERMS) + tl.load(table + TERMS + 1) * tl.abs(along))
    away = kept & (squares > shortest * shortest)
    inverse = tl.where(away, tl.rsqrt(tl.where(away, squares, 1.0)), 0.0)
    return tl.where(away, x * inverse, 0.0), tl.where(away, y * inverse, 0.0), tl.where(away, z * inverse, 0.0), inverse


# Sampling


@triton.jit
def _axis(index, size, HOW: tl.constexpr):
    # All cells are outside there too, and what is finite stays finite.
    index = tl.minimum(tl.maximum(index, OUTSIDE), size + 1.0)
    if HOW.nearest:
        cell = tl.floor(index)
        index = cell + tl.where(index - cell >= 0.5, 1.0, 0.0)
    slope = 1.0 + tl.zeros_like(index)
    if HOW.border:
        slope = tl.where((index > 0.0) & (index < size - 1.0), 1.0, 0.0)
        index = tl.minimum(tl.maximum(index, 0.0), size - 1.0)
    lower = tl.floor(index)
    return lower.to(tl.int32), index - lower, slope


@triton.jit
def _cell(place, n, HOW: tl.constexpr):
    x, along_x, slope_x = _axis(place.x, n.cells_x, HOW)
    y, along_y, slope_y = _axis(place.y, n.cells_y, HOW)
    if HOW.kind == VOLUME:
        z, along_z, slope_z = _axis(place.z, n.cells_z, HOW)
    else:
        z, along_z, slope_z = tl.zeros_like(x), tl.zeros_like(along_x), tl.zeros_like(slope_x)
    return Cell(x, y, z, along_x, along_y, along_z, slope_x, slope_y, slope_z)


@triton.jit
def _tap(cell, n, CORNER: tl.constexpr, HOW: tl.constexpr):
    """Corner `CORNER` of the cells: its three indices, its weight along each axis, and whether it exists."""
    dx: tl.constexpr = CORNER % 2
    dy: tl.constexpr = CORNER // 2 % 2
    dz: tl.constexpr = CORNER // 4
    x, y, z = cell.x + dx, cell.y + dy, cell.z + dz
    weight_x = cell.along_x if dx else 1.0 - cell.along_x
    weight_y = cell.along_y if dy else 1.0 - cell.along_y
    weight_z = cell.along_z if dz else 1.0 - cell.along_z
    exists = (x >= 0) & (x < n.cells_x) & (y >= 0) & (y < n.cells_y)
    if HOW.kind == VOLUME:
        exists = exists & (z >= 0) & (z < n.cells_z)
    return x, y, z, weight_x, weight_y, weight_z, exists


@triton.jit
def _view_start(array, view, n):
    return (view // n.views) * array.b + (view % n.views) * array.v


@triton.jit
def _addresses(array, start, z, y, x, channel):
    """Pointers (sites, channels). Offsets in 64 bits: arrays may have more than 2^31 elements."""
    offset = start + z.to(tl.int64) * array.z + y.to(tl.int64) * array.y + x.to(tl.int64) * array.x
    return array.pointer + offset[:, None] + (channel.to(tl.int64) * array.c)[None, :]


@triton.jit
def _channels(PART: tl.constexpr, site, n, HOW: tl.constexpr):
    """The channels of a tile, which of them exist, and where they stand among the output's."""
    if PART == FEATURES:
        channel = site.tile * HOW.channels + tl.arange(0, HOW.channels)
        return channel, channel < n.channels, channel
    else:
        channel = tl.arange(0, HOW.width)
        return channel, channel < HOW.extras, n.channels + channel


@triton.jit
def _saturated(values, largest: tl.constexpr):
    """Held within the finite values; NaN passes."""
    return tl.where(values > largest, largest, tl.where(values < -largest, -largest, values))


@triton.jit
def _given(points, view, site, n, HOW: tl.constexpr):
    """Addresses of given geometric channels and of their gradients, as offsets (sites, width)."""
    column = tl.arange(0, HOW.width)
    return (view * HOW.extras + column)[None, :] * n.width + site.pixel[:, None]


@triton.jit
def _values(PART: tl.constexpr, source, lattice, points, view, place, site, n, HOW: tl.constexpr):
    """A view's channels, (sites, channels): sampled, or geometric."""
    channel, exists, _ = _channels(PART, site, n, HOW)
    if PART == FEATURES:
        cell = _cell(place, n, HOW)
        start = _view_start(source, view, n)
        values = tl.zeros([HOW.sites, HOW.channels], tl.float32)
        for corner in tl.static_range(HOW.corners):
            x, y, z, weight_x, weight_y, weight_z, there = _tap(cell, n, corner, HOW)
            # Sites not in front read nothing: whatever stands in the features there reaches nobody.
            mask = (place.front & there)[:, None] & exists[None, :]
            value = tl.load(_addresses(source, start, z, y, x, channel), mask=mask, other=0.0).to(tl.float32)
            values += value * (weight_x * weight_y * weight_z)[:, None]
        return values
    elif HOW.kind == PIXELS:
        mask = site.keep[:, None] & exists[None, :]
        return _saturated(tl.load(points.extra + _given(points, view, site, n, HOW), mask=mask, other=0.0), LARGEST)
    else:
        values = tl.zeros([HOW.sites, HOW.width], tl.float32)
        column = channel[None, :]
        if HOW.depth:
            values = tl.where(column == 0, _saturated(place.distance, LARGEST)[:, None], values)
        if HOW.direction:
            x, y, z, _ = _direction(lattice, view, site, n, HOW)
            values = tl.where(column == HOW.depth, x[:, None], values)
            values = tl.where(column == HOW.depth + 1, y[:, None], values)
            values = tl.where(column == HOW.depth + 2, z[:, None], values)
        return values


# Statistics over the views


@triton.jit
def _share(visible, lattice, points, site, n, near, HOW: tl.constexpr):
    """One over the number of views that see each site; notes which do, if it is told where."""
    count = tl.zeros([HOW.sites], tl.float32)
    for v in range(n.views):
        view = site.owner * n.views + v
        seen = _locate(lattice, points, view, site, n, near, HOW).visible
        count += seen.to(tl.float32)
        if visible is not None:
            _note(visible, seen, view, site, n)
    return tl.div_rn(1.0 + tl.zeros_like(count), tl.maximum(count, 1.0))


@triton.jit
def _note(visible, seen, view, site, n):
    entry = (view * n.planes + site.k) * (n.height * n.width) + site.pixel
    tl.store(visible + entry, seen.to(tl.uint8), mask=tl.where(site.keep, site.tile, 1) == 0)


@triton.jit
def _moments(PART: tl.constexpr, share, source, lattice, points, site, n, near, HOW: tl.constexpr):
    """Mean and maximum (sites, channels), the first view that has it, and the largest magnitude of the tile."""
    WIDTH: tl.constexpr = HOW.channels if PART == FEATURES else HOW.width
    mean = tl.zeros([HOW.sites, WIDTH], tl.float32)
    best = tl.full([HOW.sites, WIDTH], float("-inf"), tl.float32)
    first = tl.full([HOW.sites, WIDTH], -1, tl.int32)
    top = tl.zeros([HOW.sites, WIDTH], tl.float32)
    for v in range(n.views):
        view = site.owner * n.views + v
        place = _locate(lattice, points, view, site, n, near, HOW)
        values = _values(PART, source, lattice, points, view, place, site, n, HOW)
        seen = place.visible[:, None]
        kept = tl.where(seen, values, 0.0)
        mean += kept * share[:, None]  # shares before the sum, which could overflow
        # The first that is seen, then the larger; a NaN wins, and stays.
        better = seen & ((first < 0) | (values > best) | (values != values) & (best == best))
        best = tl.where(better, values, best)
        first = tl.where(better, v, first)
        top = tl.maximum(top, tl.abs(kept))
    return mean, tl.where(first < 0, 0.0, best), first, tl.max(tl.max(top, 1), 0)


@triton.jit
def _variance(PART: tl.constexpr, mean, share, source, lattice, points, site, n, near, HOW: tl.constexpr):
    """Mean of squares about the mean, and the mean deviation of those not held: not 0 where others are."""
    variance, drift = tl.zeros_like(mean), tl.zeros_like(mean)
    for v in range(n.views):
        view = site.owner * n.views + v
        place = _locate(lattice, points, view, site, n, near, HOW)
        values = _values(PART, source, lattice, points, view, place, site, n, HOW)
        deviation = tl.where(place.visible[:, None], values - mean, 0.0)
        held = _saturated(deviation, LARGEST_DEVIATION)
        variance += held * held * share[:, None]
        drift += tl.where(tl.abs(deviation) <= LARGEST_DEVIATION, deviation, 0.0) * share[:, None]
    return _saturated(variance, LARGEST), drift


# Forward


@triton.jit
def _store(out, values, start, place: tl.constexpr, PART: tl.constexpr, site, n, HOW: tl.constexpr):
    """Write a tile to block `place` of the output's channels."""
    _, exists, channel = _channels(PART, site, n, HOW)
    channel += place * (n.channels + HOW.extras)
    mask = site.keep[:, None] & exists[None, :]
    values = _saturated(values, HOW.largest) if HOW.largest < LARGEST else values
    addresses = _addresses(out, start, site.k, site.j, site.i, channel)
    tl.store(addresses, values.to(out.pointer.dtype.element_ty), mask=mask)


@triton.jit
def _write(PART: tl.constexpr, share, out, source, lattice, points, site, n, near, HOW: tl.constexpr):
    if HOW.reduce:
        start = site.owner * out.b
        mean, best, _, _ = _moments(PART, share, source, lattice, points, site, n, near, HOW)
        if HOW.mean >= 0:
            _store(out, mean, start, HOW.mean, PART, site, n, HOW)
        if HOW.maximum >= 0:
            _store(out, best, start, HOW.maximum, PART, site, n, HOW)
        if HOW.variance >= 0:
            variance, _ = _variance(PART, mean, share, source, lattice, points, site, n, near, HOW)
            _store(out, variance, start, HOW.variance, PART, site, n, HOW)
    else:
        view = site.owner
        place = _locate(lattice, points, view, site, n, near, HOW)
        values = _values(PART, source, lattice, points, view, place, site, n, HOW)
        _store(out, values, _view_start(out, view, n), 0, PART, site, n, HOW)


@triton.jit
def resample(out, visible, source, lattice, points, n, near, HOW: tl.constexpr):
    """Sample, append geometric channels, and reduce over the views.

    Args:
        out: `Strided`, (B, V, C', D, H, W), or (B, C'', D, H, W) with a view's stride of 0.
        visible: (B, V, D, H, W) uint8, contiguous.
        source: `Strided`, (B, V, C, d, h, w), with a stride of 0 where volumes have no views and images no depth.
        lattice: `Lattice`, or None's.
        points: `Points`, or None's.
        n: `Sizes`.
        near: least depth of a visible site.
        HOW: `How`.
    """
    site = _site(lattice, n, HOW)
    if HOW.reduce:
        share = _share(visible, lattice, points, site, n, near, HOW)
    else:
        share = tl.zeros([HOW.sites], tl.float32)
        _note(visible, _locate(lattice, points, site.owner, site, n, near, HOW).visible, site.owner, site, n)
    _write(FEATURES, share, out, source, lattice, points, site, n, near, HOW)
    if HOW.extras > 0:
        if site.tile == 0:
            _write(EXTRAS, share, out, source, lattice, points, site, n, near, HOW)
