"""What can be chosen of an evaluation."""

from __future__ import annotations

from dataclasses import dataclass

from lsmgeo._checks import check_number, check_whole
from lsmgeo.data.shards.background_sources import Background
from lsmgeo.errors import OptionError

__all__ = ["Options"]


@dataclass(frozen=True, kw_only=True)
class Options:
    """How reports measure; each takes what concerns it.

    Attributes:
        views: the largest number of views; None for what the paper has, as far as the data go.
        threshold: of probabilities, for IoU.
        batch: shapes at a time.
        seed: of the orders of views and of noise in poses.
        background: for "backgrounds", what stands behind the objects: "random", a folder of pictures or a colour.
        degrees: for "pose-noise", the largest angles by which cameras are turned.
        orders: for "order", in how many orders the views are given.
        planes: for "depth" and "clouds", of the plane sweep.
        window: side of its patches in pixels.
        progress: whether to show progress bars (on a terminal).
    """

    views: int | None = None
    threshold: float = 0.4
    batch: int = 4
    seed: int = 0
    background: Background = "random"
    degrees: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    orders: int = 8
    planes: int = 300
    window: int = 5
    progress: bool = False

    def __post_init__(self) -> None:
        if self.views is not None:
            check_whole("evaluate", "views", self.views, 1, 1000)
        check_number("evaluate", "threshold", self.threshold, "a number")
        for name, least in (("batch", 1), ("seed", 0), ("orders", 2), ("planes", 3), ("window", 1)):
            check_whole("evaluate", name, getattr(self, name), least, 2**32 - 1)
        if not [check_number("evaluate", "degrees", angle, "from 0 to 180", 0, 180) for angle in self.degrees]:
            raise OptionError("evaluate: degrees must be from 0 to 180; got none")
