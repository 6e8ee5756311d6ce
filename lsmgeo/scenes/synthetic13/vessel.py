"""Vessels.

Structures: a kind (sailing boat, ketch, container ship, cruise ship, tug, speedboat, rowing boat, catamaran, warship,
submarine), a bow (sharp, round) and, where they apply, a foresail, the place of the bridge, a style (open, cabin;
guns, carrier), the planes of the tail.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lsmgeo.scenes.primitives import Solid, box, cone, cylinder, ellipsoid, half_space
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import bar, below, block, kept, pair, pillar, ring, rod, slab, spaced, wing

__all__ = ["build"]

# Of each kind: beam, height of the hull, as shares of the length.
SHAPES = {
    "sailing boat": ((0.22, 0.34), (0.08, 0.14)),
    "ketch": ((0.2, 0.3), (0.08, 0.13)),
    "container ship": ((0.13, 0.2), (0.07, 0.12)),
    "cruise ship": ((0.13, 0.19), (0.06, 0.1)),
    "tug": ((0.3, 0.42), (0.13, 0.2)),
    "speedboat": ((0.26, 0.38), (0.1, 0.17)),
    "rowing boat": ((0.28, 0.42), (0.12, 0.2)),
    "catamaran": ((0.07, 0.1), (0.08, 0.14)),
    "warship": ((0.1, 0.16), (0.06, 0.1)),
    "submarine": ((0.09, 0.15), (0.1, 0.15)),
}


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one vessel, 1 long; its deck is at y = 0."""
    kind = p.choice("kind", tuple(SHAPES))
    beam, draught = p.uniforms(("beam", "draught"), SHAPES[kind])
    if kind == "submarine":
        return _submarine(p, colours, beam)
    # Parts near the ends of a tug or a container ship would overhang a round hull.
    bow = p.choice("bow", ("sharp", "round") if kind not in ("tug", "container ship") else ("sharp",))
    hull = _hull(p, bow, colours, beam, draught)
    z = beam / 2
    if kind == "catamaran":
        apart = p.uniform("hull_distance", 0.14, 0.24)
        hulls = [part.moved((0, 0, apart)) for part in hull]
        hulls += [part.moved((0, 0, -apart)) for part in hull]
        deck = slab((-0.4, -0.02), (0.12, 0.025), apart + z, colours.trim)
        house = slab((-0.3, 0), (0.1, p.uniform("cabin_height", 0.08, 0.14)), 0.7 * apart, colours.trim)
        cabin = below(house, (-0.05, 0.15), (0.12, 0.0))
        rods = [bar((0.15, 0, 0), (0.15, 0.02, 0), 0.03, 2 * apart, colours.detail)]
        return [*hulls, deck, cabin, *rods, *_rig(p, colours, 0.12, "one")]
    if kind in ("sailing boat", "ketch"):
        radii = (p.uniform("cabin_length", 0.14, 0.24), p.uniform("cabin_height", 0.05, 0.09), 0.6 * z)
        cabin = ellipsoid((-0.05, 0, 0), radii, colours.trim)
        root, tip = (0, -0.9 * draught, 0), (-0.05, -draught - p.uniform("keel", 0.05, 0.15), 0)
        keel, mast = wing(root, tip, 0.2, 0.12, 0.03, colours.detail), p.uniform("mast_place", 0.05, 0.15)
        return [*hull, cabin, keel, *_rig(p, colours, mast, "one" if kind == "sailing boat" else "two")]
    if kind == "rowing boat":
        return _rowing_boat(p, colours, hull, beam, draught)
    upper = {
        "container ship": _containers,
        "cruise ship": _decks,
        "tug": _tug,
        "speedboat": _speedboat,
        "warship": _warship,
    }
    return [*hull, *upper[kind](p, colours, z)]


