"""The lowest and second-lowest local minimum of a cost along every ray, from planes that come one by one."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["Winners"]

# A second minimum counts against the first only where it is another place, not the noise around the same one.
SAME_PLANES = 2.5


class Winners:
    """Running winners of a sweep: what is kept does not grow with the number of planes.

    A local minimum is placed between planes by the parabola through it and its neighbours in inverse depth, in which
    samples move evenly, so that any spacing of the planes will do.

    Args:
        depths: (P,) the planes' depths, ascending.
        size: (h, w).
        unrelated: the cost of what nobody sees.
        apart: planes within which minima are one place.
    """

    def __init__(self, depths: Tensor, size: tuple[int, int], unrelated: float, apart: float = SAME_PLANES):
        self.apart = max(apart, SAME_PLANES)
        self.inverse = (1 / depths.double()).tolist()
        self.unrelated = unrelated
        self.before: list[tuple[Tensor, Tensor]] = []
        self.count = 0
        self.best = torch.full(size, 2 * unrelated, device=depths.device)
        self.second = torch.full(size, unrelated, device=depths.device)
        self.place = torch.full(size, -1.0, device=depths.device)

    def push(self, cost: Tensor, seen: Tensor) -> None:
        """Take the next plane's cost (h, w) and where enough neighbours see it."""
        self.before.append((cost, seen))
        self.count += 1
        if len(self.before) < 3:
            return
        (previous, had_seen), (middle, usable), (following, will_see) = self.before
        self.before.pop(0)
        # Few pixels have a minimum here that counts; all else is done for these alone.
        counts = usable & (middle <= previous) & (middle < following) & (middle < torch.maximum(self.best, self.second))
        at = counts.flatten().nonzero()[:, 0]
        if len(at) == 0:
            return
        before, cost, after, best, second, winner = (
            values.flatten()[at] for values in (previous, middle, following, self.best, self.second, self.place)
        )
        # Beside what nobody sees there is no curve to follow.
        has_sides = (had_seen & will_see).flatten()[at]
        place = self.count - 2 + torch.where(has_sides, self._offset(before, cost, after), 0.0)
        elsewhere = (place - winner > self.apart) | (winner < 0)
        better = cost < best
        # A better minimum beside the old one replaces it; elsewhere it demotes the old one.
        loser = torch.where(better, best, cost).clamp_max(self.unrelated)
        demoted = torch.where(better, loser, torch.minimum(loser, second))
        self.second.view(-1)[at] = torch.where(elsewhere, demoted, second)
        self.best.view(-1)[at] = torch.where(better, cost, best)
        self.place.view(-1)[at] = torch.where(better, place, winner)

    def _offset(self, before: Tensor, cost: Tensor, after: Tensor) -> Tensor:
        """Where the parabola through three planes has its vertex, in planes from the middle one, in [-0.5, 0.5]."""
        first, middle, last = self.inverse[self.count - 3 : self.count]
        step, next_step = first - middle, middle - last
        # Its derivative by inverse depth is, half way between two planes, their slope; it is 0 at the vertex.
        slope, next_slope = (cost - before) / step, (after - cost) / next_step
        vertex = -0.5 * (slope * next_step + next_slope * step) / (next_slope - slope).clamp_min(1e-30)
        return torch.where(vertex > 0, vertex / next_step, vertex / step)

    def depth(self) -> Tensor:
        """Depth of the winners (h, w) float32, linear in inverse depth between planes; 0 where there is none."""
        inverse = torch.tensor(self.inverse, dtype=torch.float64, device=self.place.device)
        lower = self.place.clamp(0, len(inverse) - 2).floor().long()
        depth = 1 / torch.lerp(inverse[lower], inverse[lower + 1], (self.place - lower).double())
        return torch.where(self.place >= 0, depth, 0.0).float()

    def uniqueness(self) -> Tensor:
        """By how much the second-lowest minimum elsewhere is above the lowest, in [0, 1], (h, w)."""
        return ((self.second - self.best) / self.second.clamp_min(1e-3)).clamp(0, 1)
