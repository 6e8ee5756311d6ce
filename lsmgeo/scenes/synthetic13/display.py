"""Displays.

Structures: a kind (monitor, television, all-in-one, tube, laptop, portrait screen, two screens, screen on a tripod),
a frame (even, chin, thin) and, where it applies, a stand (disc, plate, V, arm, easel, bent sheet, two feet; for a
tube: swivel, feet, none).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, cylinder
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import bar, below, block, kept, pair, pillar, rack, rod, slab, spokes

__all__ = ["build"]

# Of each kind: width, height over width, thickness.
SHAPES = {
    "monitor": ((0.9, 1.3), (0.52, 0.78), (0.04, 0.1)),
    "television": ((1.3, 1.8), (0.48, 0.62), (0.05, 0.12)),
    "all-in-one": ((0.9, 1.2), (0.6, 0.75), (0.05, 0.09)),
    "tube": ((0.8, 1.1), (0.7, 0.95), (0.12, 0.25)),
    "laptop": ((0.8, 1.1), (0.58, 0.75), (0.035, 0.06)),
    "portrait": ((0.5, 0.7), (1.4, 1.8), (0.04, 0.1)),
    "two screens": ((0.75, 0.95), (0.55, 0.8), (0.04, 0.08)),
    "tripod": ((0.9, 1.3), (0.52, 0.75), (0.05, 0.1)),
}


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one display; its screen faces +x."""
    kind = p.choice("kind", tuple(SHAPES))
    frame = p.choice("frame", ("even", "chin", "thin"))
    wide, ratio, thick = p.uniforms(("width", "aspect", "thickness"), SHAPES[kind])
    tall, bezel = wide * ratio, p.uniform("bezel", 0.03, 0.08)
    tilt = p.uniform("tilt", 0, 14)
    if frame == "thin":
        bezel = 0.02
    chin = p.uniform("chin", 0.06, 0.16) if frame == "chin" else bezel
    screen = _screen(colours, wide, tall, thick, bezel, chin)
    if kind == "laptop":
        return _laptop(p, colours, screen, wide, tilt)
    if kind == "tube":
        return _tube(p, colours, screen, wide, tall, thick)

    if kind == "two screens":
        turn = p.uniform("turn", 5, 25)
        sides = [part.moved((0, 0, 0.51 * wide)).rotated(1, turn) for part in screen]
        screen = [*sides, *(part.mirrored(2) for part in sides)]
    rise = p.uniform("rise", 0.05, 0.3) if kind != "tripod" else p.uniform("rise", 0.5, 1.0)
    back = _housing(p, colours, wide, tall, thick) if kind in ("monitor", "all-in-one", "television") else []
    head = [part.rotated(2, tilt, (0, tall / 2, 0)).moved((0, rise, 0)) for part in (*screen, *back)]
    if kind == "tripod":
        reach, hub = p.uniform("foot_reach", 0.3, 0.55), p.uniform("hub_height", 0.5, 0.8) * rise
        pole = pillar((-thick - 0.02, 0.1, 0), rise + 0.5 * tall, 0.035, colours.trim)
        legs = spokes((-thick - 0.02, hub, 0), reach, hub, 3, 0.05, colours.trim)
        return [*head, pole, _joint(rise, tall, thick, colours), *legs]
    return head + _stand(p, kind, colours, rise, wide, tall, thick)


def _screen(colours: Palette, wide: float, tall: float, thick: float, bezel: float, chin: float) -> list[Solid]:
    """A slab from y = 0 with a pane on its front, which is at x = 0."""
    return [
        slab((-thick, 0), (0, tall), wide / 2, colours.body),
        slab((-0.02, chin), (0.012, tall - bezel), wide / 2 - bezel, colours.dark),
    ]


def _housing(p: Parameters, colours: Palette, wide: float, tall: float, thick: float) -> list[Solid]:
    """The housing behind a flat screen."""
    deep, share = p.uniform("housing_depth", 0.03, 0.12), p.uniform("housing_size", 0.4, 0.75)
    low, high = (-thick - deep, 0.5 * tall * (1 - share)), (-thick + 0.01, 0.5 * tall * (1 + share))
    return [slab(low, high, wide / 2 * share, colours.trim)]


def _joint(rise: float, tall: float, thick: float, colours: Palette) -> Solid:
    return box((-thick - 0.03, rise + 0.5 * tall, 0), (0.14, 0.16, 0.16), colours.detail)