def _hull(p: Parameters, bow: str, colours: Palette, beam: float, draught: float) -> list[Solid]:
    """A hull below y = 0 with its bow at +x: a box cut to a bow, or half an ellipsoid; and a strake along its edge."""
    z = beam / 2
    if bow == "round":
        full, deep = p.uniform("stern_width", 0.6, 0.85), p.uniform("stern_depth", 0.5, 0.75)
        low = ellipsoid((0, 0, 0), (0.5, draught, z), colours.body).minus(half_space((0, 0, 0), (0, -1, 0)))
        stern = rod((-0.45, -deep * draught, 0), 0, 1.0, colours.body)
        stern = stern.scaled((1, deep * draught, full * z), (0, -deep * draught, 0))
        return [low, stern, ellipsoid((0, 0, 0), (0.5, 0.03, z), colours.trim)]
    start, rake = p.uniform("bow_start", 0.1, 0.3), p.uniform("bow_rake", 0.02, 0.15)
    hull = slab((-0.5, -draught), (0.5, 0), z, colours.body)
    for side in (-1, 1):
        hull = kept(hull, (0.5, 0, 0), (-z, 0, -side * (0.5 - start)))
    stem = half_space((0.5, 0, 0), (-draught, rake, 0))
    hull = hull.minus(stem)
    strake = slab((-0.51, -0.035), (0.5, -0.005), z + 0.008, colours.trim)
    for side in (-1, 1):
        strake = kept(strake, (0.51, 0, 0), (-z, 0, -side * (0.5 - start)))
    return [hull, strake]


def _rig(p: Parameters, colours: Palette, place: float, masts: str) -> list[Solid]:
    """Masts, booms, and triangular sails of some thickness."""
    tall, boom = p.uniform("mast_height", 0.7, 1.25), p.uniform("boom", 0.3, 0.48)
    rise, foresail = p.uniform("boom_height", 0.1, 0.16), p.choice("foresail", ("jib", "none", "jib"))
    parts: list[Solid] = []
    two = (place, tall, 0.7 * boom), (place - 0.42, 0.65 * tall, 0.16)
    for x, height, reach in ((place, tall, boom),) if masts == "one" else two:
        sail = slab((x - reach, rise), (x, 0.96 * height), 0.013, colours.detail)
        parts += [
            pillar((x, -0.05, 0), height, 0.014, colours.trim),
            rod((x - reach - 0.01, rise, 0), x, 0.014, colours.trim),
            below(sail, (x - reach, rise), (x - 0.02, 0.96 * height)),
        ]
    if foresail == "jib":
        level = p.uniform("jib_height", 0.6, 0.9) * tall
        front = 0.48
        jib = below(slab((place + 0.02, 0.03), (front, level), 0.013, colours.detail), (place, level), (front, 0.03))
        parts += [jib, cylinder((front - 0.005, -0.01, 0), (place, level + 0.02, 0), 0.013, colours.trim)]
    return parts


def _rowing_boat(p: Parameters, colours: Palette, hull: list[Solid], beam: float, draught: float) -> list[Solid]:
    """The hull is hollow, with benches across and oars."""
    wall, z = p.uniform("wall", 0.03, 0.05), beam / 2
    room = ellipsoid((-0.08, 0.02, 0), (0.36, draught - wall, z - wall), colours.body)
    # The room replaces the stem's cut: at most three cuts per part.
    hull = [replace(part, cuts=(*part.cuts[:2], room)) for part in hull]
    count = p.count("benches", 2, 3)
    benches = [
        box((x, -0.3 * draught, 0), (0.07, 0.03, 0.97 * beam * np.sqrt(1 - ((x + 0.05) / 0.5) ** 2)), colours.trim)
        for x in spaced(-0.38, 0.2, count)
    ]
    oar, drop = p.uniform("oar_length", 0.25, 0.4), p.uniform("oar_drop", 0.05, 0.15)
    x = p.uniform("oar_place", -0.15, 0.05)
    end = (x - 0.08, -drop, z + oar)
    oars = [
        *ring([(x, 0.07, 0.3 * z), (x - 0.02, 0.02, z), end], 0.013, colours.detail),
        ellipsoid(end, (0.04, 0.014, 0.08), colours.detail),
        box((x - 0.02, 0.0, 0.97 * z), (0.03, 0.05, 0.03), colours.trim),
    ]
    return [*hull, *benches, *pair(*oars)]


