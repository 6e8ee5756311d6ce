"""First hits of rays with scenes: the surface, and the ray parameter.

Every primitive gives one interval of the ray; a subtracted one moves the start of its solid's interval to its own end.
The nearest start is the hit. A single view tests each solid only in the pixels that can show it; batched views test all
their solids of one kind at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._linalg import multiply, transform
from lsmgeo.cameras.matrices import CameraMatrices
from lsmgeo.scenes.intervals import interval
from lsmgeo.scenes.primitives import Kind
from lsmgeo.scenes.tables import Placed, Scene, Tables, layout

__all__ = ["CameraRays", "FreeRays", "Plan", "first_hits", "make_plan"]

Window = tuple[slice, slice]
EVERYTHING = (slice(None), slice(None))
# At cuts, surfaces closer than this many roundings of the ray parameter coincide.
ROUNDINGS = 16


class Visit(NamedTuple):
    """Solids of one kind that are intersected together, at most one per view."""

    kind: Kind
    rows: list[int]  # (M,) rows of the plan's tables, one for each view of `views`
    views: list[int]  # (M,)
    cuts: list[tuple[Kind, list[int], list[int]]]  # of each cut: kind, which of the M have it, and its rows

    def pairs(self) -> list[tuple[int, int]]:
        """(row, view) of all primitives that are intersected."""
        cut = [
            (row, self.views[member]) for _, which, rows in self.cuts for member, row in zip(which, rows, strict=True)
        ]
        return list(zip(self.rows, self.views, strict=True)) + cut


class Plan(NamedTuple):
    """The solids of V views of scenes. A row of the tables is one primitive of one scene."""

    tables: Tables
    visits: list[Visit]


def make_plan(scenes: Sequence[Scene], owner: Sequence[int], device: torch.device) -> Plan:
    """Group the solids that are intersected together.

    Args:
        scenes: S scenes.
        owner: (V,) which scene each view shows.
        device: for the tables, which stay float64.
    """
    rows_of, placed = layout(scenes)
    # The first solid of a kind in every view, then the second, and so on.
    grouped: dict[tuple[Kind, int], list[tuple[int, Placed]]] = {}
    for view, scene_index in enumerate(owner):
        counts: dict[Kind, int] = {}
        for entry in placed[scene_index]:
            counts[entry.kind] = counts.get(entry.kind, 0) + 1
            grouped.setdefault((entry.kind, counts[entry.kind]), []).append((view, entry))

    visits = []
    for (kind, _), members in grouped.items():
        # Cuts of the same kind and index in their solid's list are grouped.
        cut: dict[tuple[int, Kind], tuple[list[int], list[int]]] = {}
        for member, (_, entry) in enumerate(members):
            for place, (cut_kind, row) in enumerate(entry.cuts):
                which, rows = cut.setdefault((place, cut_kind), ([], []))
                which.append(member)
                rows.append(row)
        rows, views = [entry.row for _, entry in members], [view for view, _ in members]
        visits.append(Visit(kind, rows, views, [(kind, *both) for (_, kind), both in cut.items()]))
    return Plan(rows_of.to(device, torch.float64), visits)


class CameraRays:
    """The rays through the pixel centres of V cameras, parametrised by depth.

    The local point of pixel (u, v) at depth t is affine in u and in v: one row and one column of numbers per primitive,
    at the depth of its centre to avoid cancellation.

    Args:
        plan: of the V views.
        cameras: float64 matrices of the V cameras, for images of this size.
        size: (H, W).
        near: surfaces below this depth are invisible.
        dtype: of the arithmetic.
    """

    def __init__(
        self, plan: Plan, cameras: CameraMatrices, size: tuple[int, int], *, near: float, dtype: torch.dtype
    ) -> None:
        pairs = [pair for visit in plan.visits for pair in visit.pairs()]
        self.index = {pair: place for place, pair in enumerate(pairs)}
        device = cameras.intrinsics.device
        rows, views = torch.tensor(pairs, device=device).unbind(1)
        self.from_pixel = cameras.world_from_pixel()
        tables = plan.tables
        linear, offset = tables.linear[rows], cameras.center[views] - tables.center[rows]
        depth = (-(offset * cameras.rotation[views, 2]).sum(-1)).clamp_min(near)
        direction = multiply(linear, self.from_pixel[views])  # (P, 3, 3): applied to (u, v, 1)
        point = direction * depth[:, None, None]
        point[:, :, 2] += transform(linear, offset)
        v, u = (torch.arange(count, dtype=torch.float64, device=device) for count in size)

        def separate(matrix: Tensor) -> tuple[Tensor, Tensor]:
            across = matrix[:, :, :1] * u
            down = matrix[:, :, 1:2] * v + matrix[:, :, 2:]
            return across[:, :, None, :].to(dtype), down[:, :, :, None].to(dtype)  # (P, 3, 1, W), (P, 3, H, 1)

        self.points, self.directions = separate(point), separate(direction)
        self.depth = depth[:, None, None].to(dtype)
        # A single view skips pixels that a primitive cannot cover.
        single = len(cameras.center) == 1
        self.windows = _windows(tables, rows, cameras, views, size, near) if single else None

    def local(self, rows: list[int], views: list[int], window: Window) -> tuple[Tensor, Tensor, Tensor]:
        """Local points and directions (M, 3, h, w) of a window's rays, and the ray parameter of the points."""
        where = [self.index[pair] for pair in zip(rows, views, strict=True)]
        which = slice(where[0], where[0] + 1) if len(where) == 1 else where
        v, u = window
        point = self.points[0][which][..., u] + self.points[1][which][..., v, :]
        direction = self.directions[0][which][..., u] + self.directions[1][which][..., v, :]
        return point, direction, self.depth[which]

    def window(self, row: int, view: int) -> Window | None:
        """The pixels where a primitive can be hit; None without any."""
        if self.windows is None:
            return EVERYTHING
        top, bottom, left, right = self.windows[self.index[row, view]]
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None


