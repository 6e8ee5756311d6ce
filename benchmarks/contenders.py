"""Who competes, by the name that the tables print."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from benchmarks import compiled, ours, rivals, styles, warps
from benchmarks.problems import LeftOut, Run, Scene

OURS = "lsmgeo"
REFERENCE = "lsmgeo, reference"
UNFUSED = "lsmgeo, sweep and convolution"
HAND = "hand-written"
COMPILED = "compiled gather"
COMPILED_ANY = "compiled gather, any size"
AUTOMATIC = "compiled gather, automatic backward"
WARPER = "kornia DepthWarper"
HOMOGRAPHY = "kornia homography_warp"
ATLAS = "running mean (Atlas)"
MVSNET = "running variance (MVSNet)"
DOT = "products view by view"
COLD = "floor, fresh memory"
WARM = "floor, warm memory"
KERNEL = "kernel, warm memory"

CONTENDERS: Mapping[str, Callable[[Scene], Run]] = {
    OURS: ours.contender,
    REFERENCE: partial(ours.contender, backend="reference"),
    UNFUSED: ours.unfused,
    HAND: rivals.contender,
    COMPILED: compiled.contender,
    COMPILED_ANY: partial(compiled.contender, dynamic=True),
    AUTOMATIC: partial(compiled.contender, automatic=True),
    WARPER: warps.depth_warper,
    HOMOGRAPHY: warps.homographies,
    ATLAS: styles.running_mean,
    MVSNET: styles.variance_volume,
    DOT: styles.dot_volume,
}


def gather(scene: Scene, names: Iterable[str]) -> tuple[dict[str, Run], dict[str, str]]:
    """The runs of those that take part, and the reasons of those that do not."""
    runs, left_out = {}, {}
    for name in names:
        try:
            runs[name] = CONTENDERS[name](scene)
        except LeftOut as reason:
            left_out[name] = str(reason)
    return runs, left_out
