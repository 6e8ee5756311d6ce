"""Cars.

Structures: a kind (sedan, hatchback, off-roader, van, pickup, coupe, convertible, beetle, racing car, lorry), lamps
(round, square) and, where they apply, a roof load (none, rails, box, sign) and what is at the rear (none, spare
wheel, spoiler).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, ellipsoid, sphere
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Pair, bar, below, block, kept, pair, rod, slab, wheel

__all__ = ["build"]

KINDS = ("sedan", "hatchback", "off-roader", "van", "pickup", "coupe", "convertible", "beetle", "racing car", "lorry")
# For each kind: length, width, height of the lower body, height of the cabin; where the windscreen and the rear
# window meet the body, as fractions of the length from the rear; the insets of their upper ends, as fractions of the
# cabin's height.
SHAPES = {
    "sedan": (4.6, 1.75, 0.62, 0.52, 0.70, 0.14, 1.1, 1.0),
    "hatchback": (3.8, 1.65, 0.66, 0.62, 0.72, 0.0, 0.9, 0.35),
    "off-roader": (4.3, 1.85, 0.8, 0.75, 0.68, 0.0, 0.35, 0.05),
    "van": (4.6, 1.85, 0.85, 1.0, 0.9, 0.0, 0.55, 0.03),
    "pickup": (5.0, 1.85, 0.75, 0.65, 0.72, 0.38, 0.7, 0.1),
    "coupe": (4.3, 1.8, 0.52, 0.45, 0.62, 0.08, 1.4, 1.9),
    "convertible": (4.2, 1.75, 0.6, 0.35, 0.62, 0.22, 0.9, 1.0),
    "beetle": (3.9, 1.6, 0.6, 0.7, 0.75, 0.05, 0.8, 0.8),
    "lorry": (5.2, 1.9, 0.5, 1.35, 0.98, 0.7, 0.2, 0.02),
}


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one car, in metres."""
    kind = p.choice("kind", KINDS)
    lamps = p.choice("lamps", ("round", "square"))
    radius, tread = p.uniform("wheel_radius", 0.28, 0.4), p.uniform("tyre_width", 0.18, 0.3)
    if kind == "racing car":
        return _racing_car(p, colours, radius, tread)
    length, width, belt, cabin, front, rear, rake, slope = SHAPES[kind]
    length *= p.uniform("length", 0.82, 1.18)
    width *= p.uniform("width", 0.88, 1.12)
    belt *= p.uniform("body_height", 0.85, 1.25)
    cabin *= p.uniform("cabin_height", 0.85, 1.25)
    front += p.uniform("windscreen_place", -0.05, 0.04) if kind not in ("van", "lorry") else 0.0
    clearance = p.uniform("clearance", 0.18, 0.3) + (0.15 if kind == "off-roader" else 0.0)
    if kind in ("off-roader", "lorry"):
        radius *= 1.2
    x, z, waist = length / 2, width / 2, clearance + belt
    top = waist + cabin
    windscreen, window = -x + front * length, -x + rear * length
    # A roof remains between the slopes of a short car.
    steeper = min(1.0, 0.75 * (front - rear) * length / ((rake + slope) * cabin))
    rake, slope = steeper * rake, steeper * slope

    parts = _body(p, kind, colours, (x, z), clearance, waist)
    if kind == "convertible":
        tub = slab((window, clearance + 0.3 * belt), (windscreen, waist + 1.0), z - 0.18, colours.dark)
        parts[0] = parts[0].minus(tub)
        glass = bar((windscreen, waist - 0.03, 0), (windscreen - 0.6 * cabin, top, 0), 0.12, width - 0.2, colours.dark)
        middle = 0.5 * (windscreen + window)
        foot, head = (middle, clearance + 0.25 * belt, 0.24 * width), (middle - 0.15, waist + 0.25, 0.24 * width)
        parts += [glass, *pair(bar(foot, head, 0.2, 0.3 * width, colours.trim))]
    else:
        parts += _cabin(kind, colours, (window, windscreen), (waist, top), z, rake * cabin, slope * cabin)
    if kind == "pickup":
        bed = slab((-x + 0.12, clearance + 0.35 * belt), (window - 0.1, waist + 1), z - 0.14, colours.dark)
        parts[0] = parts[0].minus(bed)
    if kind == "lorry":
        cargo = p.uniform("cargo_height", 0.7, 1.25) * cabin
        parts.append(slab((-x, waist - 0.02), (window - 0.1, waist + cargo), 1.05 * z, colours.trim))
    base = p.uniform("wheelbase", 0.56, 0.66) * length / 2
    side = z - 0.35 * tread
    for place in (base, -base):
        parts += pair(*wheel((place, radius, side), radius, tread, colours.dark, colours.detail))
    # A beetle's lamps are on its wings, which end before its nose.
    parts += _lamps(lamps, colours, 0.88 * x if kind == "beetle" else x, z, clearance + 0.6 * belt)
    bumper = box((0, clearance + 0.12 * belt + 0.05, 0), (length + 0.12, 0.14, 1.9 * z), colours.detail)
    lean = (rake * cabin, slope * cabin)
    return [*parts, bumper, *_extras(p, kind, colours, (window, windscreen), (waist, top), (x, z), lean)]