def _windows(
    tables: Tables, rows: Tensor, cameras: CameraMatrices, views: Tensor, size: tuple[int, int], near: float
) -> list[list[int]]:
    """First and last + 1 row and column of the pixels that can show a primitive, from the corners of its box."""
    corners = torch.cartesian_prod(*[rows.new_tensor([-1.0, 1.0], dtype=torch.float64)] * 3)  # (8, 3)
    world = transform(tables.axes[rows, None], corners) + tables.center[rows, None]  # (P, 8, 3)
    windows = CameraMatrices(*(value[views] for value in cameras)).windows(world, size, near)
    bounded = rows.new_tensor([kind is not Kind.HALF_SPACE for kind in tables.kinds], dtype=torch.bool)[rows, None]
    return torch.where(bounded, windows, windows.new_tensor([0, size[0], 0, size[1]])).tolist()


class FreeRays:
    """Rays from any point in any direction; the parameter is a multiple of the direction.

    Args:
        plan: of V views; its tables in the rays' dtype.
        origins: (V, 3, H, W).
        directions: (V, 3, H, W), any length above 0.
    """

    def __init__(self, plan: Plan, origins: Tensor, directions: Tensor) -> None:
        self.tables, self.origins, self.directions = plan.tables, origins, directions
        self.squared_length = directions.square().sum(1)

    def local(self, rows: list[int], views: list[int], window: Window) -> tuple[Tensor, Tensor, Tensor]:
        """As `CameraRays.local`; the window is all rays."""
        linear, center = self.tables.linear[rows], self.tables.center[rows]
        direction = self.directions[views]
        offset = self.origins[views] - center[:, :, None, None]
        # From the point nearest to the solid's centre, to avoid cancellation.
        along = -(offset * direction).sum(1) / self.squared_length[views]  # (M, H, W)
        point = offset + along[:, None] * direction
        return _apply(linear, point), _apply(linear, direction), along

    def window(self, row: int, view: int) -> Window | None:
        """All rays."""
        return EVERYTHING


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """(M, 3, 3) applied to (M, 3, H, W), elementwise: exact under autocast and TF32."""
    columns = matrices[:, :, :, None, None].unbind(2)
    x, y, z = vectors[:, None].unbind(2)
    return columns[0] * x + columns[1] * y + columns[2] * z


def first_hits(
    plan: Plan, rays: CameraRays | FreeRays, shape: tuple[int, int, int], near: float, like: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest surface that each ray enters beyond ``near``.

    A solid that contains the point at ``near`` is ignored, unless that point lies in one of its cuts.

    Args:
        plan: of V views.
        rays: of the V views.
        shape: (V, H, W).
        near: smallest ray parameter.
        like: its dtype and device.

    Returns:
        ray parameter (V, H, W), infinite where nothing is hit; row of the plan's tables (V, H, W) int32, -1 there.
    """
    nearest = like.new_full(shape, torch.inf)
    surface = torch.full(shape, -1, dtype=torch.int32, device=like.device)
    for visit in plan.visits:
        window = rays.window(visit.rows[0], visit.views[0])
        if window is None:
            continue
        start, end, who = _enter(plan.tables, visit, rays, window, near, like.dtype)
        closer = (start < end) & (start > near)
        which = (slice(None) if len(visit.views) == shape[0] else visit.views, *window)
        before = nearest[which]
        closer &= start < before
        nearest[which] = torch.where(closer, start, before)
        surface[which] = torch.where(closer, who, surface[which])
    return nearest, surface


def _enter(
    tables: Tables, visit: Visit, rays: CameraRays | FreeRays, window: Window, near: float, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """Start and end of the rays' first interval inside solids minus their cuts, and the row of the surface hit."""

    def intervals(kind: Kind, rows: list[int], views: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        point, direction, at = rays.local(rows, views, window)
        taper = tables.taper[rows, None, None].to(dtype) if kind is Kind.CONE else 1.0
        start, end = interval(kind, point, direction, taper)
        return start + at, end + at, at

    start, end, at = intervals(visit.kind, visit.rows, visit.views)
    who = torch.tensor(visit.rows, dtype=torch.int32, device=start.device)[:, None, None]
    if not visit.cuts:
        return start, end, who
    start = start.clamp_min(near)
    who = who.expand(start.shape).clone()
    # Faces that should coincide, of a cut and its solid or of two cuts, differ by rounding: avoid slivers.
    rounding = ROUNDINGS * torch.finfo(dtype).eps
    cuts = []
    for kind, which, rows in visit.cuts:
        row = torch.tensor(rows, dtype=torch.int32, device=start.device)[:, None, None]
        from_here, to_here, there = intervals(kind, rows, [visit.views[member] for member in which])
        cuts.append((which, row, from_here, to_here, there.abs()))
    # A cut may end inside another one: as many rounds as there are cuts suffice.
    for _ in cuts:
        for which, row, from_here, to_here, there in cuts:
            begin = start[which]
            inside = (from_here - rounding * (begin.abs() + there) <= begin) & (begin < to_here)
            start[which] = torch.where(inside, to_here, begin)
            who[which] = torch.where(inside, row, who[which])
    from_cut = who != who.new_tensor(visit.rows)[:, None, None]
    return start, torch.where(from_cut, end - rounding * (start.abs() + at.abs()), end), who
