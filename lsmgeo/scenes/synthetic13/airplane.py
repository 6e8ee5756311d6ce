"""Airplanes.

Structures: a kind (airliner, rear jets, high-wing or low-wing propeller plane, biplane, glider, delta fighter, four
engines), a tail (conventional, T, V, fin, twin fins) and a landing gear (none, wheels, floats).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, cone, cylinder, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Pair, Point, bar, block, pair, rod, slab, wheel, wing

__all__ = ["build"]

KINDS = ("airliner", "rear jets", "high wing", "low wing", "biplane", "glider", "delta fighter", "four engines")
# Of each kind: span, sweep of the wing's tips, root chord, fuselage radius, as ranges.
SHAPES = {
    "airliner": ((0.75, 1.1), (0.15, 0.32), (0.16, 0.24), (0.045, 0.075)),
    "rear jets": ((0.55, 0.9), (0.12, 0.28), (0.14, 0.22), (0.045, 0.07)),
    "high wing": ((0.9, 1.5), (-0.03, 0.06), (0.14, 0.22), (0.05, 0.09)),
    "low wing": ((0.8, 1.3), (-0.03, 0.1), (0.16, 0.26), (0.05, 0.085)),
    "biplane": ((0.8, 1.3), (-0.02, 0.08), (0.15, 0.24), (0.055, 0.085)),
    "glider": ((1.5, 2.4), (-0.06, 0.08), (0.08, 0.13), (0.035, 0.05)),
    "delta fighter": ((0.5, 0.8), (0.3, 0.45), (0.45, 0.65), (0.045, 0.07)),
    "four engines": ((0.9, 1.4), (0.0, 0.2), (0.15, 0.24), (0.06, 0.095)),
}
TAILS = {"rear jets": ("T",), "delta fighter": ("fin", "twin fins"), "low wing": ("conventional", "V", "twin fins")}


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one airplane, 1 long."""
    kind = p.choice("kind", KINDS)
    jet = kind in ("airliner", "rear jets", "delta fighter")
    tail = p.choice("tail", TAILS.get(kind, ("conventional", "T")))
    gear = p.choice("gear", ("none", "wheels") if jet or kind == "glider" else ("wheels", "floats", "wheels"))
    span, sweep, chord, radius = p.uniforms(("span", "sweep", "root_chord", "radius"), SHAPES[kind])
    taper = p.uniform("taper", *((0.15, 0.4) if jet else (0.5, 0.95)))
    dihedral = p.uniform("dihedral", 0.0, 0.08)
    place = p.uniform("wing_place", -0.02, 0.14) - (0.22 if kind == "delta fighter" else 0.0)
    high = kind in ("high wing", "four engines", "glider")
    level = radius * (0.75 if high else -0.5)

    parts = _fuselage(p, kind, colours, radius)
    tip = (place - sweep, level + dihedral, span / 2)
    parts += pair(wing((place, level, 0), tip, chord, taper * chord, 0.035, colours.trim))
    if kind == "biplane":
        gap = p.uniform("wing_gap", 0.14, 0.22)
        root, tip = (place + 0.03, level + gap, 0), (place + 0.03 - sweep, level + gap + dihedral, span / 2)
        upper = wing(root, tip, chord, taper * chord, 0.035, colours.trim)
        foot = (place - 0.6 * sweep, level, 0.3 * span)
        head = (place + 0.03 - 0.6 * sweep, level + gap + 0.6 * dihedral, 0.3 * span)
        strut = bar(foot, head, 0.03, 0.02, colours.detail)
        cabane = bar((place, 0, 0.03), (place, level + gap, 0.05), 0.03, 0.02, colours.detail)
        parts += pair(upper, strut, cabane)
    parts += _tail(p, tail, colours, radius)
    parts += _engines(p, kind, colours, radius, span, (place, level), sweep, dihedral)
    if gear != "none":
        parts += _gear(p, gear, colours, radius, place, kind)
    return parts


def _fuselage(p: Parameters, kind: str, colours: Palette, radius: float) -> list[Solid]:
    nose, rear = p.uniform("nose_length", 0.12, 0.22), p.uniform("tail_length", 0.25, 0.4)
    front, back, lift = 0.5 - nose, rear - 0.5, 0.4 * radius
    parts = [
        rod((back, 0, 0), front, radius, colours.body),
        cone((back, 0, 0), (-0.5, lift, 0), radius, 0.35 * radius, colours.body),
    ]
    if kind == "delta fighter":
        parts.append(cone((front, 0, 0), (0.5, 0, 0), radius, 0.1 * radius, colours.body))
    else:
        parts.append(ellipsoid((front, 0, 0), (nose, radius, radius), colours.body))
    if kind in ("airliner", "rear jets", "four engines"):
        parts.append(box((0.5 - 0.62 * nose, 0.5 * radius, 0), (0.25 * nose, 0.4 * radius, 1.5 * radius), colours.dark))
        parts += pair(block((back, 0.25 * radius, 0), (front, 0.45 * radius, 1.02 * radius), colours.dark))
    else:
        length = p.uniform("canopy_length", 0.07, 0.14)
        place = 0.12 if kind in ("low wing", "high wing") else 0.22
        parts.append(ellipsoid((place, 0.8 * radius, 0), (length, 0.8 * radius, 0.7 * radius), colours.dark))
    return parts


