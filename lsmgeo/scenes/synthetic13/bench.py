"""Benches.

Structures: a support (four legs, end panels, crossed legs, blocks, sled, centre beam, picnic table), a seat (plank,
slats, upholstered) and, where they apply, a back (none, plank, slats, bars, frame) and arms (none, ends, ends and
middle).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Point, bar, block, pair, rack, slab, spaced, window

__all__ = ["build"]


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one bench; it is long along z."""
    support = p.choice(
        "support", ("four legs", "end panels", "crossed legs", "blocks", "sled", "centre beam", "picnic table")
    )
    seat = p.choice("seat", ("plank", "slats", "upholstered"))
    length, depth = p.uniform("length", 0.9, 2.4), p.uniform("depth", 0.32, 0.6)
    height, thickness = p.uniform("height", 0.35, 0.6), p.uniform("seat_thickness", 0.05, 0.14)
    width, inset = p.uniform("leg_width", 0.05, 0.12), p.uniform("leg_inset", 0.03, 0.25)
    x, z = depth / 2, length / 2
    side = z * (1 - inset)
    if support == "picnic table":
        return _picnic_table(p, colours, height, depth, z, side)

    parts = _seat(p, seat, colours, (-x, height - thickness, -z), (x, height, z))
    # The slats are the upper half of their seat.
    parts += _support(p, support, colours, height - thickness * (0.5 if seat == "slats" else 1.0), x, side, width)
    drop = p.uniform("beam_height", 0.03, 0.1)
    parts.append(slab((-0.2 * x, height - thickness - drop), (0.2 * x, height - 0.4 * thickness), side, colours.trim))
    back = p.choice("back", ("none", "plank", "slats", "bars", "frame"))
    if back == "none":
        return parts
    lean = p.uniform("back_lean", 0, 18)
    parts += [
        part.rotated(2, lean, (-x, height, 0)) for part in _back(p, back, colours, height - 0.9 * thickness, x, z)
    ]
    arms = p.choice("arms", ("none", "ends", "ends and middle"))
    rise = p.uniform("arm_height", 0.16, 0.26)
    places = {"none": (), "ends": (-z + 0.04, z - 0.04), "ends and middle": (-z + 0.04, 0.0, z - 0.04)}[arms]
    for place in places:
        rest = (-x - 0.04, height + rise - 0.05, place - 0.04), (x, height + rise, place + 0.04)
        post = (x - 0.08, height - 0.5 * thickness, place - 0.03), (x - 0.02, height + rise, place + 0.03)
        parts += [block(*rest, colours.trim), block(*post, colours.trim)]
    return parts


def _seat(p: Parameters, seat: str, colours: Palette, low: Point, high: Point) -> list[Solid]:
    if seat == "slats":
        bearers = [
            block((low[0], low[1], place - 0.04), (high[0], 0.4 * low[1] + 0.6 * high[1], place + 0.04), colours.trim)
            for place in (0.6 * low[2], 0.0, 0.6 * high[2])
        ]
        top = (low[0], 0.5 * low[1] + 0.5 * high[1], low[2])
        return bearers + rack(top, high, 0, p.count("seat_slats", 3, 5), colours.body, 0.68)
    plank = block(low, high, colours.body)
    if seat == "plank":
        return [plank]
    count = p.count("cushions", 1, 3)
    size = (0.47 * (high[0] - low[0]), 0.07, 0.49 * (high[2] - low[2]) / count)
    return [plank, *(ellipsoid((0, high[1], place), size, colours.trim) for place in spaced(low[2], high[2], count))]


