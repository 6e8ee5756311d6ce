"""Cabinets.

Structures: a kind (bookcase, doors, drawers, shelf over doors, grid, hutch, ladder shelf, niche), a form (tall, square,
wide), a stand (none, plinth, legs, tall legs, wheels), handles (knobs, bars, none), a top (flush, overhanging) and,
where shelves are, a back (closed, open).
"""

from __future__ import annotations

from lsmgeo.scenes.primitives import Solid, box, sphere
from lsmgeo.scenes.synthetic13.parameters import Palette, Parameters
from lsmgeo.scenes.synthetic13.parts import Point, bar, block, pair, slab, spaced

__all__ = ["build"]

KINDS = ("bookcase", "doors", "drawers", "shelf over doors", "grid", "hutch", "ladder shelf", "niche", "bookcase")


def build(p: Parameters, colours: Palette) -> list[Solid]:
    """The parts of one cabinet; its front is at +x, its width along z."""
    kind = p.choice("kind", KINDS)
    form = p.choice("form", ("tall", "square", "wide"))
    stand = p.choice("stand", ("none", "plinth", "legs", "tall legs", "wheels")) if kind != "ladder shelf" else "none"
    height = p.uniform("height", *{"tall": (1.3, 2.2), "square": (0.7, 1.1), "wide": (0.35, 0.7)}[form])
    width = p.uniform("width", *{"tall": (0.4, 0.9), "square": (0.6, 1.2), "wide": (1.2, 2.2)}[form])
    depth, wall = p.uniform("depth", 0.22, 0.75), p.uniform("wall", 0.035, 0.08)
    if kind == "ladder shelf":
        return _ladder(p, colours, height, width, depth, wall)
    lift = p.uniform("stand_height", 0.06, 0.14) if stand != "none" else 0.0
    lift *= 3 if stand == "tall legs" else 1
    x, z = depth / 2, width / 2
    low, high = (-x, lift, -z), (x, lift + height, z)

    parts = _stand(p, stand, colours, lift, x, z)
    split = lift + height * (p.uniform("division", 0.35, 0.6) if kind in ("shelf over doors", "hutch") else 1.0)
    if kind in ("bookcase", "grid"):
        parts += _shelves(p, colours, low, high, wall, uprights=kind == "grid")
    elif kind in ("doors", "drawers"):
        foot = (-x, lift + wall, -z)  # a kick board is left below the fronts
        parts += [block(low, high, colours.body), *_fronts(p, kind, colours, foot, high)]
    elif kind == "shelf over doors":
        parts += _shelves(p, colours, (-x, split, -z), high, wall, uprights=False)
        parts += [block(low, (x, split, z), colours.body), *_fronts(p, "doors", colours, low, (x, split, z))]
    elif kind == "hutch":
        shallow = p.uniform("hutch_depth", 0.35, 0.6) * depth
        parts += [block(low, (x, split, z), colours.body), *_fronts(p, "drawers", colours, low, (x, split, z))]
        parts += _shelves(p, colours, (-x, split - 0.01, -z), (-x + shallow, lift + height, z), wall, uprights=False)
    else:
        # One body with an open niche through its front, and doors beside or below.
        room = p.uniform("niche", 0.35, 0.6)
        if form == "wide":
            edge = -z + room * width
            hole = block((-0.7 * x, lift + wall, -z + wall), (2 * x, lift + height - wall, edge), colours.body)
            front_low, front_high = (-x, lift, edge + wall), high
        else:
            edge = lift + (1 - room) * height
            hole = slab((-0.7 * x, edge), (2 * x, lift + height - wall), z - wall, colours.body)
            front_low, front_high = low, (x, edge - wall, z)
        parts += [block(low, high, colours.body).minus(hole), *_fronts(p, "doors", colours, front_low, front_high)]
    over = p.uniform("overhang", 0.02, 0.06) if p.choice("top", ("flush", "overhanging")) == "overhanging" else 0.0
    top_x, top = high[0] if kind != "hutch" else -x + shallow, high[1] + p.uniform("top_thickness", 0.02, 0.08)
    parts.append(slab((-x, high[1] - 0.01), (top_x + over, top), z + over, colours.trim))
    return parts


