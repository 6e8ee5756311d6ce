"""Chairs.

Structures: a base (four legs, splayed legs, pedestal, star foot, sled, side panels), a seat (square, round,
cushioned), a back (solid, vertical slats, horizontal slats, round, frame, none) and arms (none, rails, panels).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import bar, block, pair, pillar, rack, rod, slab, spokes, window

__all__ = ["build"]


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one chair, about 1 high."""
    base = p.choice("base", ("four legs", "four legs", "splayed legs", "pedestal", "star", "sled", "side panels"))
    back = p.choice("back", ("solid", "vertical slats", "horizontal slats", "round", "solid", "frame", "none"))
    # A square stool would look like a table.
    seat = p.choice("seat", ("square", "round", "cushioned") if back != "none" else ("round", "cushioned"))
    arms = p.choice("arms", ("none", "rails", "panels")) if back != "none" else "none"
    height = p.uniform("seat_height", 0.3, 0.75)
    width, depth = p.uniform("seat_width", 0.38, 0.7), p.uniform("seat_depth", 0.36, 0.62)
    if back == "none":
        width, depth = 0.7 * width, 0.7 * depth
    thickness = p.uniform("seat_thickness", 0.04, 0.14)
    x, z, floor = depth / 2, width / 2, height - thickness

    # Under a round seat the legs are closer to the middle, so that they meet it.
    inset = 0.72 if seat == "round" else 1.0
    parts = _base(p, base, colours, floor, inset * x, inset * z)
    if seat == "round":
        disc = pillar((0, floor, 0), height, 1.0, colours.body)
        parts.append(disc.scaled((x, 1, z)))
        if back != "none":
            parts.append(slab((-x, floor), (0, height), z, colours.body))
    else:
        parts.append(slab((-x, floor), (x, height), z, colours.body))
    if seat == "cushioned":
        parts.append(ellipsoid((0, height, 0), (0.95 * x, thickness * 0.9, 0.95 * z), colours.trim))
    under, share = p.uniform("apron_height", 0.02, 0.07), p.uniform("apron_size", 0.5, 0.9) * inset
    parts.append(slab((-share * x, floor - under), (share * x, floor + 0.01), share * z, colours.trim))
    if back != "none":
        lean = p.uniform("back_lean", 0, 22)
        parts += [part.rotated(2, lean, (-x, height, 0)) for part in _back(p, back, colours, height, x, z)]
    if arms != "none":
        parts += _arms(p, arms, colours, height, x, z)
    return parts


def _base(p: Parameters, base: str, colours: Palette, floor: float, x: float, z: float) -> list[Solid]:
    """The support of the seat, from y = 0 to ``floor``."""
    width = p.uniform("leg_width", 0.035, 0.08)
    top, ground = floor + 0.02, colours.trim
    if base in ("four legs", "splayed legs"):
        out = p.uniform("leg_spread", 0.08, 0.22) if base == "splayed legs" else 0.0
        corners = ((x - width / 2, z - width / 2), (-x + width / 2, z - width / 2))
        legs = [
            bar((a + out * (1 if a > 0 else -1), 0, b + out), (a, top, b), width, width, ground) for a, b in corners
        ]
        rung = p.uniform("rung_height", 0.15, 0.7) * floor
        spread = 1 + out * (1 - rung / top) / (x - width / 2)
        end, side = spread * (x - width / 2), z - width / 2 + out * (1 - rung / top)
        return pair(*legs, block((-end, rung - 0.02, side - 0.02), (end, rung + 0.02, side + 0.02), ground))
    if base == "pedestal":
        foot = p.uniform("foot_radius", 0.18, 0.34)
        disc, post = pillar((0, 0, 0), 0.04, foot, ground), pillar((0, 0.02, 0), top, 0.7 * width, ground)
        return [disc, pillar((0, 0.03, 0), 0.3 * floor, 0.6 * foot, ground, 0.5 * width), post]
    if base == "star":
        reach, arms = p.uniform("star_reach", 0.24, 0.36), p.count("star_arms", 4, 6)
        wheels = [part.moved((0, -0.045, 0)) for part in spokes((0, 0.12, 0), reach, 0.06, arms, width, ground)]
        post = pillar((0, 0.05, 0), top, 0.7 * width, colours.detail)
        return [*wheels, post, pillar((0, 0.45 * floor, 0), top, 1.1 * width, ground)]
    if base == "sled":
        inset = p.uniform("sled_inset", 0.0, 0.25) * x
        front, rear, side = x - inset, -x + inset, z - width / 2
        sides = window((rear, 0, side - width / 2), (front, top, side + width / 2), 2, width, ground)
        return pair(*sides[:3], sides[3])
    inset = p.uniform("panel_inset", 0.0, 0.15)
    panel = block((-x + inset * x, 0, z - width), (x - inset * x, top, z), ground)
    rail = box((0, 0.6 * floor, 0), (width, 0.2 * floor, 2 * z - width), ground)
    return [*pair(panel), rail]


