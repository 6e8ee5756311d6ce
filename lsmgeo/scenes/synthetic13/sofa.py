"""Sofas.

Structures: a plan (straight, corner left, corner right, daybed, round), arms (box, roll, slanted, wing, none), a back
(block, cushions, roll, camel, rail), a support (plinth, legs, frame), loose cushions or none, a chaise with or
without a back.
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, cylinder, ellipsoid
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Pair, Point, bar, below, block, pair, pillar, rod, slab, spaced, window

__all__ = ["build"]


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one sofa, in metres; its front is +x, its width along z."""
    plan = p.choice("plan", ("straight", "straight", "corner left", "corner right", "daybed", "round"))
    arms = p.choice("arms", ("box", "roll", "slanted", "wing", "none")) if plan != "round" else "none"
    seats = p.count("seats", 1, 4) if plan == "straight" else p.count("seats", 2, 4)
    width = seats * p.uniform("seat_width", 0.5, 0.75)
    depth, frame = p.uniform("depth", 0.6, 1.05), p.uniform("frame_height", 0.1, 0.22)
    cushion, arm = p.uniform("cushion", 0.1, 0.2), p.uniform("arm_width", 0.1, 0.28)
    rise, back = p.uniform("back_height", 0.25, 0.65), p.uniform("back_thickness", 0.14, 0.3)
    support = p.choice("support", ("plinth", "legs", "legs", "frame") if plan != "round" else ("legs", "plinth"))
    lift = p.uniform("clearance", 0.04, 0.08) if support == "plinth" else p.uniform("clearance", 0.1, 0.24)
    x, z = depth / 2, width / 2
    floor = lift + frame
    height = floor + cushion

    if plan == "round":
        parts = _round(p, support, colours, (lift, floor, height), rise, back, x, z)
    else:
        parts = [slab((-x, lift), (x, floor), z, colours.body)]
        for low, high in _pieces(-z, z, seats):
            parts.append(block((-x + back - 0.02, floor - 0.02, low), (x + 0.02, height, high), colours.trim))
        if plan != "daybed":
            parts += _back(p, colours, (lift, floor, height + rise), (x, z), back, seats)
        else:
            bolster = rod((-x, height + 0.1, -z + 0.12), x, 0.14, colours.trim)
            parts += [bolster, block((-x, lift, -z - 0.06), (x, height + 0.6 * rise, -z), colours.body)]
        parts += _arms(p, arms, plan, colours, (lift, height), (x, z), arm, back)
    if plan.startswith("corner"):
        parts += _chaise(p, colours, 1 if plan.endswith("right") else -1, (lift, floor, height), (x, z), width / seats)
    if plan != "round":
        parts += _support(p, support, colours, lift, x, z)
    if plan == "straight" and p.choice("loose", ("none", "cushions")) == "cushions":
        size = p.uniform("loose_size", 0.16, 0.24)
        pillow = ellipsoid((-x + back + 0.1, height + 0.85 * size, z - 1.1 * size), (0.09, size, size), colours.detail)
        parts += pair(pillow.rotated(2, 15, (-x + back + 0.1, height, 0)))
    return parts


def _pieces(low: float, high: float, count: int) -> list[Pair]:
    """An interval in ``count`` pieces with seams between them."""
    step = (high - low) / count
    return [(low + index * step + 0.012, low + (index + 1) * step - 0.012) for index in range(count)]


def _back(p: Parameters, colours: Palette, levels: Point, half: Pair, thick: float, seats: int) -> list[Solid]:
    """The back rest along the rear edge."""
    form = p.choice("back", ("block", "cushions", "roll", "camel", "rail"))
    (lift, floor, top), (x, z) = levels, half
    lean = p.uniform("back_lean", 2, 16)
    pivot = (-x, floor, 0)
    wall = slab((-x, lift), (-x + thick, top), z, colours.body)
    if form == "block":
        return [wall.rotated(2, lean / 3, pivot)]
    if form == "cushions":
        low = slab((-x, lift), (-x + 0.45 * thick, top - 0.06), z, colours.body)
        ends = (((-x + 0.3 * thick, floor + 0.05, a), (-x + 1.2 * thick, top, b)) for a, b in _pieces(-z, z, seats))
        return [low, *(block(*corners, colours.trim).rotated(2, lean, pivot) for corners in ends)]
    if form == "roll":
        level = top - 0.5 * thick
        roll = cylinder((-x + 0.4 * thick, level, -z), (-x + 0.4 * thick, level, z), 0.55 * thick, colours.body)
        return [slab((-x, lift), (-x + 0.8 * thick, level), z, colours.body), roll]
    if form == "camel":
        hump = ellipsoid((-x + 0.5 * thick, top - 0.12, 0), (0.5 * thick, 0.24, 0.75 * z), colours.body)
        return [slab((-x, lift), (-x + thick, top - 0.1), z, colours.body), hump]
    level = 0.6 * floor + 0.4 * top
    rails = ((level - 0.06, level), (top - 0.09, top))
    parts = [slab((-x, low), (-x + 0.07, high), z, colours.detail) for low, high in rails]
    for place in (-z + 0.04, 0.0, z - 0.04):
        parts.append(block((-x, lift, place - 0.04), (-x + 0.07, top, place + 0.04), colours.detail))
    for a, b in _pieces(-z, z, seats):
        parts.append(block((-x + 0.05, floor + 0.05, a), (-x + 0.05 + 0.8 * thick, top - 0.08, b), colours.trim))
    return parts


