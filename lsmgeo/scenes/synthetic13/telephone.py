"""Telephones.

Structures: a kind (candy bar, smartphone, flip, slider, desk, rotary, cordless in its cradle, brick, wall, keyboard),
keys (square, round, wide) and, where they apply, ends (square, round) and an antenna (none, stub, whip).
"""

from __future__ import annotations

import numpy as np

from lsmgeo.scenes.primitives import Solid, box, cylinder, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Pair, below, block, pair, pillar, ring, rod, slab, spaced

__all__ = ["build"]

KINDS = ("candy bar", "smartphone", "flip", "slider", "desk", "rotary", "cordless", "brick", "wall", "keyboard")


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one telephone, about 1 high; a mobile one is upright and faces +x."""
    kind = p.choice("kind", KINDS)
    keys = p.choice("keys", ("square", "round", "wide")) if kind not in ("smartphone", "rotary") else "none"
    if kind in ("desk", "rotary", "wall"):
        return _with_handset(p, kind, keys, colours)
    if kind == "flip":
        return _flip(p, keys, colours)
    tall = 1.0
    wide = p.uniform("width", 0.36, 0.62) if kind != "brick" else p.uniform("width", 0.28, 0.42)
    thick = p.uniform("thickness", *((0.16, 0.32) if kind in ("brick", "cordless") else (0.07, 0.16)))
    if kind == "keyboard":
        tall, wide = wide, 1.0
    z, x = wide / 2, thick / 2
    margin = p.uniform("margin", 0.03, 0.08)
    ends = p.choice("ends", ("square", "round")) if kind != "keyboard" else "square"
    parts = _slab(colours, ends, x, tall, z)

    if kind == "smartphone":
        chin, top = p.uniform("chin", 0.05, 0.14), p.uniform("forehead", 0.04, 0.12)
        parts.append(slab((x - 0.02, chin), (x + 0.012, tall - top), z - margin, colours.dark))
        parts += _marks(p, colours, x, chin, tall - top / 2)
        lens = p.uniform("lens", 0.05, 0.09)
        level = p.uniform("switch_height", 0.5, 0.7) * tall
        parts += [
            rod((-x - 0.03, tall - 0.12, z - 0.12), -x + 0.01, lens * 0.6, colours.dark),
            box((-x - 0.01, tall - 0.14, z - 0.14), (0.03, 0.2, 0.18), colours.trim),
            block((0, level, z - 0.01), (0.03, level + 0.14, z + 0.02), colours.detail),
        ]
        return parts
    if kind == "keyboard":
        half, low = (-z + margin, z - margin), (1 - p.uniform("screen_share", 0.45, 0.58)) * tall
        disc, level = p.uniform("wheel", 0.07, 0.13), p.uniform("wheel_height", 0.64, 0.78) * tall
        parts.append(block((x - 0.02, low, 0.55 * half[0]), (x + 0.012, tall - margin, 0.55 * half[1]), colours.dark))
        parts += _keys(p, keys, colours, x, (margin, low - 0.04 * tall), half, (3, 6))
        return parts + pair(rod((x - 0.01, level, 0.8 * z), x + 0.03, disc * tall, colours.trim))
    if kind == "slider":
        slide, chin = p.uniform("slide", 0.25, 0.5), p.uniform("chin", 0.14, 0.26)
        button = p.uniform("button", 0.3, 0.45) * chin
        lower = [part.moved((-2 * x + 0.005, -slide, 0)) for part in _slab(colours, ends, x, tall, z)]
        face = slab((x - 0.02, chin), (x + 0.012, tall - margin), z - margin, colours.dark)
        parts += [part.painted(colours.trim) for part in lower]
        parts += [face, rod((x - 0.02, chin / 2, 0), x + 0.02, button, colours.detail)]
        return parts + _keys(p, keys, colours, -x, (-slide + 0.04, -0.03), (-z + margin, z - margin), (3, 3))
    split = (1 - p.uniform("screen_share", 0.25, 0.45)) * tall
    parts.append(slab((x - 0.02, split), (x + 0.012, tall - 2 * margin), z - margin, colours.dark))
    parts += _keys(p, keys, colours, x, (margin + 0.02, 0.78 * split), (-z + margin, z - margin), (4, 3))
    pad, ear = p.uniform("pad_width", 0.18, 0.38) * wide, p.uniform("earpiece", 0.08, 0.16)
    parts.append(ellipsoid((x, 0.88 * split, 0), (0.03, 0.07 * split + 0.01, pad), colours.trim))
    parts.append(slab((x - 0.01, tall - 1.4 * margin), (x + 0.012, tall - 0.8 * margin), ear, colours.detail))
    antenna = p.choice("antenna", ("none", "stub", "whip")) if kind != "brick" else "whip"
    if antenna != "none":
        long = p.uniform("antenna_length", 0.25, 0.6) if antenna == "whip" else p.uniform("antenna_length", 0.08, 0.16)
        size = 0.03 if antenna == "whip" else 0.05
        parts.append(pillar((0, tall - 0.05, z - 0.08), tall + long, min(size, x), colours.dark))
    if kind == "cordless":
        parts += _cradle(p, colours, x, z)
    return parts


def _slab(colours: Palette, ends: str, x: float, tall: float, z: float) -> list[Solid]:
    """An upright slab from y = 0, with square or half-oval ends."""
    if ends == "square":
        return [slab((-x, 0), (x, tall), z, colours.body)]
    end = 0.35 * min(z, tall)
    caps = [rod((-x, 0, 0), x, 1.0, colours.body).scaled((1, end, z)).moved((0, y, 0)) for y in (end, tall - end)]
    return [slab((-x, end), (x, tall - end), z, colours.body), *caps]


def _keys(
    p: Parameters, keys: str, colours: Palette, x: float, rows: Pair, columns: Pair, count: tuple[int, int]
) -> list[Solid]:
    """Keys in rows from low to high and columns along z, on a face at ``x``."""
    proud, fill = p.uniform("key_height", 0.015, 0.035), p.uniform("key_size", 0.55, 0.8)
    tall, wide = (rows[1] - rows[0]) / count[0], (columns[1] - columns[0]) / count[1]
    parts = []
    for y in spaced(*rows, count[0]):
        if keys == "wide":
            parts.append(box((x, y, 0), (2 * proud, fill * tall, 0.97 * (columns[1] - columns[0])), colours.detail))
            continue
        for z in spaced(*columns, count[1]):
            if keys == "round":
                parts.append(rod((x - 0.02, y, z), x + proud, 0.5 * fill * min(tall, wide), colours.detail))
            else:
                parts.append(box((x, y, z), (2 * proud, fill * tall, fill * wide), colours.detail))
    return parts


def _marks(p: Parameters, colours: Palette, x: float, chin: float, top: float) -> list[Solid]:
    """A smartphone's button and ear piece."""
    size = p.uniform("button", 0.3, 0.42) * chin
    return [
        rod((x - 0.02, chin / 2, 0), x + 0.014, size, colours.detail),
        box((x, top, 0), (0.026, 0.026, 0.14), colours.detail),
    ]