def _body(p: Parameters, kind: str, colours: Palette, half: Pair, low: float, waist: float) -> list[Solid]:
    """The lower body, its bonnet sloping to the front; the first part is the one that may be hollowed."""
    x, z = half
    nose = p.uniform("nose_drop", 0.1, 0.35) * (waist - low)
    bonnet = {"van": 0.08, "lorry": 0.04}.get(kind, p.uniform("bonnet", 0.25, 0.36)) * 2 * x
    if kind == "beetle":
        hull = ellipsoid((0, 0.5 * (low + waist), 0), (x, 0.5 * (waist - low), 0.85 * z), colours.body)
        wings = [
            ellipsoid((s * 0.62 * x, low + 0.3, 0.8 * z), (0.28 * x, 0.4, 0.26 * z), colours.trim) for s in (-1, 1)
        ]
        return [hull, *pair(*wings), slab((-0.75 * x, low), (0.75 * x, low + 0.15), 0.9 * z, colours.trim)]
    body = slab((-x, low), (x, waist), z, colours.body)
    return [
        below(body, (x - bonnet, waist), (x, waist - nose)),
        slab((-0.98 * x, low - 0.05), (0.97 * x, low + 0.1), 0.8 * z, colours.dark),
    ]


def _cabin(kind: str, colours: Palette, ends: Pair, levels: Pair, z: float, rake: float, slope: float) -> list[Solid]:
    """Panes all around, a roof and pillars."""
    (rear, front), (waist, top) = ends, levels
    if kind == "beetle":
        # One dome in three storeys: body, panes, roof.
        middle, tall, reach = (rear + front) / 2, 0.5 * (top - waist) + 0.3, 0.55 * (front - rear)
        level = top - tall
        panes = ellipsoid((middle, level, 0), (reach, tall, 0.82 * z), colours.dark)
        shell = ellipsoid((middle, level, 0), (1.02 * reach, 1.02 * tall, 0.84 * z), colours.body)
        foot = kept(shell, (0, waist + 0.05, 0), (0, -1, 0))
        roof = kept(shell, (0, waist + 0.7 * (top - waist), 0), (0, 1, 0))
        pillar = kept(kept(shell, (middle - 0.2, 0, 0), (1, 0, 0)), (middle - 0.05, 0, 0), (-1, 0, 0))
        return [panes, foot, roof, pillar]
    tumble = 0.12 * z
    glass = slab((rear, waist - 0.05), (front, top - 0.06), 0.96 * z, colours.dark)
    glass = below(below(glass, (front - rake, top), (front, waist)), (rear, waist), (rear + slope, top))
    roof = slab((rear + slope, top - 0.1), (front - rake, top), 0.96 * z - tumble, colours.body)
    place = 0.5 * (rear + slope + front - rake)
    pillars = []
    for start, end, width in (
        (front - 0.04, front - rake - 0.02, 0.09),
        (rear + 0.05, rear + slope + 0.03, 0.16),
        (place, place, 0.12),
    ):
        low, high = (start, waist - 0.05, 0.95 * z), (end, top - 0.03, 0.95 * z - 0.5 * tumble)
        pillars.append(bar(low, high, width, 0.1, colours.body))
    if kind == "van":
        panel = block((rear, waist - 0.05, 0.5 * z), (0.45 * rear + 0.55 * front, top - 0.02, 0.97 * z), colours.body)
        pillars.append(panel)
    return [glass, roof, *pair(*pillars)]