def _containers(p: Parameters, colours: Palette, z: float) -> list[Solid]:
    """Stacks of boxes and a bridge at the stern, or amidships."""
    bridge, deck = p.choice("bridge", ("stern", "middle")), p.uniform("deck_rise", 0.02, 0.04)
    tall, reach = p.uniform("bridge_height", 0.13, 0.22), p.uniform("bridge_length", 0.07, 0.11)
    place = -0.4 if bridge == "stern" else p.uniform("bridge_place", -0.1, 0.05)
    parts = [
        slab((place - reach / 2, -0.01), (place + reach / 2, tall), 0.9 * z, colours.trim),
        slab((place - 0.3 * reach, tall - 0.045), (place + 0.6 * reach, tall - 0.015), 1.0 * z, colours.dark),
        pillar((place - 0.75 * reach, 0, 0), tall + 0.04, 0.025, colours.detail),
        slab((-0.48, -0.01), (0.22, deck), 0.8 * z, colours.trim),
    ]
    size, materials = p.uniform("container", 0.04, 0.06), (colours.body, colours.trim, colours.detail)
    for index, x in enumerate(spaced(-0.47, 0.25, p.count("bays", 5, 8))):
        if abs(x - place) < reach:
            continue
        rows = 1 + (index * 7 + len(parts)) % 3
        parts += [
            box((x, deck + (row + 0.5) * size, 0), (0.078, 0.96 * size, 1.7 * z), materials[(index + row) % 3])
            for row in range(rows)
        ]
    return parts


def _decks(p: Parameters, colours: Palette, z: float) -> list[Solid]:
    """Decks that get shorter upwards with rows of windows between them, funnels and boats."""
    storey, step = p.uniform("storey", 0.035, 0.05), p.uniform("deck_step", 0.02, 0.06)
    start, front = p.uniform("deck_start", -0.48, -0.42), p.uniform("deck_front", 0.15, 0.28)
    parts, y = [], 0.0
    for level in range(p.count("decks", 3, 5)):
        rear, bow, side = start + level * step, front - 1.3 * level * step, z * (0.95 - 0.06 * level)
        parts.append(slab((rear, y - 0.005), (bow, y + storey), side, colours.trim))
        low, high = (rear + 0.01, y + 0.3 * storey), (bow + 0.004, y + 0.75 * storey)
        parts.append(slab(low, high, side + 0.004, colours.dark))
        y += storey
    rise, size = p.uniform("funnel_height", 0.07, 0.13), p.uniform("funnel_radius", 0.022, 0.04)
    count = p.count("funnels", 1, 4)
    for x in spaced(start + 5 * step, front - 7 * step, count) if front - start > 13 * step else [(start + front) / 2]:
        base, top = (x - 0.27 * rise, y + 0.85 * rise, 0), (x - 0.33 * rise, y + 1.05 * rise, 0)
        parts.append(cylinder((x, y - 0.01, 0), (x - 0.3 * rise, y + rise, 0), size, colours.detail))
        parts.append(cylinder(base, top, 1.06 * size, colours.dark))
    mast = cylinder((0.3, -0.01, 0), (0.29, 0.2, 0), 0.013, colours.detail)
    return [*parts, mast]


def _tug(p: Parameters, colours: Palette, z: float) -> list[Solid]:
    """A wheelhouse, a funnel and fenders."""
    place, tall = p.uniform("house_place", -0.05, 0.12), p.uniform("house_height", 0.14, 0.24)
    long, top = p.uniform("house_length", 0.2, 0.32), p.uniform("wheelhouse", 0.1, 0.17)
    rise, eaves = p.uniform("mast_height", 0.15, 0.35), tall + 0.5 * top
    parts = [
        slab((place - long, -0.01), (place + 0.4 * long, 0.55 * tall), 0.65 * z, colours.trim),
        slab((place - 0.3 * long, 0.5 * tall), (place + 0.3 * long, tall + 0.5 * top), 0.5 * z, colours.trim),
        slab((place - 0.31 * long, tall - 0.02), (place + 0.32 * long, tall + 0.3 * top), 0.52 * z, colours.dark),
        slab((place - 0.36 * long, eaves - 0.01), (place + 0.38 * long, eaves + 0.025), 0.58 * z, colours.body),
        cylinder((place - 0.7 * long, 0.3 * tall, 0), (place - 0.75 * long, tall + 0.12, 0), 0.05, colours.detail),
        pillar((place, tall, 0), tall + top + rise, 0.014, colours.detail),
        box((place, tall + top + 0.7 * rise, 0), (0.026, 0.026, 0.9 * z), colours.detail),
        slab((-0.42, -0.01), (-0.36, 0.09), 0.05, colours.detail),
    ]
    tyres = [cylinder((x, -0.05, z - 0.01), (x, -0.05, z + 0.025), 0.045, colours.dark) for x in (-0.35, -0.15, 0.05)]
    return [*parts, *pair(*tyres)]