def _shelves(p: Parameters, colours: Palette, low: Point, high: Point, wall: float, *, uprights: bool) -> list[Solid]:
    """An open case: sides, top, bottom, shelves, a back unless it is left out."""
    (a, b, c), (d, e, f) = low, high
    parts = [
        block((a, b, c), (d, e, c + wall), colours.body),
        block((a, b, f - wall), (d, e, f), colours.body),
        block((a, b, c), (d, b + wall, f), colours.body),
        block((a, e - wall, c), (d, e, f), colours.body),
    ]
    left, right = c + wall / 2, f - wall / 2  # shelves end within the sides
    half = p.uniform("shelf_thickness", 0.03, 0.07) / 2
    inside = (a, d - p.uniform("shelf_setback", 0.0, 0.15) * (d - a))
    rows = p.count("shelves", 2, 5) if e - b > 0.8 else p.count("shelves", 1, 2)
    for y in spaced(b, e, rows)[1:] if rows > 1 else [(b + e) / 2]:
        y -= 0.5 * (e - b) / rows if rows > 1 else 0.0
        parts.append(block((inside[0], y - half, left), (inside[1], y + half, right), colours.trim))
    if uprights:
        columns = p.count("columns", 2, 4)
        for index in range(1, columns):
            place = c + index * (f - c) / columns
            parts.append(block((inside[0], b, place - wall / 2), (inside[1], e, place + wall / 2), colours.trim))
    if p.choice("back", ("closed", "open", "closed")) == "closed":
        rear = a + p.uniform("back_thickness", 0.03, 0.06)
        parts.append(block((a, b + wall / 2, left), (rear, e - wall / 2, right), colours.detail))
    else:
        middle, across = (b + e) / 2, p.uniform("brace", 0.06, 0.14)
        parts.append(block((a, middle - across, left), (a + 0.04, middle + across, right), colours.detail))
    return parts


def _fronts(p: Parameters, kind: str, colours: Palette, low: Point, high: Point) -> list[Solid]:
    """Doors or drawers with handles, a little proud of the front."""
    (_, b, c), (x, e, f) = low, high
    c, f = c + p.uniform("stile", 0.0, 0.05), f - p.numbers["stile"]
    handles = p.choice("handles", ("knobs", "bars", "none"))
    proud, gap = p.uniform("front_thickness", 0.02, 0.05), p.uniform("front_gap", 0.02, 0.05)
    cells: list[tuple[float, float, float, float]] = []
    if kind == "doors":
        count = p.count("doors", 1, 2) if f - c < 1.0 else p.count("doors", 2, 4)
        step = (f - c) / count
        cells = [(b, e, c + index * step, c + (index + 1) * step) for index in range(count)]
    else:
        most = max(1, min(5, int((e - b) / 0.17)))
        rows = p.count("drawers", min(2, most), most)
        columns = 1 if f - c < 1.0 else 2
        tall, wide = (e - b) / rows, (f - c) / columns
        cells = [
            (b + row * tall, b + (row + 1) * tall, c + column * wide, c + (column + 1) * wide)
            for row in range(rows)
            for column in range(columns)
        ]
    parts = []
    for index, (y0, y1, z0, z1) in enumerate(cells):
        parts.append(block((x - 0.01, y0 + gap, z0 + gap), (x + proud, y1 - gap, z1 - gap), colours.trim))
        y, z = (y0 + y1) / 2, (z0 + z1) / 2
        if kind == "doors":
            z = z1 - 2.5 * gap - 0.02 if index % 2 == 0 else z0 + 2.5 * gap + 0.02
        if handles == "knobs":
            parts.append(sphere((x + proud + 0.01, y, z), 0.03, colours.detail))
        elif handles == "bars":
            size = (0.05, 0.35 * (y1 - y0), 0.035) if kind == "doors" else (0.05, 0.035, 0.4 * (z1 - z0))
            parts.append(box((x + proud, y, z), size, colours.detail))
    return parts


def _stand(p: Parameters, stand: str, colours: Palette, lift: float, x: float, z: float) -> list[Solid]:
    if stand == "none":
        return []
    width = p.uniform("stand_width", 0.04, 0.09)
    if stand == "plinth":
        return [slab((-x + 0.02, 0), (x - width, lift + 0.01), z - width, colours.detail)]
    if stand == "wheels":
        return pair(*(sphere((s * (x - width), lift / 2, z - width), lift / 2 + 0.02, colours.dark) for s in (-1, 1)))
    lean = 0.5 * width
    ends = (((s * (x - width + lean), 0, z - width + lean), (s * (x - width), lift + 0.02, z - width)) for s in (-1, 1))
    return pair(*(bar(foot, head, width, width, colours.detail) for foot, head in ends))


def _ladder(p: Parameters, colours: Palette, height: float, width: float, depth: float, wall: float) -> list[Solid]:
    """Leaning uprights with shelves that get shallower towards the top."""
    x, z, lean = depth / 2, width / 2, p.uniform("lean", 0.3, 0.8) * depth
    rows, post = p.count("shelves", 3, 5), p.uniform("post", 0.04, 0.08)
    over, rail = p.uniform("shelf_overhang", 0.0, 0.06), p.uniform("rail", 0.03, 0.08)
    uprights = pair(bar((x, 0, z), (x - lean, height, z), post, post, colours.body))
    rear = pair(block((-x, 0, z - post / 2), (-x + post, height, z + post / 2), colours.body))
    shelves = []
    for y in spaced(0, height, rows):
        front = x - lean * y / height
        shelves.append(slab((-x, y - wall / 2), (front + 0.02 + over, y + wall / 2), z, colours.trim))
    shelves.append(slab((-x, height - rail), (-x + post, height), z, colours.trim))
    return uprights + rear + shelves
