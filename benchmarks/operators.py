"""The operators against the same work written by hand: ``python -m benchmarks.operators``.

Both run in turn in one process; the table shows medians and their ratio.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks import rivals, timing
from lsmgeo import VoxelGrid, cameras, depth_planes, functional

TARGETS = {"forward": 1.25, "forward+backward": 1.15}
Run = Callable[[Tensor], tuple[Tensor, Tensor]]


def around(scenes: int, views: int) -> cameras.CameraTensors:
    """Cameras of 224 px images around the unit cube."""
    generator = torch.Generator().manual_seed(0)
    azimuth, elevation = (torch.rand(scenes, views, generator=generator) for _ in range(2))
    return cameras.orbit(360.0 * azimuth, 50.0 * elevation - 20.0, 2.0, focal_length=420.0, height=224, width=224)


def unprojection(channels: int) -> tuple[Tensor, Run, Run]:
    """4 scenes x 4 views, features of 56 x 56 for images of 224 px, 32^3 voxels."""
    grid, views = VoxelGrid(32), around(4, 4)
    centers = grid.centers()
    K, E = views.intrinsics, views.cam_from_world
    source = torch.randn(4, 4, channels, 56, 56, generator=torch.Generator().manual_seed(1))
    return (
        source,
        lambda features: functional.unproject(features, views, grid),
        lambda features: rivals.unproject(features, K, E, centers, (224, 224)),
    )


def projection(channels: int, side: int = 28, planes: int = 32) -> tuple[Tensor, Run, Run]:
    """One scene x 4 views, maps of 28 x 28 and 32 planes or of more, 32^3 voxels."""
    grid, views, depths = VoxelGrid(32), around(1, 4), depth_planes(1.0, 3.0, planes)
    K, E = views.intrinsics, views.cam_from_world
    source = torch.randn(1, channels, 32, 32, 32, generator=torch.Generator().manual_seed(1))
    return (
        source,
        lambda volume: functional.plane_sweep_project(volume, views, grid, depths, (side, side), flatten=False),
        lambda volume: rivals.plane_sweep_project(volume, K, E, depths, (224, 224), (side, side), -0.5, 0.5),
    )


def compare(name: str, channels: int, made: tuple[Tensor, Run, Run], repeats: int) -> list[dict[str, Any]]:
    """Time forward, and forward with backward to the source."""
    source, ours, rival = made
    (values, visible), (expected, seen) = ours(source), rival(source)
    # The same work: equal up to rounding, which may move a sample across a border.
    if float((visible != seen).double().mean()) > 1e-4 or float((values - expected).abs().mean()) > 1e-4:
        raise AssertionError(f"{name}: the rival computes something else")
    leaf = source.clone().requires_grad_()
    cotangent = torch.randn(values.shape, generator=torch.Generator().manual_seed(2))

    def forward(run: Run) -> Callable[[], None]:
        def timed() -> None:
            with torch.no_grad():
                run(source)

        return timed

    def both(run: Run) -> Callable[[], None]:
        def timed() -> None:
            answer, _ = run(leaf)
            torch.autograd.grad(answer, leaf, cotangent)

        return timed

    cases = []
    for kind, wrap in (("forward", forward), ("forward+backward", both)):
        seconds = timing.interleaved({"ours": wrap(ours), "rival": wrap(rival)}, repeats)
        case = {"case": f"{name} C={channels} {kind}", **timing.summary(seconds), "target": TARGETS[kind]}
        cases.append(case)
    return cases


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=31)
    parser.add_argument("--threads", type=int, default=1, help="on a busy machine, more measure how threads wait")
    options = parser.parse_args(argv)
    torch.set_num_threads(options.threads)
    where = timing.machine("cpu")
    cases = []
    for channels in (1, 32):
        cases += compare("Unproject", channels, unprojection(channels), options.repeats)
        cases += compare("PlaneSweepProject 28x28x32", channels, projection(channels), options.repeats)
    # What checks and small matrices cost does not grow with the maps.
    cases += compare("PlaneSweepProject 56x56x64", 1, projection(1, 56, 64), options.repeats)
    columns = {"case": "", "ours_ms": ".1f", "rival_ms": ".1f", "ratio_of_medians": ".3f", "median_of_ratios": ".3f"}
    timing.table(cases, {**columns, "target": ".2f"})
    print(timing.save("operators", where, cases))


if __name__ == "__main__":
    main()