def _flip(p: Parameters, keys: str, colours: Palette) -> list[Solid]:
    """Two halves that meet in a hinge; the lower one leans back, the upper one holds the screen."""
    wide, thick = p.uniform("width", 0.38, 0.62), p.uniform("thickness", 0.06, 0.14)
    low, up = p.uniform("lower_length", 0.45, 0.6), p.uniform("upper_length", 0.45, 0.6)
    opening, margin = p.uniform("opening", 15, 95), p.uniform("margin", 0.03, 0.07)
    z, x = wide / 2, thick / 2
    lower = [
        slab((-thick, -low), (0, 0), z, colours.body),
        *_keys(p, keys, colours, 0.0, (-low + margin, -0.32 * low), (-z + margin, z - margin), (3, 3)),
    ]
    lower.append(ellipsoid((0, -0.18 * low, 0), (0.03, 0.08 * low + 0.01, 0.3 * wide), colours.trim))
    upper = [
        slab((-thick, 0), (0, up), z, colours.body),
        slab((-0.02, 0.15 * up), (0.012, up - margin), z - margin, colours.dark),
    ]
    hinge = cylinder((-x, 0, -z), (-x, 0, z), 0.7 * thick, colours.trim)
    lean = 0.5 * opening
    halves = ((lower, lean), (upper, -lean))
    parts = [part.rotated(2, angle, (-x, 0, 0)) for half, angle in halves for part in half]
    if p.choice("antenna", ("none", "stub")) == "stub":
        long = p.uniform("antenna_length", 0.08, 0.2)
        parts.append(cylinder((-x, 0, z - 0.06), (-x - 0.2 * long, long + 0.1, z - 0.06), 0.035, colours.dark))
    return [*parts, hinge]