def _speedboat(p: Parameters, colours: Palette, z: float) -> list[Solid]:
    """A windscreen, seats, an engine at the stern; with a cabin, a motor yacht."""
    style = p.choice("style", ("open", "cabin"))
    place, tall = p.uniform("screen_place", 0.0, 0.12), p.uniform("screen_height", 0.07, 0.13)
    lean, motor = p.uniform("screen_lean", 0.04, 0.12), p.uniform("motor", 0.1, 0.16)
    deck = ellipsoid((0.18, 0, 0), (0.27, 0.05, 0.62 * z), colours.trim)
    screen = bar((place, -0.01, 0), (place - lean, tall, 0), 0.03, 1.5 * z, colours.dark)
    parts = [deck, screen]
    if style == "open":
        seats = [
            bar((x, -0.01, 0.42 * z), (x - 0.03, 0.09, 0.42 * z), 0.07, 0.55 * z, colours.detail)
            for x in (place - 0.16, place - 0.33)
        ]
        parts += [
            *pair(*seats),
            slab((-0.55, -0.1), (-0.46, motor), 0.045, colours.dark),
            slab((-0.56, motor - 0.03), (-0.44, motor + 0.04), 0.055, colours.detail),
        ]
        return parts
    long = p.uniform("cabin_length", 0.3, 0.45)
    house = slab((place - long, -0.01), (place, tall + 0.02), 0.7 * z, colours.trim)
    house = below(house, (place - lean, tall + 0.02), (place, 0.0))
    panes = slab((place - 0.9 * long, 0.35 * tall), (place - lean, 0.85 * tall), 0.72 * z, colours.dark)
    upper = slab((place - 0.85 * long, tall + 0.01), (place - 1.5 * lean, tall + 0.05), 0.55 * z, colours.body)
    roof = slab((place - 0.8 * long, tall + 0.14), (place - 1.5 * lean - 0.02, tall + 0.17), 0.5 * z, colours.trim)
    places = (place - s * long - lean for s in (0.25, 0.5))
    posts = [bar((x, tall, 0.4 * z), (x, tall + 0.15, 0.4 * z), 0.026, 0.026, colours.detail) for x in places]
    return [*parts, house, panes, upper, roof, *pair(*posts)]


