"""Tables.

Structures: a top (rectangular, round, oval, clipped corners), a base (four legs, splayed legs, column, star, trestle,
panels, sled, drum, desk with drawers at one or both ends), an edge (plain, rim) and, where they apply, a form of leg,
what is below the top (nothing, apron, shelf, drawer, stretcher), a taper.
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Material, Solid, box, cone, half_space, sphere
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import bar, block, pair, pillar, slab, spokes, window

__all__ = ["build"]


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one table, in metres; it is long along z."""
    top = p.choice("top", ("rectangular", "rectangular", "round", "oval", "clipped"))
    base = p.choice(
        "base", ("four legs", "splayed legs", "column", "star", "trestle", "panels", "sled", "drum", "desk")
    )
    if base == "desk":
        top = "rectangular"
    height, depth = p.uniform("height", 0.35, 0.95), p.uniform("depth", 0.55, 1.2)
    length = depth * (
        p.uniform("length", 1.0, 2.4) if top in ("rectangular", "oval") else p.uniform("length", 0.9, 1.1)
    )
    thickness, width = p.uniform("thickness", 0.03, 0.1), p.uniform("leg_width", 0.05, 0.13)
    inset = p.uniform("inset", 0.02, 0.2)
    x, z, floor = depth / 2, length / 2, height - thickness
    parts = _top(top, colours, floor, height, x, z)
    under, size = p.uniform("subtop_height", 0.015, 0.045), p.uniform("subtop_size", 0.55, 0.85)
    parts += [
        part.painted(colours.detail) for part in _top(top, colours, floor - under, floor + 0.01, size * x, size * z)
    ]
    # Legs stay within a round top.
    share = (1 - inset) * (1.0 if top == "rectangular" else 0.68)
    near, side = share * x - width / 2, share * z - width / 2
    parts += _base(p, base, colours, floor, near, side, width)
    if base in ("four legs", "splayed legs", "desk"):
        parts += _below(p, base, colours, floor, near, side, width)
    if p.choice("edge", ("plain", "rim", "plain")) == "rim":
        drop = p.uniform("rim", 0.03, 0.08)
        rim = (
            _top(top, colours, floor - drop, floor + 0.01, 0.9 * x, 0.9 * z)
            if top != "rectangular"
            else window((-x, floor - drop, -z), (x, floor + 0.01, z), 1, 0.04, colours.trim)
        )
        parts += [part.painted(colours.trim) for part in rim]
    return parts


def _top(top: str, colours: Palette, floor: float, height: float, x: float, z: float) -> list[Solid]:
    if top == "rectangular":
        return [slab((-x, floor), (x, height), z, colours.body)]
    if top == "clipped":
        corners = (half_space((0.6 * x, 0, s * z), (-z, 0, -s * x)) for s in (-1, 1))
        return [slab((-x, floor), (x, height), z, colours.body).minus(*corners)]
    return [pillar((0, floor, 0), height, 1.0, colours.body).scaled((x, 1, z))]


def _base(
    p: Parameters, base: str, colours: Palette, floor: float, near: float, side: float, width: float
) -> list[Solid]:
    """The support of the top, from y = 0 to ``floor``."""
    up, material = floor + 0.02, colours.trim
    if base in ("four legs", "splayed legs"):
        return _legs(p, base, material, up, near, side, width)
    if base in ("column", "star"):
        return _column(p, base, colours, floor, near, side, width)
    if base == "trestle":
        reach, place = p.uniform("trestle_reach", 0.7, 1.1) * near, 0.85 * side
        cross = [
            bar((s * reach, 0, place), (-s * 0.8 * near, up, place), width, 0.8 * width, material) for s in (-1, 1)
        ]
        return [*pair(*cross), box((0, 0.5 * floor, 0), (width, width, 2 * place), colours.detail)]
    if base == "panels":
        shrink = p.uniform("panel_depth", 0.6, 1.0) * near
        panel = block((-shrink, 0, side - 0.02), (shrink, up, side + 0.5 * width), material)
        height = p.uniform("beam_height", 0.3, 0.8) * floor
        return [*pair(panel), box((0, height, 0), (0.05, 0.15 * floor, 2 * side), colours.detail)]
    if base == "sled":
        height = p.uniform("rail_height", 0.3, 0.8) * floor
        rail = box((0, height, 0), (0.05, p.uniform("rail_width", 0.04, 0.1), 2 * side), colours.detail)
        posts = pair(block((-0.03, 0, side - width / 3), (0.03, up, side + width / 3), material))
        frame = window((-near, 0, side - width / 2), (near, up, side + width / 2), 2, 0.8 * width, material)
        return [*pair(*frame), rail, *posts]
    if base == "drum":
        wide, waist = p.uniform("drum_radius", 0.5, 0.9), p.uniform("drum_taper", 0.4, 1.0)
        scale = (wide * near, 1.0, wide * side)
        start, end = (0.0, up) if p.choice("taper", ("up", "down")) == "up" else (up, 0.0)
        return [pillar((0, start, 0), end, 1.0, material, waist).scaled(scale)]
    return _desk(p, colours, floor, near, side, width)