def _cradle(p: Parameters, colours: Palette, x: float, z: float) -> list[Solid]:
    """The charging stand of a cordless telephone."""
    reach, rise = p.uniform("cradle_reach", 0.06, 0.18), p.uniform("cradle_height", 0.12, 0.24)
    body = slab((-x - reach, -0.06), (x + reach, rise), z + 0.1, colours.trim)
    return [below(body, (-x - 0.2 * reach, rise), (x + reach, 0.5 * rise))]


def _with_handset(p: Parameters, kind: str, keys: str, colours: Palette) -> list[Solid]:
    """A base with a dial or keys, and a handset that lies across its top or hangs at its side."""
    deep, wide = p.uniform("depth", 0.55, 0.9), p.uniform("width", 0.6, 1.0)
    low, high = p.uniform("front_height", 0.1, 0.2), p.uniform("rear_height", 0.22, 0.45)
    margin, grip = p.uniform("margin", 0.06, 0.12), p.uniform("grip_radius", 0.04, 0.07)
    cup = p.uniform("cup_radius", 0.08, 0.13)
    x, z = deep / 2, wide / 2
    slope = float(np.rad2deg(np.arctan2(high - low, deep)))
    long = 0.92 * wide if kind != "desk" else 0.95 * deep
    handset = [
        *ring([(0, 0, -long / 2), (0, 0.06, -0.3 * long), (0, 0.06, 0.3 * long), (0, 0, long / 2)], grip, colours.trim),
        *(pillar((0, -0.09, s * (long / 2 - cup / 2)), 0.03, cup, colours.trim) for s in (-1, 1)),
    ]
    body = below(slab((-x, 0), (x, high), z, colours.body), (-x, high), (x, low))
    parts = [body, slab((-x - 0.03, 0), (x + 0.03, 0.04), z + 0.03, colours.trim)]

    # Parts on the slope are made for a face at x = 0 that extends along y, and then rotated.
    def laid(solids: list[Solid]) -> list[Solid]:
        return [part.rotated(2, 90 - slope).moved((x, low, 0)) for part in solids]

    run = float(np.hypot(deep, high - low))
    if kind == "desk":
        parts += laid(_keys(p, keys, colours, 0.0, (0.1 * run, 0.6 * run), (-z + 0.35 * wide, z - margin), (4, 3)))
        parts += laid([block((-0.02, 0.68 * run, -z + 0.38 * wide), (0.015, 0.92 * run, z - margin), colours.dark)])
        place = -z + 0.17 * wide
        turned = [part.rotated(1, 90).rotated(2, -slope) for part in handset]
        parts += [part.moved((0, (low + high) / 2 + 0.07, place)) for part in turned]
        level = (low + high) / 2
        start, bend = (x - 0.05, level * 0.6, place), (x + 0.12, 0.06, place - 0.02)
        return parts + ring([start, bend, (x + 0.1, 0.03, 0), (x - 0.05, 0.03, 0.05)], 0.02, colours.dark)
    size = (p.uniform("dial", 0.28, 0.36) if kind == "rotary" else 0.34) * min(run, wide)
    dial = [
        rod((-0.05, 0.42 * run, 0), 0.04, size, colours.detail),
        rod((0, 0.42 * run, 0), 0.065, 0.42 * size, colours.body),
    ]
    for a in np.deg2rad(np.linspace(-30, 240, 8)):
        hole = (0, 0.42 * run + 0.72 * size * np.sin(a), 0.72 * size * np.cos(a))
        dial.append(rod(hole, 0.055, 0.15 * size, colours.dark))
    if kind != "rotary":
        dial = _keys(p, keys, colours, 0.0, (0.12 * run, 0.62 * run), (-0.6 * z, 0.6 * z), (4, 3))
    rest = pair(block((-0.85 * x, high - 0.12, 0.35 * z), (-0.35 * x, high + 0.17, 0.5 * z), colours.body))
    parts += [*laid(dial), *rest, *(part.moved((-0.6 * x, high + 0.14, 0)) for part in handset)]
    if kind == "rotary":
        return parts
    # A wall telephone is the same one upright, with its base at the wall.
    return [part.rotated(2, -90) for part in parts]
