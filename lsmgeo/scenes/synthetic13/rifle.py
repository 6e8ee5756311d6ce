"""Rifles.

Structures: a stock (wooden, straight, skeleton, thumbhole, wire, none), a fore end (wood, guard, pump, rail with or
without a grip), a magazine (none, box, curved, drum), a sight (none, scope, irons, red dot, handle), a muzzle (plain,
brake, suppressor, bayonet) and a bipod or none.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lsmgeo.scenes.primitives import Solid, box, cone, cylinder, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import bar, below, block, pair, pillar, rack, ring, rod, slab

__all__ = ["build"]


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one rifle, about 1 long; its muzzle is at +x, the rear end of its receiver at x = 0."""
    stock = p.choice("stock", ("wooden", "wooden", "straight", "skeleton", "thumbhole", "wire", "none"))
    length, height = p.uniform("receiver_length", 0.16, 0.3), p.uniform("receiver_height", 0.05, 0.09)
    width, reach = p.uniform("receiver_width", 0.03, 0.045), p.uniform("barrel_length", 0.22, 0.55)
    radius = p.uniform("barrel_radius", 0.013, 0.018)
    axis = 0.25 * height  # the barrel's height over the receiver's middle
    parts = [
        slab((0, -height / 2), (length, height / 2), width / 2, colours.trim),
        rod((length - 0.02, axis, 0), length + reach, radius, colours.dark),
        block((0.35 * length, -0.2 * height, 0), (0.7 * length, 0.3 * height, 0.65 * width), colours.dark),
    ]
    parts += _stock(p, stock, colours, height, width)
    parts += _grip(p, stock, colours, height, width, length)
    parts += _fore_end(p, colours, length, reach, height, width, axis)
    parts += _magazine(p, colours, length, height, width)
    parts += _sight(p, colours, length, height, width, reach, axis)
    return parts + _muzzle(p, colours, length + reach, axis, radius)


def _stock(p: Parameters, stock: str, colours: Palette, height: float, width: float) -> list[Solid]:
    """The stock, behind x = 0."""
    if stock == "none":
        return [rod((-0.03, 0, 0), 0.01, 0.4 * height, colours.trim)]
    long, drop = p.uniform("stock_length", 0.2, 0.34), p.uniform("stock_drop", 0.01, 0.08)
    butt = p.uniform("butt_height", 0.09, 0.15)
    low, up = -drop - butt / 2, -drop + butt / 2
    pad = slab((-long - 0.025, low), (-long, up), 0.55 * width, colours.dark)
    if stock in ("wooden", "thumbhole"):
        body = _tapering(long, drop, butt, 0.8 * height, width, colours)
        if stock == "thumbhole":
            hole = cylinder((-0.3 * long, -0.35 * drop, -1), (-0.3 * long, -0.35 * drop, 1), 0.22 * height)
            return [body.minus(hole.scaled((2.0, 1.0, 1.0), (-0.3 * long, 0, 0))), pad]
        return [body, pad]
    if stock == "straight":
        body = slab((-long, -0.6 * height - 0.3 * drop), (0.0, 0.45 * height), width / 2, colours.body)
        tube = rod((-long, 0.1 * height, 0), 0.02, 0.5 * width, colours.trim)
        return [below(body, (-long, 0.45 * height), (0.0, 0.25 * height)), tube, pad]
    if stock == "skeleton":
        rods = ring([(0, 0.2 * height, 0), (-long, min(up, 0.2 * height) - 0.015, 0)], 0.016, colours.body)
        rods += ring([(0, -0.35 * height, 0), (-long, low + 0.02, 0)], 0.016, colours.body)
        return [*rods, pad]
    rods = ring([(0, 0, 0.4 * width), (-long, -drop, 0.4 * width)], 0.013, colours.trim)
    return [*pair(*rods), pad]