def _tail(p: Parameters, tail: str, colours: Palette, radius: float) -> list[Solid]:
    """Fins and the horizontal tail, at the rear end."""
    fin, chord = p.uniform("fin_height", 0.13, 0.24), p.uniform("tail_chord", 0.1, 0.17)
    reach, back = p.uniform("tail_reach", 0.14, 0.24), p.uniform("tail_sweep", 0.02, 0.1)
    root, low = -0.5 + chord / 2 + back, 0.3 * radius
    end = root - back
    level = pair(wing((root, low, 0), (end, low, reach), chord, 0.6 * chord, 0.03, colours.trim))
    if tail == "V":
        return pair(wing((root, low, 0), (end, low + fin, 0.8 * fin), chord, 0.6 * chord, 0.03, colours.trim))
    if tail in ("twin fins", "fin"):
        if tail == "fin":
            return [*level, wing((root, 0, 0), (end, low + fin, 0), 1.3 * chord, 0.5 * chord, 0.03, colours.detail)]
        foot, head = (end, low - 0.02, 0.85 * reach), (end, low + 0.8 * fin, 0.85 * reach)
        return level + pair(wing(foot, head, 0.9 * chord, 0.6 * chord, 0.03, colours.detail))
    upright = wing((root, 0, 0), (end, low + fin, 0), 1.15 * chord, 0.6 * chord, 0.03, colours.detail)
    if tail == "T":
        top = low + fin - 0.015
        level = pair(wing((end, top, 0), (end - 0.03, top, reach), 0.8 * chord, 0.5 * chord, 0.03, colours.trim))
    return [upright, *level]


def _engines(
    p: Parameters, kind: str, colours: Palette, radius: float, span: float, root: Pair, sweep: float, dihedral: float
) -> list[Solid]:
    size = p.uniform("engine_size", 0.024, 0.038)
    x, y = root
    if kind == "glider":
        return []
    if kind == "delta fighter":
        nozzle = cylinder((-0.53, 0.4 * radius, 0), (-0.4, 0.2 * radius, 0), 0.8 * radius, colours.dark)
        intake = block((-0.15, -0.6 * radius, 0), (0.12, 0.5 * radius, 1.6 * radius), colours.detail)
        return [nozzle, *pair(intake)]
    if kind in ("high wing", "low wing", "biplane"):
        return _propeller((0.5, 0, 0), p.uniform("propeller", 0.1, 0.16), colours)
    if kind == "rear jets":
        side = radius + 0.9 * size
        engine = rod((-0.36, 0.4 * radius, side), -0.2, size, colours.detail)
        return pair(engine, block((-0.33, 0.3 * radius, 0), (-0.23, 0.3 * radius + 0.025, side), colours.body))
    parts = []
    for share in (0.3,) if kind == "airliner" else (0.3, 0.6):
        side = share * span / 2 if kind != "airliner" else (share + 0.04) * span / 2
        at = (x - sweep * 2 * side / span, y + dihedral * 2 * side / span)
        drop = 1.1 * size if kind == "airliner" else 0.2 * size
        ahead = 0.1
        parts += [
            cylinder((at[0] - 0.03, at[1] - drop, side), (at[0] + ahead, at[1] - drop, side), size, colours.detail),
            *([] if kind == "airliner" else _propeller((at[0] + ahead, at[1] - drop, side), 0.08, colours)[:2]),
        ]
    return pair(*parts)


def _propeller(hub: Point, length: float, colours: Palette) -> list[Solid]:
    x, y, z = hub
    blades = [box(hub, (0.02, 2 * length, 0.03), colours.dark).rotated(0, turn, hub) for turn in (30, 120)]
    return [*blades[:1], cone((x - 0.02, y, z), (x + 0.035, y, z), 0.025, 0.008, colours.detail), blades[1]]


def _gear(p: Parameters, gear: str, colours: Palette, radius: float, place: float, kind: str) -> list[Solid]:
    drop = p.uniform("gear_height", 0.07, 0.12) + radius
    if gear == "floats":
        side = 0.11
        hull = ellipsoid((place + 0.04, -drop, side), (0.26, 0.03, 0.032), colours.detail)
        struts = [
            bar((x, -drop, side), (x - 0.02, -0.3 * radius, 0.4 * radius), 0.028, 0.026, colours.dark)
            for x in (place + 0.12, place - 0.06)
        ]
        return pair(hull, *struts)
    side = 0.09 if kind != "glider" else 0.05
    main = [bar((place - 0.02, -drop, side), (place - 0.02, -0.3 * radius, 0.5 * radius), 0.026, 0.026, colours.detail)]
    main += wheel((place - 0.02, -drop, side), 0.032, 0.026, colours.dark, colours.detail)[:1]
    nose = [slab((0.33, -drop), (0.356, -0.2 * radius), 0.013, colours.detail)]
    return [*pair(*main), *nose, cylinder((0.343, -drop, -0.014), (0.343, -drop, 0.014), 0.028, colours.dark)]
