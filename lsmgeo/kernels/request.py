"""What a kernel computes: at which sites, and with which options."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_choices, check_flag, check_number, check_whole, describe
from lsmgeo.errors import OptionError

__all__ = ["OPERATORS", "Options", "Sites"]

OPERATORS = ("unproject", "unproject_points", "sample_views", "plane_sweep_project", "project_reduce", "splat")
PADDING_MODES = ("zeros", "border")
STATISTICS = ("mean", "variance", "max")


class Sites(NamedTuple):
    """The sites of a lattice as V views of B scenes see them, in float64.

    Site (k, j, i) has ``q = (x[i], y[j], z[k], 1)`` and ``s = z[k]`` if `projective` else 1. Its index in the source
    array is ``M q``, divided by its third coordinate if the source is an image, by s if it is a volume.

    Attributes:
        matrix: M, (B, V, 3, 4): source index from lattice index.
        direction: G, (B, V, 3, 4): ``G q`` points from the camera centre to the site; None without ray directions.
        x: (W,).
        y: (H,).
        z: (D,), (B, D) or (B, V, D). Where it differs from site to site, (B, 1 or V, D, H, W): there it holds *depths*,
            float32 or float64, whose reciprocals are the third coordinates.
        projective: whether s is the third coordinate of q.
        view_mask: (B, V) bool, False for views that are left out; None keeps all.
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
        return self.with_geometry(self.matrix, self.direction, self.planes(self.z, start, stop))

    def per_site(self) -> bool:
        """Whether `z` holds the depth of each site. PyTorch 2.6 compiles no property of a named tuple."""
        return self.z.dim() == 5

    def planes(self, z: Tensor, start: int, stop: int) -> Tensor:
        """Planes start to stop of a `z` of this form."""
        return z[:, :, start:stop] if self.per_site() else z[..., start:stop]

    def with_geometry(self, matrix: Tensor, direction: Tensor | None, z: Tensor) -> Sites:
        """The sites with other matrices and planes. PyTorch 2.7 does not compile `_replace`."""
        return Sites(matrix, direction, self.x, self.y, z, self.projective, self.view_mask)

    def counts(self) -> tuple[int, int, int]:
        """(D, H, W)."""
        return self.z.shape[2 if self.per_site() else -1], self.y.shape[0], self.x.shape[0]


class Options(NamedTuple):
    """How to sample, what to append and whether to reduce over views; see `lsmgeo.functional.unproject`.

    Checked once, by `checked`; everything below the public functions takes this one value.
    """

    mode: str
    padding_mode: str = "zeros"
    depth: bool = False  # whether to append the depth
    direction: str = ""  # the frame of the ray directions to append, or ""
    reduce: tuple[str, ...] = ()
    near: float = 1e-6
    flatten: bool = False  # whether planes are then stacked with the channels: fused kernels lay memory out for it
    groups: int = 1  # of channels, where they are correlated with a reference
    contiguous: bool = False  # whether the answer is contiguous in memory; by default it is what is fastest
    backend: str = "auto"

    def appended(self) -> int:
        """The number of geometric channels that a lattice's sites append."""
        return int(self.depth) + 3 * bool(self.direction)

    def on(self, backend: str) -> Options:
        """The options with this backend. PyTorch 2.7 compiles neither `_replace` nor a slice."""
        how = self.mode, self.padding_mode, self.depth, self.direction, self.reduce, self.near
        return Options(*how, self.flatten, self.groups, self.contiguous, backend)

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
        flatten: Any = False,
        groups: Any = 1,
        memory_format: Any = None,
    ) -> Options:
        """Options from a user's arguments, the mode `smooth` or "nearest"; an `OptionError` names an invalid one."""
        mode = check_choice(who, "mode", smooth if mode is None else mode, (smooth, "nearest"))
        check_choice(who, "padding_mode", padding_mode, PADDING_MODES)
        extra = check_choices(who, "augment", augment, ("depth", "direction"))
        frame = check_choice(who, "direction_frame", direction_frame, ("world", "camera"))
        statistics = () if reduce is None else check_choices(who, "reduce", reduce, STATISTICS)
        if reduce is not None and not statistics:
            raise OptionError(f"{who}: reduce must be None or name a statistic; got {describe(reduce)}")
        distance = check_number(who, "near", near, "a finite number, at least 0", 0)
        check_flag(who, "flatten", flatten)
        groups = check_whole(who, "groups", groups, 1)
        if memory_format not in (None, torch.contiguous_format):
            raise OptionError(f"{who}: memory_format must be None or torch.contiguous_format; got {memory_format!r}")
        direction, contiguous = frame if "direction" in extra else "", memory_format is not None
        return cls(mode, padding_mode, "depth" in extra, direction, statistics, distance, flatten, groups, contiguous)
