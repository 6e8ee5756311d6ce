"""Loudspeakers.

Structures: a kind (bookshelf, tower, subwoofer, soundbar, stage box on a tripod, cylinder, ball, horn, radio, curved
stack), a rim around the drivers (ring, square, none) and, where they apply, a layout (one to four drivers), the shape
of the box, a style, a foot, a port, an antenna.
"""

from __future__ import annotations

import numpy as np

from lsmgeo.scenes.primitives import Solid, box, cone, cylinder, ellipsoid, half_space, sphere
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import (
    Point,
    bar,
    below,
    block,
    kept,
    pair,
    pillar,
    ring,
    rod,
    slab,
    spaced,
    spokes,
    tube,
)

__all__ = ["build"]

# Ranges of height, width and depth of the kinds that are boxes.
BOXES = {
    "bookshelf": ((0.5, 0.8), (0.3, 0.5), (0.3, 0.55)),
    "tower": ((0.9, 1.4), (0.2, 0.32), (0.2, 0.45)),
    "subwoofer": ((0.45, 0.7), (0.5, 0.8), (0.45, 0.8)),
    "soundbar": ((0.1, 0.22), (1.0, 1.6), (0.12, 0.25)),
    "stage box": ((0.55, 0.8), (0.35, 0.5), (0.3, 0.45)),
}


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one loudspeaker; it sounds towards +x."""
    kind = p.choice("kind", (*BOXES, "tower", "cylinder", "ball", "horn", "radio", "stack"))
    rim = p.choice("rim", ("ring", "square", "none")) if kind not in ("horn", "stack") else "none"
    if kind == "horn":
        return _horn(p, colours)
    if kind == "stack":
        return _stack(p, colours)
    if kind == "cylinder":
        return _cylinder(p, rim, colours)
    dish, proud = p.uniform("dish", 0.3, 0.8), p.uniform("rim_thickness", 0.02, 0.05)
    if kind == "ball":
        return _ball(p, rim, colours, dish, proud)
    if kind == "radio":
        return _radio(p, rim, colours, dish, proud)

    tall, wide, deep = p.uniforms(("height", "width", "depth"), BOXES[kind])
    x, z = deep / 2, wide / 2
    upright = kind in ("bookshelf", "tower", "stage box")
    shape = p.choice("shape", ("square", "sloped", "tapered") if upright else ("square",))
    body = slab((-x, 0), (x, tall), z, colours.body)
    if shape == "sloped":
        body = below(body, (-x, p.uniform("slope", 0.7, 0.9) * tall), (x, tall))
    elif shape == "tapered":
        narrow = p.uniform("taper", 0.45, 0.75) * z
        for side in (-1, 1):
            body = kept(body, (-x, 0, side * narrow), (z - narrow, 0, -side * deep))
    parts = [body]
    if kind == "soundbar":
        count = p.count("drivers", 3, 6)
        size, lift = p.uniform("driver", 0.28, 0.4) * tall, p.uniform("foot_height", 0.02, 0.06)
        for place in np.linspace(-z + 0.15, z - 0.15, count):
            parts += _driver(rim, colours, (x, tall / 2, float(place)), size, dish, proud)
        strip = p.uniform("strip", 0.5, 0.9)
        parts.append(slab((-0.9 * x, tall - 0.01), (0.9 * x, tall + 0.015), strip * z, colours.trim))
        parts += pair(block((-x, -lift, z - 0.1), (x, 0.02, z - 0.06), colours.trim))
        return parts
    drivers = {"tower": ("two", "three", "four"), "subwoofer": ("one",)}.get(kind, ("one", "two", "two"))
    layout = p.choice("layout", drivers)
    large = min(p.uniform("woofer", 0.55, 0.85) * z, 0.3 * tall)
    if layout == "one":
        places = [(p.uniform("woofer_place", 0.4, 0.6), large)]
    else:
        small = p.uniform("tweeter", 0.3, 0.55) * large
        shares = {"two": (0.34, 0.8), "three": (0.2, 0.5, 0.82), "four": (0.15, 0.37, 0.6, 0.84)}[layout]
        large = min(large, 0.1 * tall) if layout == "four" else large
        places = [(share, large) for share in shares[:-1]] + [(shares[-1], small)]
    baffle = p.uniform("baffle", 0.75, 0.95), p.uniform("baffle_thickness", 0.02, 0.04)
    front = x + baffle[1]
    lower, upper = (1 - baffle[0]) * tall / 2, (1 + baffle[0]) * tall / 2
    if shape == "square":
        parts.append(block((x - 0.02, lower, -baffle[0] * z), (front, upper, baffle[0] * z), colours.trim))
    for share, size in places:
        parts += _driver(rim, colours, (front if shape == "square" else x, share * tall, 0), size, dish, proud)
    if kind == "bookshelf" and p.choice("port", ("none", "slot")) == "slot":
        slot = slab((x - 0.15, 0.03), (x + 0.1, 0.08), 0.6 * z, colours.dark)
        through = 2 if shape == "square" else 1
        parts = [part.minus(slot) for part in parts[:through]] + parts[through:]
    feet = ("none", "feet", "plinth", "stand") if kind == "bookshelf" else ("none", "feet", "plinth")
    foot = p.choice("foot", feet) if kind != "stage box" else "tripod"
    return parts + _foot(p, foot, colours, x, z)


def _driver(rim: str, colours: Palette, at: Point, radius: float, dish: float, proud: float) -> list[Solid]:
    """A dished membrane with a dome in its middle, and what frames it, on a front at ``at``."""
    x, y, z = at
    cup = cone((x + 2 * proud, y, z), (x - dish * radius, y, z), 0.95 * radius, 0.2 * radius)
    parts = [
        rod((x - 0.9 * radius * dish, y, z), x + proud, radius, colours.dark).minus(cup),
        sphere((x - 0.5 * dish * radius, y, z), 0.33 * radius, colours.detail),
    ]
    if rim == "ring":
        hole = cylinder((x - 1, y, z), (x + 1, y, z), 0.92 * radius)
        parts.append(rod((x - 0.01, y, z), x + 1.2 * proud, 1.15 * radius, colours.trim).minus(hole))
    elif rim == "square":
        hole = cylinder((x - 1, y, z), (x + 1, y, z), 0.98 * radius)
        parts.append(box((x + 0.3 * proud, y, z), (proud, 2.15 * radius, 2.15 * radius), colours.trim).minus(hole))
    return parts


def _foot(p: Parameters, foot: str, colours: Palette, x: float, z: float) -> list[Solid]:
    """The foot, below y = 0."""
    if foot == "none":
        return []
    drop = p.uniform("foot_height", 0.03, 0.1)
    if foot == "feet":
        return pair(*(pillar((s * 0.75 * x, 0.02, 0.75 * z), -drop, 0.04, colours.detail, 0.02) for s in (-1, 1)))
    if foot == "plinth":
        return [slab((-1.15 * x, -0.6 * drop), (1.15 * x, 0.01), 1.2 * z, colours.trim)]
    pole, radius = p.uniform("pole_height", 0.5, 1.0), p.uniform("pole_radius", 0.025, 0.05)
    post = pillar((0, -pole, 0), 0.05, radius, colours.detail)
    if foot == "stand":
        plate = slab((-0.8 * x, -0.03), (0.8 * x, 0.01), 0.8 * z, colours.detail)
        return [post, slab((-x, -pole), (x, -pole + 0.04), z, colours.detail), plate]
    return [post, *spokes((0, -0.45 * pole, 0), 0.55 * pole, 0.55 * pole, 3, 0.045, colours.detail)]


def _cylinder(p: Parameters, rim: str, colours: Palette) -> list[Solid]:
    tall, radius = p.uniform("height", 0.4, 1.1), p.uniform("radius", 0.16, 0.3)
    narrow, band = p.uniform("taper", 0.6, 1.0), p.uniform("band", 0.08, 0.18)
    style = p.choice("style", ("drivers", "bands", "dome"))
    parts = [pillar((0, 0, 0), tall, radius, colours.body, narrow * radius)]
    parts.append(pillar((0, 0, 0), band * tall, p.uniform("flare", 1.04, 1.25) * radius, colours.trim))
    top = narrow * radius
    if style == "drivers":
        size = p.uniform("woofer", 0.45, 0.62) * min(top, 0.25 * tall)
        dish, proud = p.uniform("dish", 0.3, 0.8), p.uniform("rim_thickness", 0.02, 0.05)
        for y in (0.35, 0.7):
            front = radius + (top - radius) * y
            parts += _driver(rim, colours, (0.97 * front, y * tall, 0), size * (1.0 if y < 0.5 else 0.7), dish, proud)
    else:
        # Rings of grille, or one grille all around.
        low, high = p.uniform("grille_start", 0.22, 0.34), p.uniform("grille_end", 0.75, 0.92)
        first, share = spaced(low, high, 4) if style == "bands" else [low], p.uniform("grille_share", 0.3, 0.6)
        for y in first:
            end = y + share * (high - low) / 4 if style == "bands" else high
            wide = [1.04 * (radius + (top - radius) * level) for level in (y, end)]
            parts.append(pillar((0, y * tall, 0), end * tall, wide[0], colours.dark, wide[1]))
    cap = (0.5 if style == "dome" else 0.0) + p.uniform("cap", 0.08, 0.25)
    return [*parts, ellipsoid((0, tall, 0), (0.9 * top, cap * top, 0.9 * top), colours.dark)]


def _ball(p: Parameters, rim: str, colours: Palette, dish: float, proud: float) -> list[Solid]:
    radius, flat = p.uniform("radius", 0.25, 0.4), p.uniform("flattening", 0.7, 1.0)
    size, cut = p.uniform("woofer", 0.5, 0.75) * radius, p.uniform("front_cut", 0.55, 0.75) * radius
    ball = ellipsoid((0, 0, 0), (radius, flat * radius, radius), colours.body)
    ball = ball.minus(half_space((cut, 0, 0), (-1, 0, 0)))
    parts = [ball, *_driver(rim, colours, (cut, 0, 0), 0.8 * size, dish, proud)]
    foot, spread = p.choice("foot", ("ring", "stem", "tripod")), p.uniform("foot_spread", 0.6, 1.0) * radius
    bottom = -flat * radius
    rise = p.uniform("rise", 0.1, 0.7)
    if foot == "ring":
        return [*parts, pillar((0, bottom - 0.15 * rise, 0), 0.6 * bottom, spread, colours.trim, 0.5 * radius)]
    if foot == "tripod":
        return [*parts, *spokes((0, 0.6 * bottom, 0), spread, rise - 0.4 * bottom, 3, 0.05, colours.trim)]
    low = bottom - rise
    post = pillar((0, low, 0), 0, 0.04, colours.trim)
    return [*parts, post, pillar((0, low, 0), low + 0.08, spread, colours.trim, 0.1)]


def _horn(p: Parameters, colours: Palette) -> list[Solid]:
    """A gramophone's horn over its box, or a megaphone on a bracket."""
    style = p.choice("style", ("gramophone", "megaphone"))
    mouth, throat = p.uniform("mouth", 0.25, 0.42), p.uniform("throat", 0.05, 0.09)
    length, tilt = p.uniform("horn_length", 0.45, 0.8), p.uniform("horn_tilt", 0, 40)
    flare, lip = p.uniform("flare", 0.5, 0.7), p.uniform("lip", 1.15, 1.35)
    wide, tall = p.uniform("box_width", 0.35, 0.55), p.uniform("box_height", 0.15, 0.3)
    horn = [
        tube((0, 0, 0), (length, 0, 0), throat, mouth * flare, 0.035, colours.body),
        tube((0.93 * length, 0, 0), (lip * length, 0, 0), mouth * (flare - 0.06), mouth, 0.035, colours.body),
        rod((-0.08, 0, 0), 0.05, throat, colours.trim),
    ]
    if style == "gramophone":
        at = np.array([-0.15, tall + 0.3, 0])
        horn = [part.rotated(2, tilt).moved(at) for part in horn]
        neck = ring([(-0.12, tall - 0.02, 0), (-0.2, tall + 0.15, 0), at], 0.045, colours.trim)
        disc = pillar((0.05, tall - 0.01, 0), tall + 0.03, 0.4 * wide, colours.dark)
        plinth = slab((-wide / 2 - 0.03, 0), (wide / 2 + 0.03, 0.05), wide / 2 + 0.03, colours.trim)
        bend = [(0, tall / 2, wide / 2), (0, tall / 2, wide / 2 + 0.1), (0, tall / 2 - 0.12, wide / 2 + 0.1)]
        body = slab((-wide / 2, 0), (wide / 2, tall), wide / 2, colours.trim)
        return [*horn, *neck, disc, plinth, *ring(bend, 0.02, colours.dark), body]
    driver = rod((-0.2, 0, 0), -0.05, 1.8 * throat, colours.dark)
    parts = [part.rotated(2, 0.5 * tilt) for part in (*horn, driver)]
    post = pillar((0, -0.5 - tall, 0), 0, 0.04, colours.detail)
    return [*parts, post, box((0, -0.5 - tall, 0), (wide, 0.04, wide), colours.detail)]