def _legs(
    p: Parameters, base: str, material: Material, up: float, near: float, side: float, width: float
) -> list[Solid]:
    """Four legs, straight or splayed."""
    form = p.choice("leg", ("square", "round", "tapered"))
    out = p.uniform("leg_spread", 0.06, 0.2) if base == "splayed legs" else 0.0
    ends = [((s * (near + out / 2), 0, side + out / 2), (s * (near - out / 2), up, side - out / 2)) for s in (-1, 1)]
    if form == "square":
        return pair(*(bar(foot, head, width, width, material) for foot, head in ends))
    narrow = p.uniform("leg_taper", 0.35, 0.7) if form == "tapered" else 1.0
    return pair(*(cone(head, foot, 0.55 * width, max(0.55 * narrow * width, 0.022), material) for foot, head in ends))


def _column(
    p: Parameters, base: str, colours: Palette, floor: float, near: float, side: float, width: float
) -> list[Solid]:
    """A column on a round foot, or on the feet of a star."""
    material = colours.trim
    post, reach = p.uniform("column_radius", 0.035, 0.1), p.uniform("foot_reach", 0.5, 0.85) * min(near, side)
    column = pillar((0, 0.02, 0), floor + 0.02, post, material)
    collar = pillar((0, floor - 0.1, 0), floor + 0.02, post, colours.detail, min(2.5 * post, 0.9 * near))
    if base == "column":
        foot = pillar((0, 0, 0), 0.05, reach + post, material)
        return [column, collar, foot, pillar((0, 0.04, 0), 0.2 * floor, 0.6 * reach + post, material, post)]
    hub, drop, count = (0, 0.3 * floor, 0), 0.3 * floor - 0.03, p.count("feet", 3, 5)
    return [column, collar, *spokes(hub, reach + post, drop, count, min(width, 0.08), material, turn=45)]


def _desk(p: Parameters, colours: Palette, floor: float, near: float, side: float, width: float) -> list[Solid]:
    """Drawers below one or both ends, legs below the other."""
    up, material = floor + 0.02, colours.trim
    under = p.choice("pedestals", ("both", "left", "right"))
    wide, lift = p.uniform("pedestal_width", 0.25, 0.42) * side, p.uniform("pedestal_clearance", 0.0, 0.12)
    parts: list[Solid] = []
    for s in (-1, 1):
        if under != "both" and (under == "left") != (s > 0):
            parts += [bar((t * near, 0, s * side), (t * near, up, s * side), width, width, material) for t in (-1, 1)]
            continue
        inner, outer = sorted((s * side, s * (side - 2 * wide)))
        parts.append(block((-near, lift, inner), (near, up, outer), material))
        rows = 3
        for row in range(rows):
            low, tall = lift + 0.02 + row * (floor - lift) / rows, (floor - lift) / rows - 0.04
            front = (near - 0.01, low, inner + 0.03), (near + 0.02, low + tall, outer - 0.03)
            parts.append(block(*front, colours.body))
            parts.append(sphere((near + 0.03, low + tall / 2, (inner + outer) / 2), 0.02, colours.detail))
        if lift > 0.03:
            for x in (0.05 - near, near - 0.05):
                feet = (x - 0.025, 0, inner + 0.02), (x + 0.025, lift + 0.01, outer - 0.02)
                parts.append(block(*feet, colours.detail))
    return parts


def _below(
    p: Parameters, base: str, colours: Palette, floor: float, near: float, side: float, width: float
) -> list[Solid]:
    """The connection of the legs."""
    if base == "desk":
        return [slab((-near, floor - 0.35 * floor), (-near + 0.035, floor + 0.01), side, colours.detail)]
    form = p.choice("below", ("nothing", "apron", "shelf", "drawer", "stretcher"))
    drop = p.uniform("apron", 0.06, 0.16) if form in ("apron", "drawer") else 0.0
    if form == "apron":
        return window((-near, floor - drop, -side), (near, floor + 0.01, side), 1, 0.04, colours.detail)
    if form == "shelf" and base == "four legs":
        level = p.uniform("shelf_height", 0.15, 0.5) * floor
        return [slab((-near - width / 4, level), (near + width / 4, level + 0.045), side + width / 4, colours.body)]
    if form == "drawer":
        wide = p.uniform("drawer_width", 0.4, 0.9) * side
        case = slab((-near, floor - drop), (near, floor + 0.01), wide, colours.trim)
        return [
            case,
            slab((near - 0.01, floor - drop + 0.015), (near + 0.02, floor - 0.01), 0.92 * wide, colours.body),
            sphere((near + 0.03, floor - drop / 2, 0), 0.025, colours.detail),
        ]
    if form == "stretcher" and base == "four legs":
        level = p.uniform("stretcher_height", 0.1, 0.4) * floor
        ends = pair(box((0, level, side), (2 * near, 0.05, 0.05), colours.trim))
        return [*ends, box((0, level, 0), (0.05, 0.05, 2 * side), colours.trim)]
    return []
