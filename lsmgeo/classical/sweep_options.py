"""The options of plane sweeps as one value that is checked once."""

from __future__ import annotations

from dataclasses import InitVar, dataclass

from lsmgeo._checks import check_choice, check_number, check_positive, check_whole
from lsmgeo.classical.planes import MOST_PLANES, SPACINGS
from lsmgeo.errors import OptionError

__all__ = ["SCORES", "SweepOptions"]

SCORES = ("zncc", "sad", "census", "cosine")


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """How views are swept: the keywords of `lsmgeo.classical.reconstruct_scene` and `lsmgeo.classical.sweep`.

    Attributes:
        neighbours: the largest number of other views to match with.
        size: longer side of the depth maps in pixels.
        planes: number of depth planes.
        spacing: of the planes, see `lsmgeo.classical.sweep_planes`.
        near: nearest depth, world units; None to find it.
        far: farthest depth; None to find it.
        score: see `lsmgeo.classical.matching_costs`.
        window: side of the patches in pixels, odd.
        noise: standard deviation of the images below which texture has little weight.
        best: neighbours averaged at a site; None for half of them.
        min_views: least number of neighbours that must see a site.
        filtered: whether costs are averaged along the edges of the image.
        density: largest fraction of the pixels to keep; None for the default of the method.
        memory: bound in bytes on the memory that a sweep adds to the process; `slab_planes` checks it.
        who: the public function, for messages.
    """

    neighbours: int = 4
    size: int = 640
    planes: int = 300
    spacing: str = "inverse"
    near: float | None = None
    far: float | None = None
    score: str = "zncc"
    window: int = 5
    noise: float = 0.5 / 255
    best: int | None = None
    min_views: int = 1
    filtered: bool = True
    density: float | None = None
    memory: int = 1 << 30
    who: InitVar[str] = "sweep"

    def __post_init__(self, who: str) -> None:
        check_whole(who, "neighbours", self.neighbours, 1)
        check_whole(who, "size", self.size, 16)
        check_whole(who, "planes", self.planes, 3, MOST_PLANES)
        check_choice(who, "spacing", self.spacing, SPACINGS)
        ends = [end for end in (self.near, self.far) if end is not None]
        if not all(0 < end < float("inf") for end in ends) or (len(ends) == 2 and not ends[0] < ends[1]):
            raise OptionError(
                f"{who}: near and far must be positive, finite and ascending; got {' and '.join(map(str, ends))}"
            )
        check_choice(who, "score", self.score, SCORES)
        if check_whole(who, "window", self.window, 1) % 2 == 0:
            raise OptionError(f"{who}: window must be odd; got {self.window}")
        check_positive(who, "noise", self.noise)
        if self.density is not None and not 0 < check_number(who, "density", self.density, "a number in (0, 1]") <= 1:
            raise OptionError(f"{who}: density must lie in (0, 1]; got {self.density}")