def _radio(p: Parameters, rim: str, colours: Palette, dish: float, proud: float) -> list[Solid]:
    """A portable box with a handle and a driver on either side of a panel."""
    tall, wide, deep = p.uniform("height", 0.4, 0.6), p.uniform("width", 0.9, 1.4), p.uniform("depth", 0.2, 0.35)
    rise = p.uniform("handle_height", 0.08, 0.22)
    x, z, size = deep / 2, wide / 2, min(0.38 * tall, 0.2 * wide)
    ends = ((tall - 0.03, 0.75 * z), (tall + rise, 0.65 * z), (tall + rise, -0.65 * z), (tall - 0.03, -0.75 * z))
    handle = ring([(0, y, z) for y, z in ends], 0.025, colours.trim)
    left = _driver(rim, colours, (x, 0.45 * tall, z - 1.25 * size), size, dish, proud)
    high = p.uniform("panel", 0.5, 0.7) * tall
    panel = slab((x - 0.02, 0.2 * tall), (x + 0.02, high), 0.25 * wide - 0.05, colours.detail)
    parts = [slab((-x, 0), (x, tall), z, colours.body), *pair(*left), panel, *handle]
    knob = p.uniform("knob", 0.025, 0.045)
    parts += [rod((x - 0.02, 0.85 * tall, place), x + 0.04, knob, colours.trim) for place in (-0.1, 0.0, 0.1)]
    if p.choice("antenna", ("up", "none")) == "up":
        foot, tip = (-0.5 * x, tall - 0.02, -0.8 * z), (-0.5 * x, tall + 0.5, -1.0 * z)
        parts.append(cylinder(foot, tip, 0.018, colours.detail))
    return parts