def _tapering(long: float, drop: float, butt: float, start: float, width: float, colours: Palette) -> Solid:
    """A stock as high as the receiver in front and as the butt behind."""
    body = slab((-long, -drop - butt / 2), (0.02, start / 2), width / 2, colours.body)
    body = below(body, (-long, -drop + butt / 2), (0, start / 2)) if -drop + butt / 2 < start / 2 else body
    under = slab((-long * 1.2, -1), (1, 0), 1, colours.body)
    slope = (-drop - butt / 2 + start / 2) / -long
    wedge = under.transformed(np.array([[1, 0, 0, 0], [slope, 1, 0, -start / 2], [0, 0, 1, 0]]))
    return body.minus(wedge)


def _grip(p: Parameters, stock: str, colours: Palette, height: float, width: float, length: float) -> list[Solid]:
    """The pistol grip, unless the stock is the grip, and the trigger's guard."""
    place, depth = p.uniform("grip_place", 0.1, 0.25) * length, p.uniform("grip_length", 0.08, 0.13)
    low = -height / 2
    bend = ((0.03, low), (0.035, low - 0.035), (0.085, low - 0.035), (0.09, low))
    guard = ring([(place + x, y, 0) for x, y in bend], 0.013, colours.dark)
    if stock == "wooden":
        return guard
    lean = p.uniform("grip_lean", 0.01, 0.05)
    return [bar((place - lean, low - depth, 0), (place, low + 0.01, 0), 0.045, 0.9 * width, colours.body), *guard]


def _fore_end(
    p: Parameters, colours: Palette, length: float, reach: float, height: float, width: float, axis: float
) -> list[Solid]:
    """The fore end, below or around the barrel."""
    form = p.choice("fore_end", ("wood", "guard", "pump", "rail"))
    long = p.uniform("fore_end_length", 0.4, 0.75) * reach
    end = length + long
    if form == "wood":
        body = slab((length - 0.01, -0.5 * height), (end, axis), width / 2, colours.body)
        under = slab((length - 0.2, -1), (end + 1, 0), 1, colours.body)
        slope = 0.35 * height / long
        shear = np.array([[1, 0, 0, 0], [slope, 1, 0, -0.5 * height - slope * length], [0, 0, 1, 0]])
        return [body.minus(under.transformed(shear))]
    if form == "guard":
        tube = rod((length - 0.01, axis, 0), end, 0.55 * width + 0.006, colours.body)
        first, last = (length, axis - 0.7 * width, -0.7 * width), (end, axis + 0.7 * width, 0.7 * width)
        return [tube, *rack(first, last, 0, 3, colours.dark, 0.25)]
    if form == "pump":
        tube = rod((length - 0.01, axis - 0.042, 0), length + 0.9 * reach, 0.014, colours.dark)
        grip = rod((length + 0.3 * long, axis - 0.042, 0), length + 0.3 * long + 0.13, 0.026, colours.body)
        ringed = box((length + 0.88 * reach, axis - 0.02, 0), (0.026, 0.06, 0.03), colours.dark)
        return [tube, grip, ringed]
    body = slab((length - 0.01, axis - 0.035), (end, axis + 0.03), width / 2, colours.body)
    handle = p.choice("front_grip", ("none", "upright"))
    if handle == "none":
        return [body]
    return [body, pillar((length + 0.6 * long, axis - 0.12, 0), axis - 0.02, 0.018, colours.dark)]


def _magazine(p: Parameters, colours: Palette, length: float, height: float, width: float) -> list[Solid]:
    form = p.choice("magazine", ("none", "box", "curved", "curved", "drum"))
    if form == "none":
        return []
    place, deep = p.uniform("magazine_place", 0.6, 0.85) * length, p.uniform("magazine_length", 0.07, 0.16)
    wide, low = p.uniform("magazine_width", 0.04, 0.065), -height / 2
    if form == "box":
        return [bar((place + 0.1 * deep, low - deep, 0), (place, low + 0.01, 0), wide, 0.8 * width, colours.dark)]
    if form == "curved":
        bend = [
            (place, low + 0.01),
            (place + 0.1 * deep, low - 0.4 * deep),
            (place + 0.38 * deep, low - 0.8 * deep),
            (place + 0.75 * deep, low - 1.1 * deep),
        ]
        return [bar((*second, 0), (*first, 0), wide, 0.8 * width, colours.dark) for first, second in pairwise(bend)]
    neck = slab((place - 0.02, low - 0.03), (place + 0.02, low + 0.01), 0.4 * width, colours.dark)
    return [neck, cylinder((place, low - 0.06, -0.8 * width), (place, low - 0.06, 0.8 * width), 0.055, colours.dark)]