def _support(
    p: Parameters, support: str, colours: Palette, top: float, x: float, side: float, width: float
) -> list[Solid]:
    """The support of the seat, from y = 0 to ``top``."""
    up, material = top + 0.02, colours.trim
    if support == "four legs":
        out = p.uniform("leg_spread", 0.0, 0.12)
        near = x - width / 2
        legs = [
            bar((s * (near + 0.3 * out), 0, side + out), (s * near, up, side), width, width, material) for s in (-1, 1)
        ]
        rail = box((0, top - 0.05, 0), (0.06, 0.1, 2 * side), material)
        return [*pair(*legs), rail, *pair(box((0, top - 0.05, side), (2 * near, 0.08, 0.06), material))]
    if support == "end panels":
        shrink = p.uniform("panel_depth", 0.6, 1.0) * x
        panel = block((-shrink, 0, side - width), (shrink, up, side), material)
        return [*pair(panel), box((0, 0.35 * top, 0), (0.07, 0.1, 2 * side - width), material)]
    if support == "crossed legs":
        reach = p.uniform("cross_reach", 0.9, 1.3) * x
        cross = [bar((s * reach, 0, side), (-s * 0.8 * x, up, side), width, width, material) for s in (-1, 1)]
        return [*pair(*cross), box((0, 0.5 * top, 0), (0.06, 0.06, 2 * side), material)]
    if support == "blocks":
        thick = p.uniform("block_length", 0.15, 0.35)
        return pair(block((-0.85 * x, 0, side - thick), (0.85 * x, up, side), material))
    if support == "sled":
        reach = p.uniform("sled_reach", 0.8, 1.1) * x
        return pair(*window((-reach, 0, side - width), (reach, up, side), 2, 0.7 * width, material))
    foot = p.uniform("foot_reach", 0.8, 1.1) * x
    post = block((-width, 0, 0.6 * side - width), (width, up, 0.6 * side + width), material)
    return [
        *pair(post, box((0, 0.03, 0.6 * side), (2 * foot, 0.06, 2 * width), material)),
        box((0, top - 0.06, 0), (2 * width, 0.12, 1.9 * side), material),
    ]


def _back(p: Parameters, back: str, colours: Palette, low: float, x: float, z: float) -> list[Solid]:
    tall, thick = p.uniform("back_height", 0.35, 0.65), p.uniform("back_thickness", 0.05, 0.1)
    top = low + tall
    posts = [
        block((-x, low, place - 0.04), (-x + 0.8 * thick, top, place + 0.04), colours.trim)
        for place in (-z + 0.04, 0.0, z - 0.04)
    ]
    if back == "plank":
        return [slab((-x, low), (-x + thick, top), z, colours.body)]
    if back == "slats":
        count = p.count("back_slats", 2, 4)
        return posts + rack((-x, low + 0.25 * tall, -z), (-x + thick, top, z), 1, count, colours.body, 0.65)
    rails = [slab((-x, y - 0.05), (-x + thick, y), z, colours.trim) for y in (low + 0.22 * tall, top)]
    if back == "bars":
        start, end, count = (-x + 0.1 * thick, low, -z), (-x + 0.7 * thick, top, z), p.count("bars", 7, 12)
        return rails + posts + rack(start, end, 2, count, colours.body, 0.35)
    crossed = []
    for s in (-0.95, -0.05, 0.05, 0.95):
        start, end = (0, low + 0.2 * tall, s * 0.9 * z), (0, top - 0.03, (s - 0.9 * (1 if s > 0 else -1)) * z)
        crossed.append(bar(start, end, 0.06, 0.08, colours.body).moved((-x + 0.4 * thick, 0, 0)))
    return rails + posts + crossed


def _picnic_table(p: Parameters, colours: Palette, height: float, depth: float, z: float, side: float) -> list[Solid]:
    top, out = height + p.uniform("table_rise", 0.2, 0.4), p.uniform("bench_distance", 0.5, 0.75)
    table = p.uniform("table_depth", 0.25, 0.42)
    width = 0.06
    parts = rack((-table, top - 0.07, -z), (table, top, z), 0, p.count("boards", 2, 4), colours.body, 0.9)
    for s in (-1, 1):
        low, high = sorted((s * out, s * (out + 0.6 * depth)))
        parts += _seat(p, "plank", colours, (low, height - 0.07, -z), (high, height, z))
    place = 0.75 * side
    ends = (((s * (out + 0.25 * depth), 0, place), (s * 0.6 * table, top - 0.04, place)) for s in (-1, 1))
    legs = [bar(foot, head, 1.5 * width, width, colours.trim) for foot, head in ends]
    beam = box((0, height - 0.1, place), (2 * out + depth, 0.1, width), colours.trim)
    head = box((0, top - 0.1, place), (1.9 * table, 0.08, width), colours.trim)
    return parts + pair(*legs, beam, head) + [box((0, height - 0.1, 0), (0.08, 0.08, 2 * place), colours.trim)]