def _arms(
    p: Parameters, arms: str, plan: str, colours: Palette, levels: Pair, half: Pair, width: float, back: float
) -> list[Solid]:
    """Arm rests outside the seat: none on a daybed, one opposite the chaise of a corner sofa."""
    (lift, height), (x, z) = levels, half
    if arms == "none" or plan == "daybed":
        return []
    rise = p.uniform("arm_height", 0.12, 0.28)
    top = height + rise
    front = x - p.uniform("arm_setback", 0.0, 0.12)
    if arms == "box":
        parts = [block((-x, lift, z - 0.01), (front, top, z + width), colours.body)]
    elif arms == "roll":
        radius = 0.62 * width
        parts = [
            block((-x, lift, z - 0.01), (front, top - 0.5 * radius, z + 0.8 * width), colours.body),
            rod((-x, top - radius, z + 0.5 * width), front + 0.02, radius, colours.body),
        ]
    elif arms == "slanted":
        body = block((-x, lift, z - 0.01), (front, top + 0.25, z + width), colours.body)
        parts = [below(body, (-x, top + 0.25), (front, height + 0.02))]
    else:
        # Wings: the arm ends in an ear beside the back.
        parts = [
            block((-x, lift, z - 0.01), (front, top, z + 0.7 * width), colours.body),
            block((-x, top - 0.05, z - 0.01), (-x + 1.8 * back, top + 0.3, z + 0.5 * width), colours.body),
        ]
    if plan.startswith("corner"):
        side = -1 if plan.endswith("right") else 1
        return parts if side > 0 else [part.mirrored(2) for part in parts]
    return pair(*parts)


def _chaise(p: Parameters, colours: Palette, side: int, levels: Point, half: Pair, piece: float) -> list[Solid]:
    """The long seat at one end, towards +x, with or without its own back."""
    (lift, floor, height), (x, z) = levels, half
    reach, wide = p.uniform("chaise_length", 0.5, 1.3), 1.1 * piece
    out = x + reach
    parts = [
        block((-x, lift, z - wide), (out, floor, z), colours.body),
        block((x + 0.04, floor - 0.02, z - wide + 0.012), (out, height, z - 0.012), colours.trim),
        block((out - 0.14, 0, z - 0.12), (out - 0.05, lift + 0.01, z - 0.04), colours.detail),
        block((out - 0.14, 0, z - wide + 0.04), (out - 0.05, lift + 0.01, z - wide + 0.12), colours.detail),
    ]
    if p.choice("chaise", ("open", "backed")) == "backed":
        rise = p.uniform("chaise_back", 0.25, 0.5)
        parts.append(block((-x, lift, z - 0.01), (out, height + rise, z + 0.18), colours.body))
    return [part.scaled((1, 1, side)) for part in parts]


def _support(p: Parameters, support: str, colours: Palette, lift: float, x: float, z: float) -> list[Solid]:
    width = p.uniform("leg_width", 0.05, 0.1)
    if support == "plinth":
        return [slab((-x + 0.06, 0), (x - 0.06, lift + 0.01), z - 0.06, colours.detail)]
    near, side = x - 0.12, z - 0.1
    if support == "legs":
        ends = (((s * (near + 0.03), 0, side + 0.03), (s * near, lift + 0.02, side)) for s in (-1, 1))
        return pair(*(bar(foot, head, width, width, colours.detail) for foot, head in ends))
    return pair(*window((-near, 0, side - width), (near, lift + 0.05, side), 2, 0.05, colours.detail)[:4])


def _round(
    p: Parameters, support: str, colours: Palette, levels: Point, rise: float, back: float, x: float, z: float
) -> list[Solid]:
    """A round sofa: an oval seat in a curved back that is open at the front."""
    lift, floor, height = levels
    opening = p.uniform("opening", -0.2, 0.5) * x
    inner = max(1 - 0.9 * back / min(x, z), 0.5)

    def oval(low: float, high: float, share: float) -> Solid:
        return pillar((0, low, 0), high, share, colours.body).scaled((x, 1.0, z))

    front = box((opening + 5, height + 5, 0), (10, 10, 10))
    shell = oval(lift, height + rise, 1.0).minus(oval(floor, height + 2 * rise, inner), front)
    parts = [shell, oval(lift, floor - 0.03, 1.0), oval(lift + 0.01, height, inner + 0.02).painted(colours.trim)]
    size = p.uniform("leg_width", 0.05, 0.1)
    if support == "plinth":
        parts.append(oval(0, lift + 0.01, 1 - size).painted(colours.detail))
    else:
        legs = (pillar((s * 0.55 * x, 0, 0.55 * z), lift + 0.02, size / 2, colours.detail) for s in (-1, 1))
        parts += pair(*legs)
    reach = min(0.5 * rise, 0.3)
    for place in spaced(-0.5 * z, 0.5 * z, 2):
        parts.append(ellipsoid((-inner * x + 0.16, height + reach, place), (0.1, reach, 0.28 * z), colours.detail))
    return parts
