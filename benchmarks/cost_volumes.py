"""Depths of each pixel and correlation: the cost volumes of cascades, against the library's other ways and by hand."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from benchmarks import measuring, report
from benchmarks.comparing import FORWARD, KINDS, compare
from benchmarks.measuring import Settings
from benchmarks.problems import channels_last
from lsmgeo import FrustumGrid, cameras, depth_planes, functional

PLANES, PIXELS, POINTS, HAND = "depths of planes", "depths of pixels", "through points", "hand-written"
VARIANCE, CORRELATION, REPEATED = "variance", "correlation", "repeat and warp"
SPREAD = 0.02  # by which depths of pixels differ, so that both read almost the same
BORDERS = 0.3  # relative norm: by hand, a view counts where it does not see a site
Inputs = tuple[Tensor, Tensor, Tensor]  # features of the source views, the reference's, depths of pixels


class Views:
    """A reference view and its sources, close together; all tensors channels-last."""

    def __init__(self, sources: int, channels: int, planes: int, quick: bool, size: tuple[int, int]) -> None:
        height, width = (24, 30) if quick else size
        generator = torch.Generator().manual_seed(0)
        azimuth = torch.linspace(0.0, 8.0, sources + 1)[None]
        views = cameras.orbit(azimuth, 15.0, 2.0, focal_length=1.2 * width, height=height, width=width)
        self.camera, self.sources = views.at((slice(None), 0)), views.at((slice(None), slice(1, None)))
        self.planes = depth_planes(1.4, 2.6, 4 if quick else planes, spacing="inverse")
        self.grid = FrustumGrid(self.camera, self.planes)
        features = torch.randn(1, sources, channels, height, width, generator=generator)
        reference = torch.randn(1, channels, height, width, generator=generator)
        noise = torch.rand(1, len(self.planes), height, width, generator=generator)
        depths = self.planes[None, :, None, None] * (1.0 + SPREAD * noise)
        self.inputs = channels_last(features, 2), channels_last(reference, 1), depths

    def sites(self, which: str, depths: Tensor) -> FrustumGrid:
        return self.grid if which == PLANES else FrustumGrid(self.camera, depths)

    def volumes(self, which: str, features: Tensor, _: Tensor, depths: Tensor) -> Tensor:
        """The features of each view, (1, V, C, P, h, w)."""
        if which == POINTS:
            points = FrustumGrid(self.camera, depths).centers()
            found = functional.unproject_points(features, self.sources, points.flatten(1, 3)).volume
            return found.unflatten(3, points.shape[1:4])
        if which == HAND:
            return self.warped(features, depths)
        return functional.unproject(features, self.sources, self.sites(which, depths)).volume

    def variance(self, which: str, features: Tensor, reference: Tensor, depths: Tensor) -> Tensor:
        if which == HAND:
            volume = self.warped(features, depths)
            return volume.square().mean(1) - volume.mean(1).square()
        return functional.unproject(features, self.sources, self.sites(which, depths), reduce="variance").volume

    def correlation(self, which: str, features: Tensor, reference: Tensor, depths: Tensor) -> Tensor:
        """The mean over the views of products with the reference, (1, 1, P, h, w)."""
        if which == REPEATED:
            volume = self.warped(features, self.planes[None, :, None, None].expand_as(depths))
            return (volume * reference[:, None, :, None]).mean(2, keepdim=True).mean(1)
        if which == VARIANCE:
            return self.variance(PLANES, features, reference, depths)
        return functional.unproject(
            features, self.sources, self.sites(PLANES, depths), reference=reference[:, :, None], reduce="mean"
        ).volume

    def warped(self, features: Tensor, depths: Tensor) -> Tensor:
        """As most write it: project all points, and sample every view with `grid_sample`."""
        points = FrustumGrid(self.camera, depths).centers().flatten(1, 3)  # (1, N, 3)
        E, K = self.sources.cam_from_world[0], self.sources.intrinsics[0]
        pixels = (points @ E[:, :3, :3].mT + E[:, None, :3, 3]) @ K.mT
        size = torch.tensor([features.shape[4], features.shape[3]])
        where = (2.0 * (pixels[..., :2] / pixels[..., 2:]) + 1.0) / size - 1.0
        samples = grid_sample(features[0], where[:, None], align_corners=False)  # (V, C, 1, N)
        return samples.unflatten(3, depths.shape[1:])[:, :, 0][None]


# label, views, channels, planes, size, work, what takes part, {kind: [(slower, faster, goal, at least)]}
WORK: tuple[tuple[Any, ...], ...] = (
    (
        "variance over 4 views", (4, 32, 64), (128, 160), "variance", (PIXELS, PLANES, HAND),
        {kind: [(PIXELS, PLANES, 1.25, False), (HAND, PIXELS, 3.0, True)] for kind in KINDS},
    ),
    (
        "4 warped volumes", (4, 32, 64), (128, 160), "volumes", (PIXELS, POINTS, HAND),
        {kind: [(PIXELS, POINTS, 0.5, False)] for kind in KINDS},
    ),
    (
        "correlation, 1 + 4 views", (4, 32, 64), (128, 160), "correlation", (CORRELATION, VARIANCE),
        {kind: [(CORRELATION, VARIANCE, 1.25, False)] for kind in KINDS},
    ),
    (
        "correlation, 1 + 7 views", (7, 16, 64), (120, 160), "correlation", (CORRELATION, REPEATED),
        {kind: [(REPEATED, CORRELATION, 5.0, True)] for kind in KINDS},
    ),
)  # fmt: skip


def forward(run: Callable[..., Tensor], inputs: tuple[Tensor, ...]) -> Tensor:
    """The answer, without a graph."""
    with torch.no_grad():
        return run(*inputs)


def both(run: Callable[..., Tensor], inputs: tuple[Tensor, ...], cotangent: Tensor) -> tuple[Tensor, ...]:
    """Forward and backward: the gradients to the inputs that need one."""
    wanted = [leaf for leaf in inputs if leaf.requires_grad]
    return torch.autograd.grad(run(*inputs), wanted, cotangent, allow_unused=True)


def _leaves(inputs: Inputs, work: str) -> Inputs:
    features, reference, depths = (leaf.detach().clone() for leaf in inputs)
    reference.requires_grad_(work == "correlation")
    return features.requires_grad_(), reference, depths


def _memory(sizes: tuple[int, int, int], size: tuple[int, int], quick: bool, work: str, name: str) -> dict[str, Any]:
    """Bytes of a forward and backward, see `comparing.memory`."""
    views = Views(*sizes, quick, size)
    run, inputs = partial(getattr(views, work), name), _leaves(views.inputs, work)
    output = forward(run, inputs)
    cotangent = torch.ones_like(output)
    kept = {"output": output.nbytes, "visible": output.numel() // output.shape[1] * sizes[0]}
    kept["gradients"] = sum(leaf.nbytes for leaf in inputs if leaf.requires_grad)
    del output
    peak = measuring.peak(partial(both, run, inputs, cotangent))
    held = sum(leaf.nbytes for leaf in inputs)
    return {**kept, "inputs": held, "peak": peak, "above": peak - sum(kept.values())}


def measure(settings: Settings) -> list[dict[str, Any]]:
    """Times in one interleaved run for each work, and the peak memory of correlations."""
    cases = []
    for label, sizes, size, work, names, goals in WORK:
        if settings.only not in label:
            continue
        views = Views(*sizes, settings.quick, size)
        inputs = _leaves(views.inputs, work)
        runs = {name: partial(getattr(views, work), name) for name in names}
        outputs = {name: forward(run, inputs) for name, run in runs.items()}
        same = [name for name in names if name not in (PLANES, VARIANCE)]  # these compute something else
        for name in same[1:]:
            compare(f"{label}, {name}", outputs[name], outputs[same[0]], BORDERS)
        cotangents = {name: torch.ones_like(output) for name, output in outputs.items()}
        del outputs
        for kind in KINDS:
            calls = {
                name: partial(forward, run, inputs) if kind == FORWARD else partial(both, run, inputs, cotangents[name])
                for name, run in runs.items()
            }
            taken = measuring.interleaved(calls, settings.repeats, budget=20.0)
            times = {name: measuring.spread(seconds) for name, seconds in taken.items()}
            case = {"case": f"{label}, {kind}", "kind": kind, "times": times, "left_out": {}}
            case["goals"] = [report.ratio(case, *goal) for goal in goals[kind]]
            cases.append(case)
        if work == "correlation":
            given = sizes, size, settings.quick, work
            case["memory"] = {name: measuring.isolated(_memory, *given, name) for name in names if name != VARIANCE}
            above = case["memory"][CORRELATION]["above"]
            case["goals"].append(report.goal("above inputs, outputs, gradients, MiB", above / 2**20, 20.0, False))
            if REPEATED in case["memory"]:
                share = case["memory"][CORRELATION]["peak"] / case["memory"][REPEATED]["peak"]
                case["goals"].append(report.goal("peak, of repeat and warp", share, 0.2, False))
    return cases
