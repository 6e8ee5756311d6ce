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
    """

    def __init__(self, depths: Tensor, size: tuple[int, int], unrelated: float):
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
        index = self.count - 2
        is_minimum = usable & (middle <= previous) & (middle < following)
        # Slopes per inverse depth on both sides; the parabola's vertex is where its derivative is 0.
        step, next_step = (self.inverse[index + i] - self.inverse[index + i + 1] for i in (-1, 0))
        slope, next_slope = (middle - previous) / step, (following - middle) / next_step
        vertex = -0.5 * (slope * next_step + next_slope * step) / (next_slope - slope).clamp_min(1e-30)
        offset = torch.where(vertex > 0, vertex / next_step, vertex / step)
        # Beside what nobody sees there is no curve to follow.
        place = index + torch.where(had_seen & will_see, offset, 0.0)
        elsewhere = (place - self.place > SAME_PLANES) | (self.place < 0)
        better = is_minimum & (middle < self.best)
        loser = torch.where(better, self.best, torch.where(is_minimum, middle, self.unrelated))
        loser = loser.clamp_max(self.unrelated)
        # A better minimum beside the old one replaces it; elsewhere it demotes the old one.
        self.second = torch.where(
            better,
            torch.where(elsewhere, loser, self.second),
            torch.where(elsewhere, torch.minimum(loser, self.second), self.second),
        )
        self.best = torch.where(better, middle, self.best)
        self.place = torch.where(better, place, self.place)

    def depth(self) -> Tensor:
        """Depth of the winners (h, w) float32, linear in inverse depth between planes; 0 where there is none."""
        inverse = torch.tensor(self.inverse, dtype=torch.float64, device=self.place.device)
        lower = self.place.clamp(0, len(inverse) - 2).floor().long()
        depth = 1 / torch.lerp(inverse[lower], inverse[lower + 1], (self.place - lower).double())
        return torch.where(self.place >= 0, depth, 0.0).float()

    def uniqueness(self) -> Tensor:
        """By how much the second-lowest minimum elsewhere is above the lowest, in [0, 1], (h, w)."""
        return ((self.second - self.best) / self.second.clamp_min(1e-3)).clamp(0, 1)