def _sight(
    p: Parameters, colours: Palette, length: float, height: float, width: float, reach: float, axis: float
) -> list[Solid]:
    """The sight, on top of the receiver."""
    form = p.choice("sight", ("none", "scope", "scope", "irons", "red dot", "handle"))
    top = height / 2
    front = slab((length + 0.9 * reach - 0.013, axis), (length + 0.9 * reach + 0.013, axis + 0.05), 0.013, colours.dark)
    if form == "none":
        return []
    if form == "scope":
        long, size = p.uniform("scope_length", 0.16, 0.3), p.uniform("scope_radius", 0.014, 0.02)
        up = top + p.uniform("scope_height", 0.025, 0.045)
        x = 0.5 * length - 0.4 * long
        rings = [
            slab((x + share * long - 0.013, top - 0.005), (x + share * long + 0.013, up), 0.013, colours.trim)
            for share in (0.3, 0.6)
        ]
        return [
            rod((x, up, 0), x + long, size, colours.dark),
            cone((x + 0.75 * long, up, 0), (x + long + 0.03, up, 0), size, 1.7 * size, colours.dark),
            cone((x - 0.02, up, 0), (x + 0.15 * long, up, 0), 1.4 * size, size, colours.dark),
            pillar((x + 0.48 * long, up, 0), up + 1.9 * size, 0.014, colours.dark),
            *rings,
        ]
    if form == "irons":
        rear = slab((0.2 * length, top - 0.01), (0.2 * length + 0.03, top + 0.03), 0.018, colours.dark)
        return [rear, front]
    if form == "red dot":
        x = 0.45 * length
        return [
            slab((x, top - 0.01), (x + 0.07, top + 0.02), 0.018, colours.dark),
            rod((x, top + 0.035, 0), x + 0.07, 0.027, colours.dark),
            front,
        ]
    rise = p.uniform("handle_height", 0.05, 0.08)
    posts = [
        bar((x, top - 0.01, 0), (x + lean, top + rise, 0), 0.03, 0.026, colours.trim)
        for x, lean in ((0.15 * length, 0.01), (0.8 * length, -0.03))
    ]
    grip = slab((0.1 * length, top + rise - 0.026), (0.8 * length, top + rise), 0.014, colours.trim)
    return [*posts, grip, front]


def _muzzle(p: Parameters, colours: Palette, end: float, axis: float, radius: float) -> list[Solid]:
    form = p.choice("muzzle", ("plain", "brake", "suppressor", "bayonet"))
    parts = []
    if form == "brake":
        parts.append(rod((end - 0.01, axis, 0), end + 0.05, 1.5 * radius, colours.trim))
    elif form == "suppressor":
        long = p.uniform("suppressor_length", 0.12, 0.22)
        parts.append(rod((end - 0.02, axis, 0), end + long, 1.7 * radius, colours.trim))
    elif form == "bayonet":
        blade = ellipsoid((end + 0.05, axis - 0.035, 0), (0.13, 0.016, 0.013), colours.detail)
        parts += [blade, slab((end - 0.06, axis - 0.045), (end - 0.02, axis), 0.014, colours.dark)]
    if p.choice("bipod", ("none", "none", "bipod")) == "bipod":
        drop, place = p.uniform("bipod_height", 0.12, 0.2), end - 0.12
        parts += pair(bar((place + 0.02, axis - drop, 0.4 * drop), (place, axis, 0.005), 0.026, 0.026, colours.dark))
    return parts