def _back(p: Parameters, back: str, colours: Palette, height: float, x: float, z: float) -> list[Solid]:
    """The upright back above the seat's rear edge."""
    tall, thick = p.uniform("back_height", 0.3, 0.75), p.uniform("back_thickness", 0.035, 0.09)
    narrow = p.uniform("back_width", 0.7, 1.0) * z
    low, top = height - 0.03, height + tall
    start, end = (-x, low, -narrow), (-x + thick, top, narrow)
    if back == "solid":
        return [block(start, end, colours.body)]
    if back == "round":
        middle = height + 0.5 * tall
        disc = rod((-x, 0, 0), -x + thick, 1.0, colours.body).scaled((1, 0.55 * tall, narrow))
        post = block((-x, low, 0.4 * narrow), (-x + 0.7 * thick, middle, 0.4 * narrow + 0.05), colours.trim)
        return [disc.moved((0, middle, 0)), *pair(post)]
    width = p.uniform("stile_width", 0.035, 0.07)
    stiles = pair(block((-x, low, narrow - width), (-x + thick, top, narrow), colours.trim))
    inside, head = narrow - width / 2, block((-x, top - 2 * width, -narrow), end, colours.trim)
    if back == "vertical slats":
        start, end = (-x + 0.2 * thick, low, -inside), (-x + 0.8 * thick, top - width, inside)
        return [*stiles, head, *rack(start, end, 2, p.count("slats", 3, 5), colours.body)]
    if back == "horizontal slats":
        start, end = (-x, height + 0.2 * tall, -inside), (-x + 0.8 * thick, top, inside)
        return stiles + rack(start, end, 1, p.count("slats", 2, 4), colours.body, 0.6)
    low_rail = slab((-x, height + 0.25 * tall), (-x + thick, height + 0.25 * tall + width), narrow, colours.trim)
    pad = slab((-x + 0.2 * thick, height + 0.45 * tall), (-x + 0.9 * thick, top - 0.1 * tall), inside, colours.body)
    return [*stiles, head, low_rail, pad]


def _arms(p: Parameters, arms: str, colours: Palette, height: float, x: float, z: float) -> list[Solid]:
    """Arm rests on both sides, from the back to near the front edge."""
    rise, length = p.uniform("arm_height", 0.15, 0.28), p.uniform("arm_length", 0.75, 1.0) * 2 * x
    width = p.uniform("arm_width", 0.04, 0.08)
    if arms == "panels":
        return pair(block((-x, height - 0.1, z - 0.01), (-x + length, height + rise, z + width), colours.trim))
    rest = block(
        (-x - 0.05, height + rise - 0.04, z - 0.5 * width), (-x + length, height + rise, z + width), colours.trim
    )
    post = block((-x + length - 0.05, height - 0.05, z - 0.02), (-x + length, height + rise, z + 0.03), colours.trim)
    rear = block((-x, height - 0.05, z - 0.02), (-x + 0.05, height + rise, z + 0.03), colours.trim)
    return pair(rest, post, rear)
