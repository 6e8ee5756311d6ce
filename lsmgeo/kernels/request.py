"""What a kernel is asked to do: sites, and options."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from lsmgeo._checks import check_choice, check_choices, check_number, describe
from lsmgeo.errors import OptionError

__all__ = ["OPERATORS", "Options", "Sites"]

OPERATORS = ("unproject", "unproject_points", "sample_views", "plane_sweep_project", "project_reduce")
PADDING_MODES = ("zeros", "border")
STATISTICS = ("mean", "variance", "max")


class Sites(NamedTuple):
    """The sites of a lattice as V views of B scenes see them, in float64.

    Site (k, j, i) has ``q = (x[i], y[j], z[k], 1)`` and ``s = z[k]`` if `projective` else 1. Its place in the source
    array is ``M q``: divided by its third coordinate if the source is an image, by s if it is a volume.

    Attributes:
        matrix: M, (B, V, 3, 4): source index from lattice index.
        direction: G, (B, V, 3, 4), whose ``G q`` points from the camera centre to the site; None if not asked for.
        x: (W,).
        y: (H,).
        z: (D,), (B, D) or (B, V, D).
        projective: whether s is the third coordinate of q.
        view_mask: (B, V) bool, False for views to leave out; None keeps all.
    """

    matrix: Tensor
    direction: Tensor | None
    x: Tensor
    y: Tensor
    z: Tensor
    projective: bool
    view_mask: Tensor | None

    def slab(self, start: int, stop: int) -> Sites:
        """The sites of planes start to stop."""
        return self.placed(self.matrix, self.direction, self.z[..., start:stop])

    def placed(self, matrix: Tensor, direction: Tensor | None, z: Tensor) -> Sites:
        """The sites with other matrices and planes. PyTorch 2.7 does not compile `_replace`."""
        return Sites(matrix, direction, self.x, self.y, z, self.projective, self.view_mask)


class Options(NamedTuple):
    """How to sample, what to append and whether to reduce over views; see `lsmgeo.functional.unproject`."""

    mode: str
    padding_mode: str = "zeros"
    depth: bool = False
    direction: str = ""  # "", or the frame of the directions to append
    reduce: tuple[str, ...] = ()
    near: float = 1e-6
    stacked: bool = False  # whether planes will be stacked with the channels: a fused kernel lays them out for it

    @classmethod
    def checked(
        cls,
        who: str,
        smooth: str,
        mode: Any = None,
        padding_mode: Any = "zeros",
        augment: Any = (),
        direction_frame: Any = "world",
        reduce: Any = None,
        near: Any = 1e-6,
        stacked: bool = False,
    ) -> Options:
        """Options from a user's arguments (`smooth` or "nearest" is the mode); an `OptionError` names a wrong one."""
        mode = check_choice(who, "mode", smooth if mode is None else mode, (smooth, "nearest"))
        check_choice(who, "padding_mode", padding_mode, PADDING_MODES)
        extra = check_choices(who, "augment", augment, ("depth", "direction"))
        frame = check_choice(who, "direction_frame", direction_frame, ("world", "camera"))
        statistics = () if reduce is None else check_choices(who, "reduce", reduce, STATISTICS)
        if reduce is not None and not statistics:
            raise OptionError(f"{who}: reduce must be None or name a statistic; got {describe(reduce)}")
        distance = check_number(who, "near", near, "a finite number, at least 0", 0)
        return cls(
            mode, padding_mode, "depth" in extra, frame if "direction" in extra else "", statistics, distance, stacked
        )
