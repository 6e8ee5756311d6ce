"""Features added along rays to a volume, against the outer product of features and weights with ``index_add``."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from benchmarks import measuring, report
from benchmarks.comparing import FORWARD, KINDS, compare
from benchmarks.cost_volumes import both, forward
from benchmarks.measuring import Settings
from benchmarks.problems import channels_last
from lsmgeo import CameraTensors, FrustumGrid, VoxelGrid, cameras, depth_planes, functional

SPLAT, CONTIGUOUS, HAND = "splat", "splat of contiguous features", "outer product, index_add"
NEAREST = "nearest, 6 views onto 200 x 1 x 200"
TRILINEAR = "trilinear, 4 views onto 32 x 32 x 32"
# Relative norm; of the nearest: samples within 1e-4 of the border of a cell.
LIMITS = {"nearest": 0.1, "trilinear": 1e-4}


class Rig:
    """Features (1, V, C, h, w), weights (1, V, P, h, w), cameras, grid and depths of a case."""

    def __init__(self, label: str, quick: bool) -> None:
        self.mode = label.split(",")[0]
        generator = torch.Generator().manual_seed(0)
        if label == NEAREST:
            size, channels, self.grid = (
                (16, 44),
                64,
                VoxelGrid((200, 1, 200), (-50.3, -10.0, -50.2), (49.7, 10.0, 49.8)),
            )
            self.depths = torch.arange(4.0, 45.0)
            outward = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
            views = cameras.orbit(60.0 * torch.arange(6)[None], 0.0, 1.0, focal_length=25.0, height=16, width=44)
            self.views: CameraTensors = views._replace(cam_from_world=outward @ views.cam_from_world)
        else:
            size, channels, self.grid = (28, 28), 32, VoxelGrid(32)
            self.depths = depth_planes(1.2, 2.8, 32)
            self.views = cameras.orbit(90.0 * torch.arange(4)[None], 20.0, 2.0, focal_length=60.0, height=56, width=56)
        if quick:
            self.depths = self.depths[::8]
        count = self.views.shape[1]
        features = torch.randn(1, count, channels, *size, generator=generator)
        weights = torch.rand(1, count, len(self.depths), *size, generator=generator)
        self.inputs = features, weights
        frustums = [FrustumGrid(self.views.at((slice(None), view)), self.depths, size) for view in range(count)]
        self.sites = torch.stack([frustum.centers() for frustum in frustums], 1).flatten(0, 4)

    def run(self, which: str, features: Tensor, weights: Tensor) -> Tensor:
        if which != HAND:
            return functional.splat(features, self.views, self.grid, self.depths, weights=weights, mode=self.mode)
        return self.by_hand(features, weights)

    def by_hand(self, features: Tensor, weights: Tensor) -> Tensor:
        """As most write it; the sites are given, and not part of the time."""
        D, H, W = self.grid.shape
        sizes, channels = torch.tensor([W, H, D]), features.shape[2]
        lower, upper = torch.tensor(self.grid.lower), torch.tensor(self.grid.upper)
        index = (self.sites - lower) / ((upper - lower) / sizes)
        outer = (features[:, :, :, None] * weights[:, :, None]).movedim(2, -1).reshape(-1, channels)
        volume = features.new_zeros(D * H * W, channels)
        if self.mode == "nearest":
            taps = [(index.floor().long(), None)]
        else:
            base = (index - 0.5).floor()
            fraction = index - 0.5 - base
            taps = []
            for corner in product((0, 1), repeat=3):
                step = torch.tensor(corner)
                share = torch.where(step == 1, fraction, 1.0 - fraction).prod(1)
                taps.append((base.long() + step, share))
        for cell, share in taps:
            inside = ((cell >= 0) & (cell < sizes)).all(1)
            flat = ((cell[:, 2] * H + cell[:, 1]) * W + cell[:, 0])[inside]
            added = outer[inside] if share is None else outer[inside] * share[inside, None]
            volume = volume.index_add(0, flat, added)
        return volume.view(1, D, H, W, channels).movedim(-1, 1)


def _inputs(rig: Rig, name: str) -> tuple[Tensor, ...]:
    features, weights = (leaf.clone() for leaf in rig.inputs)
    features = features if name == CONTIGUOUS else channels_last(features, 2)
    return features.requires_grad_(), weights.requires_grad_()


def _memory(label: str, quick: bool, name: str) -> dict[str, Any]:
    """Bytes of a forward and backward."""
    rig = Rig(label, quick)
    run, inputs = partial(rig.run, name), _inputs(rig, name)
    output = forward(run, inputs)
    cotangent, held = torch.ones_like(output), sum(leaf.nbytes for leaf in inputs)
    kept = {"output": output.nbytes, "visible": 0, "gradients": held}
    del output
    peak = measuring.peak(partial(both, run, inputs, cotangent))
    return {**kept, "inputs": held, "peak": peak, "above": peak - sum(kept.values())}


def measure(settings: Settings) -> list[dict[str, Any]]:
    """Times in one interleaved run for each case and kind, and the peak memory."""
    cases = []
    for label in (NEAREST, TRILINEAR):
        if settings.only not in label:
            continue
        rig, names = Rig(label, settings.quick), (SPLAT, CONTIGUOUS, HAND)
        runs, inputs = (
            {name: make(name) for name in names} for make in (partial(partial, rig.run), partial(_inputs, rig))
        )
        outputs = {name: forward(runs[name], inputs[name]) for name in names}
        for name in (CONTIGUOUS, HAND):
            compare(f"{label}, {name}", outputs[name], outputs[SPLAT], LIMITS[rig.mode])
        cotangent = torch.ones_like(outputs[SPLAT])
        for kind in KINDS:
            calls = {
                name: partial(forward, runs[name], inputs[name])
                if kind == FORWARD
                else partial(both, runs[name], inputs[name], cotangent)
                for name in names
            }
            taken = measuring.interleaved(calls, settings.repeats, budget=20.0)
            times = {name: measuring.spread(seconds) for name, seconds in taken.items()}
            case = {"case": f"{label}, {kind}", "kind": kind, "times": times, "left_out": {}}
            case["goals"] = [report.ratio(case, HAND, SPLAT, 5.0, True)]
            cases.append(case)
        case["memory"] = {name: measuring.isolated(_memory, label, settings.quick, name) for name in names}
        share = case["memory"][SPLAT]["above"] / (rig.inputs[0].nbytes * len(rig.depths))
        case["goals"].append(
            report.goal("above inputs, volume, gradients, of features times weights", share, 0.25, False)
        )
    return cases