def _stand(
    p: Parameters, kind: str, colours: Palette, rise: float, wide: float, tall: float, thick: float
) -> list[Solid]:
    """The stand, on y = 0, of the slab, whose lower edge is at ``rise``."""
    usual = ("disc", "plate", "V", "arm", "easel", "bent sheet")
    stand = p.choice("stand", ("two feet", "V", "plate", "disc") if kind == "television" else usual)
    neck, reach = p.uniform("neck_width", 0.05, 0.16), p.uniform("foot_reach", 0.16, 0.3)
    broad = p.uniform("foot_width", 0.35, 0.7) * wide
    x, up = -0.5 * thick, rise + 0.5 * tall
    joint = _joint(rise, tall, thick, colours)
    post = slab((-thick - 0.1, 0), (-thick - 0.04, up), neck / 2, colours.trim)
    if stand == "two feet":
        head = (x, rise + 0.05, 0.36 * wide)
        return pair(*(bar((x + s * reach, 0, 0.36 * wide), head, 0.05, 0.05, colours.trim) for s in (-1, 1)))
    if stand == "V":
        fork = [bar((reach, 0.0, 0.45 * broad), (-thick - 0.07, 0.06, 0.0), 0.12, 0.05, colours.trim)]
        return [post, joint, *pair(*fork)]
    if stand == "plate":
        return [post, joint, slab((-reach - 0.1, 0), (reach, 0.035), broad / 2, colours.trim)]
    if stand == "disc":
        disc = pillar((0, 0, 0), 0.04, 1.0, colours.trim).scaled((reach, 1, 0.5 * broad)).moved((-thick, 0, 0))
        return [post, joint, disc, pillar((-thick - 0.07, 0.03, 0), 0.12, 0.8 * neck, colours.trim, 0.4 * neck)]
    if stand == "arm":
        back = -thick - 0.35
        upright, arm = (
            pillar((back, 0, 0), up, 0.04, colours.trim),
            rod((back, up - 0.05, 0), -thick, 0.035, colours.trim),
        )
        return [upright, arm, joint, slab((back - 0.12, 0), (back + 0.12, 0.05), 0.12, colours.detail)]
    if stand == "easel":
        legs = [bar((-thick - 0.3, 0, 0.25 * broad), (-thick - 0.02, up, 0.12 * broad), 0.05, 0.05, colours.trim)]
        fronts = [bar((0.08, 0, 0.4 * broad), (-thick, rise + 0.1, 0.4 * broad), 0.05, 0.05, colours.trim)]
        return [
            joint,
            *pair(*legs, *fronts),
            box((-thick - 0.3, 0.025, 0), (0.05, 0.05, 0.5 * broad), colours.trim),
            box((-0.5 * thick, rise, 0), (thick + 0.1, 0.05, broad), colours.trim),
        ]
    sheet = bar((-thick - 0.35, 0, 0), (-thick, up, 0), 0.045, 0.5 * broad, colours.trim)
    return [sheet, joint, slab((-thick - 0.37, 0), (reach, 0.035), 0.25 * broad, colours.trim)]


def _laptop(p: Parameters, colours: Palette, screen: list[Solid], wide: float, tilt: float) -> list[Solid]:
    deep, thick = p.uniform("base_depth", 0.5, 0.72) * wide, p.uniform("base_thickness", 0.04, 0.07)
    margin = p.uniform("keyboard_margin", 0.05, 0.1)
    low, high = (0.25 * deep, thick - 0.02, -wide / 2 + margin), (0.62 * deep, thick + 0.012, wide / 2 - margin)
    keys = [part.moved((-0.18 * deep, 0, 0)) for part in rack(low, high, 0, 4, colours.dark, 0.7)]
    pad = slab((0.68 * deep, thick - 0.01), (0.92 * deep, thick + 0.008), 0.15 * wide, colours.detail)
    hinge = cylinder((0, thick, -0.4 * wide), (0, thick, 0.4 * wide), 0.03, colours.trim)
    angle = tilt + p.uniform("opening", 0, 18)
    lid = [part.rotated(2, angle).moved((0.02, thick - 0.01, 0)) for part in screen]
    return [*lid, slab((-0.02, 0), (deep, thick), wide / 2, colours.body), *keys, pad, hinge]


def _tube(p: Parameters, colours: Palette, screen: list[Solid], wide: float, tall: float, thick: float) -> list[Solid]:
    """A cathode ray tube's box: it narrows towards the back."""
    deep, shrink = p.uniform("tube_depth", 0.45, 0.8), p.uniform("tube_shrink", 0.4, 0.75)
    z, end, narrow = wide / 2, -thick - deep, shrink * wide / 2
    shell = slab((end, 0.06 * tall), (-thick + 0.02, 0.97 * tall), 0.96 * z, colours.trim)
    shell = below(shell, (end, shrink * tall), (-0.7 * thick, tall))
    for side in (-1, 1):
        shell = kept(shell, (end, 0, side * narrow), (z - narrow, 0, -side * (deep + thick)))
    stand = p.choice("stand", ("swivel", "feet", "none"))
    lift = p.uniform("stand_height", 0.05, 0.12) if stand != "none" else 0.0
    x = -0.45 * (deep + thick)
    parts = [part.moved((0, lift, 0)) for part in (*screen, shell)]
    if stand == "swivel":
        parts.append(pillar((x, 0, 0), lift + 0.12 * tall, 0.3 * wide, colours.detail, 0.2 * wide))
    elif stand == "feet":
        low, high = (-thick - 0.5 * deep, 0, 0.25 * wide), (-0.02, lift + 0.1 * tall, 0.33 * wide)
        parts += pair(block(low, high, colours.detail))
    size = p.uniform("knob", 0.02, 0.035)
    knobs = [rod((-0.02, lift + y * tall, 0.44 * wide), 0.03, size, colours.detail) for y in (0.06, 0.14)]
    return parts + knobs