def _lamps(lamps: str, colours: Palette, x: float, z: float, level: float) -> list[Solid]:
    if lamps == "round":
        front = rod((x - 0.1, level, 0.68 * z), x + 0.04, 0.13, colours.detail)
    else:
        front = box((x - 0.02, level, 0.66 * z), (0.12, 0.16, 0.42 * z), colours.detail)
    return pair(front, box((-x + 0.02, level, 0.75 * z), (0.1, 0.14, 0.3 * z), colours.trim))


def _extras(
    p: Parameters, kind: str, colours: Palette, ends: Pair, levels: Pair, half: Pair, lean: Pair
) -> list[Solid]:
    (rear, front), (waist, top), (x, z) = ends, levels, half
    first, last = rear + lean[1], front - lean[0]
    parts = []
    if kind not in ("convertible", "beetle", "lorry"):
        load = p.choice("roof", ("none", "none", "rails", "box", "sign"))
        if load == "rails":
            parts += pair(block((first, top - 0.02, 0.6 * z), (last, top + 0.1, 0.68 * z), colours.detail))
        elif load == "box":
            radii = (0.5 * (last - first), 0.2, 0.5 * z)
            parts.append(ellipsoid(((first + last) / 2, top + 0.1, 0), radii, colours.trim))
        elif load == "sign":
            parts.append(box(((first + last) / 2, top + 0.1, 0), (0.22, 0.25, 0.6 * z), colours.trim))
    if kind in ("off-roader", "sedan", "coupe", "hatchback"):
        extra = p.choice("rear", ("none", "spare") if kind == "off-roader" else ("none", "spoiler"))
        if extra == "spare":
            parts += wheel((0, 0, 0), 0.36, 0.24, colours.dark, colours.detail)
            parts[-2:] = [part.rotated(1, 90).moved((-x - 0.1, waist, 0)) for part in parts[-2:]]
        elif extra == "spoiler":
            level = top if kind == "hatchback" else waist + 0.22
            at = first - 0.05 if kind == "hatchback" else -x + 0.15
            parts.append(box((at, level, 0), (0.35, 0.08, 1.7 * z), colours.detail))
            if kind != "hatchback":
                parts += pair(box((at, waist + 0.08, 0.6 * z), (0.12, 0.3, 0.1), colours.detail))
    if kind == "beetle":
        return parts
    mirror = box((front - 0.25, waist + 0.08, z + 0.06), (0.1, 0.14, 0.22), colours.trim)
    return parts + pair(mirror)


def _racing_car(p: Parameters, colours: Palette, radius: float, tread: float) -> list[Solid]:
    """A single-seater with free wheels and two wings."""
    length, track = p.uniform("length", 3.8, 5.2), p.uniform("width", 1.4, 2.0)
    tub, pod = p.uniform("tub_width", 0.35, 0.5), p.uniform("pod_width", 0.25, 0.45)
    high, low = p.uniform("wing_height", 0.75, 1.1), 0.15
    waist = p.uniform("body_height", 0.5, 0.65)
    x, z = length / 2, track / 2
    body = slab((-x + 0.3, low), (0.35 * x, waist), tub, colours.body)
    body = body.minus(sphere((-0.05 * x, waist + 0.05, 0), 0.28))
    nose = slab((0.3 * x, low + 0.03), (x, waist - 0.02), 0.6 * tub, colours.body)
    parts = [
        body,
        below(nose, (0.3 * x, waist), (x, 0.55 * waist)),
        sphere((-0.07 * x, waist + 0.12, 0), 0.17, colours.trim),
        ellipsoid((-0.5 * x, waist + 0.05, 0), (0.4 * x, 0.35, 0.22), colours.body),
        *pair(block((-0.65 * x, low, tub - 0.05), (0.05 * x, 0.8 * waist, tub + pod), colours.trim)),
        box((x - 0.1, low + 0.1, 0), (0.5, 0.12, 1.9 * z), colours.trim),
        box((-x + 0.25, high, 0), (0.5, 0.12, 1.3 * z), colours.trim),
        *pair(block((-x, 0.5 * waist, 0.62 * z), (-x + 0.5, high + 0.12, 0.68 * z), colours.detail)),
        slab((-x + 0.1, 0.4), (-x + 0.3, 0.6), 0.62 * z, colours.detail),
    ]
    for place, size in ((0.66 * x, radius * 1.0), (-x + 0.75, radius * 1.15)):
        parts += pair(*wheel((place, size, z - tread), size, 1.4 * tread, colours.dark, colours.detail))
        parts.append(box((place, radius, 0), (0.14, 0.14, 2 * z - 2 * tread), colours.detail))
    return parts