def _stack(p: Parameters, colours: Palette) -> list[Solid]:
    """Boxes hung in a curve, as over a stage."""
    count, bend = p.count("boxes", 4, 7), p.uniform("bend", 3, 12)
    tall, wide, deep = p.uniform("height", 0.14, 0.2), p.uniform("width", 0.5, 0.8), p.uniform("depth", 0.3, 0.45)
    inset, horn = p.uniform("inset", 0.1, 0.25), p.uniform("horn", 0.2, 0.36)
    hook, angle = p.uniform("hook", 0.12, 0.25), p.uniform("first_angle", 0, 8)
    parts: list[Solid] = []
    x = y = 0.0
    for _ in range(count):
        cell = [
            box((0, -tall / 2, 0), (deep, 0.97 * tall, wide), colours.body),
            box((deep / 2, -tall / 2, 0), (0.03, 0.75 * tall, (1 - inset) * wide), colours.dark),
            rod((deep / 2, -tall / 2, 0), deep / 2 + 0.03, horn * tall, colours.trim),
        ]
        parts += [part.rotated(2, -angle).moved((x, y, 0)) for part in cell]
        y -= 0.97 * tall * np.cos(np.deg2rad(angle))
        x -= 0.97 * tall * np.sin(np.deg2rad(angle))
        angle += bend
    frame = slab((-deep / 2, -0.02), (deep / 2, 0.04), wide / 2, colours.trim)
    hooks = [bar((s * 0.4 * deep, 0, 0.4 * wide), (0, hook, 0.05), 0.03, 0.03, colours.trim) for s in (-1, 1)]
    return [*parts, frame, *pair(*hooks)]
