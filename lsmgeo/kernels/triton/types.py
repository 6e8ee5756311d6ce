"""Arguments of the Triton kernels and what their functions exchange: constants and tuples. Imports Triton."""

# mypy: disallow-untyped-decorators=False

from __future__ import annotations

from typing import Any, NamedTuple

import triton.language as tl

# A lane is a site of a lattice that samples images or volumes, or a given pixel of images.
IMAGES = tl.constexpr(0)
VOLUME = tl.constexpr(1)
PIXELS = tl.constexpr(2)

# The tiles of features and of geometric channels.
FEATURES = tl.constexpr(0)
EXTRAS = tl.constexpr(1)

# As in the reference.
OUTSIDE = tl.constexpr(-2.0)
LARGEST_COORDINATE = tl.constexpr(2.0**100)
SMALLEST_DEPTH = tl.constexpr(2.0**-60)
FOUR_EPS = tl.constexpr(2.0**-21)
LARGEST = tl.constexpr((2.0 - 2.0**-23) * 2.0**127)
LARGEST_DEVIATION = tl.constexpr(((2.0 - 2.0**-23) * 2.0**127) ** 0.5)

# A view's numbers in `Lattice.views`: M by rows, the z of a site at depth 1 (or at s = 1), 0 if the view is
# masked; with directions also G by rows, and the bound on the terms of its sums: a constant, and a factor of |z|.
FIELDS = tl.constexpr(28)
UNIT = tl.constexpr(12)
UNMASKED = tl.constexpr(13)
DIRECTION_FIELDS = tl.constexpr(14)
TERMS = tl.constexpr(26)

# Sums over the sites of a plane that a program writes: for each of three rows g x, g y and g, g a gradient. Those of
# geometric channels start with four of the depth: its row, and its gradient through s. Where each site has its own
# depth, q is (w x, w y, z, w), and there is a sum g z more for each row.
ROW = tl.constexpr(3)
ROW_PER_SITE = tl.constexpr(4)
DEPTH_SUMS = tl.constexpr(4)


class Strided(NamedTuple):
    """An array by its first element and its strides: scene, view, channel, and three of sites or cells."""

    pointer: Any
    b: Any
    v: Any
    c: Any
    z: Any
    y: Any
    x: Any


class Lattice(NamedTuple):
    """The sites of a lattice: float32 tables."""

    views: Any  # (B V, FIELDS)
    x: Any  # (W,)
    y: Any  # (H,)
    z: Any  # (B V, D)
    depth: Any  # (B V, D), of frustums in volumes
    depths: Any  # `Strided`, where each site has its own
    reference: Any  # `Strided`, to correlate the samples with


class Points(NamedTuple):
    """Given pixels: contiguous arrays."""

    pixels: Any  # (B V, N, 2) float32
    front: Any  # (B V, N) uint8
    extra: Any  # (B V, E, N) float32


class Into(NamedTuple):
    """What gradients are added to: float32, or int64 in units of 1 / scale, a scale (1,) float32 then, else None."""

    source: Any  # `Strided`
    source_scale: Any
    reference: Any  # `Strided`, or None
    reference_scale: Any


class Sums(NamedTuple):
    """What a backward writes, float32, or None."""

    index: Any  # (B V, D, blocks, tiles, 9 or 12), or the pixels' gradients (B V, N, tiles, 2)
    extra: Any  # (B V, D, blocks, 13 or 16), or the given channels' gradients (B V, E, N)
    depths: Any  # (B V, tiles and 1 with geometric channels, D, H, W)


class Sizes(NamedTuple):
    """Counts of views, channels, sites and cells, and into how many programs each is divided."""

    views: Any
    channels: Any  # of the source
    features: Any  # of the values, before the geometric ones: as many, or groups
    planes: Any  # D or P
    height: Any
    width: Any  # of the lattice; the number of pixels
    cells_z: Any
    cells_y: Any
    cells_x: Any
    tiles: Any  # of channels
    chunks: Any  # of channels that one program correlates after another
    blocks: Any  # of sites in a plane
    slabs: Any  # of planes


class Config(NamedTuple):
    """The compile-time constants of a kernel."""

    kind: int
    nearest: bool
    border: bool
    projective: bool
    depth: bool
    direction: bool
    extras: int  # geometric channels
    reduce: bool
    mean: int  # index of its block of channels; -1 if not requested
    variance: int
    maximum: int
    largest: float  # above it the output saturates, see `lsmgeo._dtypes.saturation_limit`
    sites: int  # of a tile
    planes: int  # of them along the third axis: 1 unless that is the fastest in the output
    channels: int  # of a tile of the source
    columns: int  # of the tile of the values' features
    width: int  # of the tile of geometric channels
    corners: int  # cells that a sample reads
    needs_source: bool = False
    needs_geometry: bool = False
    needs_reference: bool = False
    per_site: bool = False  # whether each site has its own depth
    correlates: bool = False
    averages: bool = True  # whether a correlation is a mean over its channels, not their sum


class Site(NamedTuple):
    """The sites of a program."""

    owner: Any  # b V + v, or b where views are reduced
    tile: Any
    slab: Any
    block: Any
    pixel: Any  # within the plane; (sites,) from here on
    k: Any
    j: Any
    i: Any
    keep: Any
    x: Any
    y: Any


class Projection(NamedTuple):
    """The sites in a view, (sites,) each."""

    x: Any  # index into the source
    y: Any
    z: Any
    front: Any
    visible: Any
    inverse: Any  # 1 / (M q)_3 of images
    distance: Any  # the depth channel


class Cell(NamedTuple):
    """The lower cell, the fraction towards the upper one, and the index's derivative: 0 where it is clamped."""

    x: Any
    y: Any
    z: Any
    fraction_x: Any
    fraction_y: Any
    fraction_z: Any
    slope_x: Any
    slope_y: Any
    slope_z: Any
