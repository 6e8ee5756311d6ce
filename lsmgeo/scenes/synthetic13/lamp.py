"""Lamps.

Structures: a kind (table, floor, arc, desk, pendant, chandelier, tripod, wall, lantern), a shade (cone, drum, globe,
dome, bowl, stack) and, where they apply, a foot (disc, cone, block, ball), a body (pole, vase, balls, blocks, bottle)
and a post (post, short, hung).
"""

from __future__ import annotations

import numpy as np

from lsmgeo.scenes.primitives import Solid, box, cylinder, ellipsoid, half_space, sphere
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Point, pillar, ring, slab, spokes, tube

__all__ = ["build"]

KINDS = ("table", "table", "floor", "arc", "desk", "pendant", "chandelier", "tripod", "wall", "lantern")


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one lamp, about 1 high."""
    kind = p.choice("kind", KINDS)
    shade = (
        p.choice("shade", ("cone", "drum", "globe", "dome", "bowl", "stack"))
        if kind not in ("desk", "lantern")
        else "dome"
    )
    radius, tall = p.uniform("shade_radius", 0.14, 0.3), p.uniform("shade_height", 0.16, 0.34)
    rod = p.uniform("rod_radius", 0.016, 0.03) if kind != "lantern" else 0.018
    if kind == "pendant":
        return _pendant(p, shade, colours, radius, tall, rod)
    if kind == "wall":
        return _wall_lamp(p, shade, colours, radius, tall, rod)
    if kind == "lantern":
        return _lantern(p, colours, radius, tall, rod)
    height = p.uniform("height", 0.7, 1.1)
    if kind == "chandelier":
        return _chandelier(p, shade, colours, radius, tall, rod, height)
    if kind == "desk":
        return _desk(p, colours, radius, rod, height)
    foot = p.uniform("foot_radius", 0.12, 0.22) if kind != "tripod" else 0.0
    if kind == "arc":
        reach = p.uniform("reach", 0.35, 0.7)
        angles = np.linspace(np.pi, 0.08 * np.pi, 6)
        bend = [(reach / 2 * (1 + np.cos(a)) - reach, height + 0.4 * reach * np.sin(a), 0) for a in angles]
        end = bend[-1]
        rods = ring([(-reach, 0, 0), *bend, (end[0] + 0.01, end[1] - 0.1, 0)], rod, colours.trim)
        hung = _shade(p, shade, colours, (end[0] + 0.01, end[1] - 0.05 - tall, 0), radius, tall)
        stem = pillar((end[0] + 0.01, end[1] - 0.05 - 0.6 * tall, 0), end[1] - 0.04, rod, colours.trim)
        return [*_foot(p, colours, foot, (-reach, 0, 0)), *rods, *hung, stem]
    top = height * (1.35 if kind in ("floor", "tripod") else 0.55)
    if kind == "table":
        radius = max(radius, 1.2 * foot)
    lamp = _shade(p, shade, colours, (0, top - 0.15 * tall, 0), radius, tall)
    if kind == "tripod":
        reach, hub = p.uniform("leg_reach", 0.2, 0.38), p.uniform("hub_height", 0.8, 0.94) * top
        thick, wide = p.uniform("leg_width", 0.03, 0.06), p.uniform("hub_radius", 0.03, 0.06)
        legs = spokes((0, hub, 0), reach, hub, 3, thick, colours.trim, turn=30)
        legs.append(pillar((0, hub - 0.05, 0), hub + 0.03, wide, colours.detail))
        return [*lamp, *legs, pillar((0, hub - 0.03, 0), top + 0.67 * tall, 1.4 * rod, colours.detail)]
    stem = pillar((0, 0, 0), top + 0.67 * tall, rod, colours.detail)
    knot = p.uniform("knot", 0.25, 0.8) * (top - 0.15 * tall)
    lamp.append(sphere((0, knot, 0), p.uniform("knot_radius", 1.4, 2.4) * rod, colours.detail))
    parts = [*lamp, stem, *_foot(p, colours, foot, (0, 0, 0))]
    if kind == "table":
        parts += _body(p, colours, 0.6 * foot + 0.03, 0.03, top - 0.4 * tall)
    return parts


def _pendant(p: Parameters, shade: str, colours: Palette, radius: float, tall: float, rod: float) -> list[Solid]:
    """A shade on a cord below a canopy."""
    drop, socket = p.uniform("cord", 0.2, 0.6), p.uniform("socket", 0.03, 0.06)
    wide, high = p.uniform("canopy_radius", 0.07, 0.14), p.uniform("canopy_height", 0.04, 0.1)
    top = drop + tall
    return [
        *_shade(p, shade, colours, (0, 0, 0), radius, tall),
        pillar((0, 0.5 * tall, 0), top + 0.01, 0.8 * rod, colours.detail),
        pillar((0, 0.8 * tall, 0), tall + 0.05, socket, colours.trim),
        pillar((0, top, 0), top + high, 0.5 * wide, colours.trim, wide),
    ]


def _wall_lamp(p: Parameters, shade: str, colours: Palette, radius: float, tall: float, rod: float) -> list[Solid]:
    """A small shade on an arm from a plate on the wall."""
    reach, rise = p.uniform("arm_reach", 0.2, 0.4), p.uniform("plate_height", 0.2, 0.4)
    sag, wide = p.uniform("arm_sag", 0.05, 0.16), p.uniform("plate_width", 0.1, 0.22)
    plate = box((-reach, -0.05, 0), (0.04, rise, wide), colours.trim)
    bend = [(-reach, -0.1, 0), (-0.3 * reach, -0.1 - 0.5 * sag, 0), (0, -0.06, 0), (0, 0.49 * tall, 0)]
    return [plate, *ring(bend, rod, colours.detail), *_shade(p, shade, colours, (0, 0, 0), 0.6 * radius, 0.6 * tall)]


def _shade(p: Parameters, shade: str, colours: Palette, base: Point, radius: float, tall: float) -> list[Solid]:
    """A shade whose lower rim is centred at ``base``, on a cross bar that joins it to the rod."""
    x, y, z = base
    bottom, top = (x, y, z), (x, y + tall, z)
    if shade == "globe":
        squash = p.uniform("squash", 0.75, 1.05) * radius
        return [ellipsoid((x, y + squash, z), (radius, squash, radius), colours.body)]
    if shade in ("cone", "drum"):
        end = p.uniform("shade_top", 0.35, 0.75) if shade == "cone" else p.uniform("shade_top", 0.88, 1.0)
        # A plate closes the shade near its top.
        level, reach = y + 0.8 * tall, radius * (0.2 + 0.8 * end) - 0.012
        plate = pillar((x, level, z), level + 0.03, reach, colours.trim)
        return [tube(bottom, top, radius, end * radius, min(0.035, 0.6 * end * radius), colours.body), plate]
    if shade == "stack":
        step = p.uniform("stack_step", 0.12, 0.26)
        rings = ((y + tall * (0.15 + 0.3 * k), radius * (1 - step * k)) for k in range(3))
        return [ellipsoid((x, level, z), (size, 0.2 * tall, size), colours.body) for level, size in rings]
    inner = ellipsoid((x, y - 0.03, z), (radius - 0.03, tall - 0.02, radius - 0.03))
    dome = ellipsoid((x, y, z), (radius, tall, radius), colours.body).minus(inner, half_space((x, y, z), (0, 1, 0)))
    bulb = sphere((x, y + 0.25 * tall, z), p.uniform("bulb", 0.22, 0.45) * radius, colours.trim)
    holder = pillar((x, y + 0.25 * tall, z), y + 0.9 * tall, 0.03, colours.trim)
    if shade == "bowl":
        return [part.scaled((1, -1, 1), (x, y + tall / 2, z)) for part in (dome, bulb, holder)]
    return [dome, bulb, holder]


def _foot(p: Parameters, colours: Palette, radius: float, at: Point) -> list[Solid]:
    form, thick = p.choice("foot", ("disc", "cone", "block", "ball")), p.uniform("foot_height", 0.03, 0.07)
    x, _, z = at
    if form == "disc":
        return [pillar((x, 0, z), thick, radius, colours.trim)]
    if form == "cone":
        return [pillar((x, 0, z), 3 * thick, radius, colours.trim, 0.2 * radius)]
    if form == "block":
        return [box((x, thick / 2, z), (1.8 * radius, thick, 1.8 * radius), colours.trim)]
    return [ellipsoid((x, 0, z), (radius, 2 * thick, radius), colours.trim).minus(half_space((x, 0, z), (0, 1, 0)))]


def _body(p: Parameters, colours: Palette, radius: float, low: float, high: float) -> list[Solid]:
    """The thick part of a table lamp between its foot and its shade."""
    form = p.choice("body", ("pole", "vase", "balls", "blocks", "bottle"))
    tall = high - low
    if form == "pole":
        return []
    if form == "vase":
        return [
            ellipsoid((0, low + 0.45 * tall, 0), (radius, 0.5 * tall, radius), colours.trim),
            pillar((0, low + 0.7 * tall, 0), high, 0.3 * radius, colours.trim, 0.6 * radius),
        ]
    if form == "bottle":
        return [
            pillar((0, low - 0.02, 0), low + 0.6 * tall, radius, colours.trim),
            pillar((0, low + 0.6 * tall - 0.001, 0), high, radius, colours.trim, 0.25 * radius),
        ]
    count = p.count("pieces", 2, 4)
    step = tall / count
    if form == "balls":
        return [
            ellipsoid((0, low + (k + 0.5) * step, 0), (radius, 0.55 * step, radius), colours.trim) for k in range(count)
        ]
    return [
        box((0, low + (k + 0.5) * step, 0), (1.5 * radius, 0.96 * step, 1.5 * radius), colours.trim).rotated(1, 25 * k)
        for k in range(count)
    ]


def _desk(p: Parameters, colours: Palette, radius: float, rod: float, height: float) -> list[Solid]:
    """A foot, two arms with a joint between them and a tilted shade."""
    foot, lean = p.uniform("foot_radius", 0.12, 0.2), p.uniform("lower_lean", 5, 35)
    reach, bend = p.uniform("upper_length", 0.4, 0.65), p.uniform("upper_angle", -15, 35)
    first, second = np.deg2rad(lean), np.deg2rad(bend)
    elbow = np.array([-0.55 * height * np.sin(first), 0.55 * height * np.cos(first), 0])
    end = elbow + reach * np.array([np.cos(second), np.sin(second), 0])
    size, narrow = 0.7 * radius, p.uniform("shade_top", 0.15, 0.3)
    head = tube((0, -1.3 * size, 0), (0, 0.1, 0), size, narrow * size + 0.04, 0.035, colours.body)
    cap = pillar((0, 0.03, 0), 0.12, narrow * size + 0.05, colours.body)
    bulb = sphere((0, -0.5 * size, 0), 0.35 * size, colours.detail)
    stem = pillar((0, -0.5 * size, 0), 0.05, 0.03, colours.detail)
    tilt = p.uniform("head_tilt", 5, 40)
    return [
        *_foot(p, colours, foot, (0, 0, 0)),
        *ring([(0, 0, 0), elbow, end], rod, colours.trim),
        sphere(elbow, 1.9 * rod, colours.detail),
        *(part.rotated(2, tilt).moved(end) for part in (head, cap, bulb, stem)),
    ]


def _chandelier(
    p: Parameters, shade: str, colours: Palette, radius: float, tall: float, rod: float, height: float
) -> list[Solid]:
    """Curved arms around a stem, a small shade or candle on each."""
    arms, reach = p.count("arms", 3, 6), p.uniform("reach", 0.3, 0.5)
    dip = p.uniform("dip", 0.06, 0.16)
    parts = [
        pillar((0, -dip, 0), 0.7 * height, 1.2 * rod, colours.trim),
        ellipsoid((0, 0, 0), (0.07, p.uniform("hub_height", 0.06, 0.13), 0.07), colours.trim),
        pillar((0, 0.7 * height - 0.04, 0), 0.7 * height + 0.01, 0.05, colours.trim, 0.1),
        sphere((0, -dip, 0), p.uniform("finial", 0.03, 0.06), colours.detail),
    ]
    candle = shade in ("globe", "stack", "bowl")
    narrow = p.uniform("shade_top", 0.35, 0.75) if not candle else 1.0
    for angle in 360 * np.arange(arms) / arms:
        arm = ring([(0, 0, 0), (0.55 * reach, -dip, 0), (reach, 0.02, 0)], 0.8 * rod, colours.trim)
        if candle:
            arm += [
                pillar((reach, 0, 0), 0.6 * tall, 0.03, colours.body),
                ellipsoid((reach, 0.6 * tall + 0.04, 0), (0.03, 0.06, 0.03), colours.detail),
            ]
        else:
            arm += [pillar((reach, 0, 0), 0.6 * tall, 0.45 * radius, colours.body, 0.45 * narrow * radius)]
        parts += [part.rotated(1, float(angle)) for part in arm]
    return parts


def _lantern(p: Parameters, colours: Palette, radius: float, tall: float, rod: float) -> list[Solid]:
    """A street lantern: a post, a glass body between four bars, a roof."""
    wide, flare = 0.75 * radius, p.uniform("flare", 0.6, 1.0)
    peak, eaves = p.uniform("roof", 0.3, 0.6), p.uniform("eaves", 1.1, 1.5)
    size = tall
    stands = p.choice("post", ("post", "short", "hung"))
    low, most = {"post": (0.7, 1.1), "short": (0.1, 0.25), "hung": (0.02, 0.05)}[stands]
    top = p.uniform("height", low, most)
    parts = [
        pillar((0, top, 0), top + size, flare * wide * 0.85, colours.body, wide * 0.85),
        pillar((0, top - 0.02, 0), top + 0.02, flare * wide * 1.05, colours.trim),
        pillar((0, top + size, 0), top + (1 + peak) * size, eaves * wide, colours.trim, 0.15 * wide),
        sphere((0, top + (1 + peak) * size + 0.01, 0), 0.035, colours.detail),
    ]
    rods = [
        ((flare * wide * c, top, flare * wide * s), (wide * c, top + size + 0.01, wide * s))
        for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))
    ]
    parts += [cylinder(a, b, rod, colours.trim) for a, b in rods]
    if stands != "hung":
        post, base = p.uniform("post_radius", 0.025, 0.045), p.uniform("base_radius", 0.07, 0.12)
        parts += [
            pillar((0, 0, 0), top, post, colours.trim),
            pillar((0, 0, 0), 0.6 * min(top, 0.3), base, colours.trim, post),
        ]
        parts.append(slab((-base, 0), (base, 0.03), base, colours.detail))
    else:
        end = top + (1 + peak) * size
        chain = p.uniform("chain", 0.1, 0.4)
        parts += ring([(0, end, 0), (0, end + chain, 0)], 0.018, colours.detail)
        parts.append(pillar((0, end + chain, 0), end + chain + 0.03, p.uniform("hook", 0.05, 0.1), colours.trim))
    return parts