def _warship(p: Parameters, colours: Palette, z: float) -> list[Solid]:
    """Turrets with guns before and behind a stepped superstructure, or the flat deck of a carrier."""
    style = p.choice("style", ("guns", "guns", "carrier"))
    tall, place = p.uniform("tower_height", 0.1, 0.18), p.uniform("tower_place", -0.08, 0.06)
    long, mast = p.uniform("house_length", 0.24, 0.36), p.uniform("mast_height", 0.1, 0.2)
    size = p.uniform("turret", 0.032, 0.045)
    if style == "carrier":
        deck = block((-0.52, -0.005, -1.9 * z), (0.36, 0.03, 1.7 * z), colours.trim)
        strip = block((-0.48, 0.02, -0.7 * z), (0.48, 0.042, 0.5 * z), colours.dark)
        island = [
            block((place - 0.07, 0.02, 1.1 * z), (place + 0.07, 0.02 + 0.7 * tall, 1.6 * z), colours.body),
            block((place - 0.02, 0.5 * tall, 1.2 * z), (place + 0.05, 1.1 * tall, 1.5 * z), colours.detail),
        ]
        sizes = (0.09, 0.03, 0.026), (0.03, 0.026, 0.09)
        planes = [box((x, 0.05, -1.2 * z), size, colours.detail) for x in (-0.35, -0.22, 0.2) for size in sizes]
        return [deck, strip, *island, *planes, pillar((place, tall, 1.35 * z), tall + mast, 0.013, colours.dark)]
    parts = [
        slab((place - long / 2, -0.01), (place + long / 2, 0.4 * tall), 0.8 * z, colours.trim),
        slab((place - 0.1 * long, 0.3 * tall), (place + 0.4 * long, tall), 0.6 * z, colours.trim),
        slab((place + 0.05 * long, 0.75 * tall), (place + 0.42 * long, 0.93 * tall), 0.65 * z, colours.dark),
        pillar((place + 0.1 * long, tall - 0.01, 0), tall + mast, 0.014, colours.detail),
        box((place + 0.1 * long, tall + 0.6 * mast, 0), (0.026, 0.026, 1.1 * z), colours.detail),
        cylinder((place - 0.3 * long, 0.3 * tall, 0), (place - 0.35 * long, 0.9 * tall, 0), 0.03, colours.detail),
    ]
    ahead, behind = place + long / 2, place - long / 2
    for x, y, turn in ((ahead + 0.17, 0.0, 0), (ahead + 0.07, 0.035, 0), (behind - 0.1, 0.0, 180)):
        gun = [pillar((0, -0.04, 0), 0.035, size, colours.detail)]
        for side in (-0.4 * size, 0.4 * size):
            gun.append(cylinder((0, 0.02, side), (3.2 * size, 0.035, side), 0.013, colours.dark))
        parts += [part.rotated(1, turn).moved((x, y, 0)) for part in gun]
    return parts


def _submarine(p: Parameters, colours: Palette, beam: float) -> list[Solid]:
    """A spindle with a tower, planes and a screw."""
    radius, nose = beam / 2, p.uniform("nose_length", 0.06, 0.16)
    place, tall = p.uniform("tower_place", 0.05, 0.25), p.uniform("tower_height", 0.06, 0.12)
    long, fin = p.uniform("tower_length", 0.12, 0.22), p.uniform("fin", 0.08, 0.14)
    casing = p.uniform("casing", 0.2, 0.45) * radius
    tail = p.choice("planes", ("cross", "x"))
    fins = [
        wing((-0.4, 0, 0), (-0.46, 0, fin), 0.1, 0.06, 0.03, colours.trim),
        wing((-0.4, 0, 0), (-0.46, fin, 0), 0.1, 0.06, 0.03, colours.trim),
    ]
    fins += [part.rotated(0, 180) for part in fins]
    if tail == "x":
        fins = [part.rotated(0, 45) for part in fins]
    tower = [
        slab((place - long / 2, 0), (place + 0.35 * long, radius + tall), 0.35 * radius, colours.trim),
        pillar((place + 0.35 * long, 0, 0), radius + tall, 0.4 * radius, colours.trim),
        pillar((place, radius, 0), radius + tall + 0.1, 0.014, colours.dark),
        pillar((place - 0.06, radius, 0), radius + tall + 0.06, 0.014, colours.dark),
    ]
    root, tip = (place, radius + 0.6 * tall, 0), (place - 0.01, radius + 0.6 * tall, 1.6 * radius)
    sail_planes = pair(wing(root, tip, 0.07, 0.05, 0.028, colours.detail))
    screw = [box((-0.52, 0, 0), (0.026, 1.5 * radius, 0.035), colours.detail).rotated(0, turn) for turn in (0, 60, 120)]
    return [
        rod((-0.2, 0, 0), 0.5 - nose, radius, colours.body),
        ellipsoid((0.5 - nose, 0, 0), (nose, radius, radius), colours.body),
        cone((-0.2, 0, 0), (-0.53, 0, 0), radius, 0.2 * radius, colours.body),
        *tower,
        *sail_planes,
        *fins,
        *screw,
        slab((-0.3, 0.5 * radius), (0.4, 1.04 * radius), casing, colours.detail),
    ]
