"""Frustum and voxel volumes as other systems make them: ``python -m benchmarks.systems``.

kornia's warps plane by plane; loops over the views in the styles of Atlas and MVSNet; correlation volumes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from benchmarks import contenders as who
from benchmarks import memory, report
from benchmarks.measure import KINDS, timings
from benchmarks.problems import Problem
from benchmarks.settings import parse

FRUSTUM = Problem("frustum", B=1)
WORK = (
    ("Frustum, volume of each view", FRUSTUM, (who.HAND, who.WARPER, who.HOMOGRAPHY)),
    ("Frustum, variance", FRUSTUM.but(statistic="variance"), (who.HAND, who.WARPER, who.HOMOGRAPHY, who.MVSNET)),
    ("Frustum, products with the first view", FRUSTUM.but(statistic="dot"), (who.DOT,)),
    ("Voxels, mean of nearest pixels", Problem("unproject", mode="nearest", statistic="mean"), (who.HAND, who.ATLAS)),
)


def main(argv: Sequence[str] | None = None) -> None:
    settings = parse(__doc__, argv)
    cases = []
    for label, problem, rivals in WORK:
        names = settings.names(who.OURS, *rivals)
        sized = settings.sized(problem)
        made = timings(label, sized, names, kinds=KINDS, repeats=settings.repeats, budget=6.0, fewest=3)
        made[-1]["memory"] = {
            name: memory.measure(sized, name, "forward+backward", torch.get_num_threads()) for name in names
        }
        cases += made
    report.show(report.time_rows(cases), "milliseconds")
    report.show(report.memory_rows([case for case in cases if "memory" in case]), "peak memory, forward+backward")
    settings.save("systems", cases)


if __name__ == "__main__":
    main()
