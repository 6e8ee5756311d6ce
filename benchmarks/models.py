"""The networks against themselves on hand-written operators, and what importing the library costs.

A training step and an inference step of the preset "paper"; the competitor is the same model, with the same weights,
whose unprojection or plane sweep is what `benchmarks.rivals` writes by hand on `grid_sample`, with depth and ray
directions appended and the sweep's channels stacked for a 1x1 convolution. Outputs and gradients are compared first.
"""

from __future__ import annotations

import copy
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, conv2d, l1_loss, normalize

from benchmarks import competitors as who
from benchmarks import measuring, report, rivals
from benchmarks.comparing import compare
from benchmarks.measuring import Settings
from benchmarks.problems import LeftOut
from lsmgeo import models
from lsmgeo.cameras import CameraTensors, orbit, to
from lsmgeo.functional import Projected, Unprojected

MODELS = {"voxel-lsm": "V-LSM", "depth-lsm": "D-LSM"}
KINDS = ("inference", "training")
# Float32 pixels move a sample by 1e-4 pixel at most; one in some hundred thousand samples changes its nearest voxel.
VALUES, GRADIENTS = {"voxel-lsm": 1e-3, "depth-lsm": 1e-2}, {"voxel-lsm": 1e-2, "depth-lsm": 5e-2}
# The goals of V-LSM on a GPU: models per second in batches of 16, and milliseconds of one.
BATCH, RATE, LATENCY_MS = 16, 1000.0, 8.0


def image_size(cameras: CameraTensors) -> tuple[int, int]:
    height, width = (int(torch.as_tensor(size).flatten()[0]) for size in cameras[2:])
    return height, width


class HandUnproject(nn.Module):
    """The part of `lsmgeo.Unproject` that V-LSM and D-LSM use, written by hand."""

    def __init__(self, sites: Tensor) -> None:
        super().__init__()
        self.register_buffer("sites", sites, persistent=False)

    def forward(self, features: Tensor, cameras: CameraTensors, view_mask: None = None) -> Unprojected:
        K, E = cameras.intrinsics, cameras.cam_from_world
        volume, visible = rivals.unproject(features, K, E, self.sites, image_size(cameras))
        points = self.sites.reshape(-1, 3)
        depth = points @ E[..., 2, :3, None] + E[..., 2, 3, None, None]  # (B, V, N, 1)
        directions = normalize(points - rivals.camera_centers(E)[..., None, :], dim=-1)
        beside = torch.cat((depth, directions), -1).movedim(-1, 2).unflatten(-1, self.sites.shape[:3])
        return Unprojected(torch.cat((volume, beside.to(volume.dtype)), 2), visible)


class HandProjectReduce(nn.Module):
    """The part of `lsmgeo.rays.ProjectReduce` that D-LSM uses, written by hand."""

    def __init__(self, weight: nn.Parameter, depths: Tensor, mode: str) -> None:
        super().__init__()
        self.weight, self.mode = weight, {"nearest": "nearest", "trilinear": "smooth"}[mode]
        self.register_buffer("depths", depths, persistent=False)

    def forward(
        self, volume: Tensor, cameras: CameraTensors, view_mask: None = None, *, size: tuple[int, int]
    ) -> Projected:
        where = *cameras[:2], self.depths, image_size(cameras), size
        maps, visible = rivals.plane_sweep_project(volume, *where, self.mode)
        directions = normalize(rivals.pixel_rays(*cameras[:2], *where[3:])[1], dim=-1).movedim(-1, 2)
        directions = directions.unflatten(-1, size)[:, :, :, None].expand(-1, -1, -1, len(self.depths), -1, -1)
        depth = self.depths[:, None, None].expand_as(directions[:, :, :1])
        stacked = torch.cat((maps, depth.to(maps.dtype), directions.to(maps.dtype)), 2).flatten(2, 3)
        mapped = conv2d(stacked.flatten(0, 1), self.weight)
        return Projected(mapped.unflatten(0, stacked.shape[:2]), visible)


def by_hand(model: Any) -> Any:
    """A copy with the same weights."""
    twin, device = copy.deepcopy(model), next(model.parameters()).device
    twin.unproject = HandUnproject(model.unproject.grid.centers().to(device))
    if model.output == "depth":
        twin.sweep = HandProjectReduce(twin.sweep.weight, model.sweep.depths.to(device), model.sweep.mode)
    return twin


class Work:
    """A model of each competitor, and its input: B scenes of 4 views."""

    def __init__(self, name: str, settings: Settings, scenes: int = 1, views: int = 4) -> None:
        torch.manual_seed(0)
        model = models.create(name, preset="tiny" if settings.quick else "paper").to(settings.device)
        self.name, self.models, size = name, {who.OURS: model, who.HAND: by_hand(model)}, model.image_size
        azimuth, elevation = torch.rand(scenes, views) * 360, torch.rand(scenes, views) * 50 - 20
        cameras = orbit(azimuth, elevation, 2.0, focal_length=1.875 * size, height=size, width=size)
        self.cameras = to(cameras, settings.device)
        images = torch.rand(scenes, views, 3, size, size)
        if model.output == "voxels":
            truth = (torch.rand(scenes, 1, *model.grid.shape) < 0.1).float()
        else:
            truth = 1.5 + torch.rand(scenes, 1, views, size, size)
        self.images, self.truth = images.to(settings.device), truth.to(settings.device)

    def infer(self, competitor: str) -> Any:
        """From images to the result."""
        return self.models[competitor].run(self.images, self.cameras, by_view=False)

    def loss(self, model: nn.Module) -> Tensor:
        """After every view, as in training."""
        output = model(self.images, self.cameras)[0]
        truth = self.truth.expand_as(output)
        return binary_cross_entropy_with_logits(output, truth) if self.name == "voxel-lsm" else l1_loss(output, truth)

    def step(self, competitor: str, kind: str) -> Callable[[], Any]:
        """One inference; or forward, loss, backward and Adam."""
        if kind == "inference":
            return partial(self.infer, competitor)
        model = self.models[competitor]
        optimiser = torch.optim.Adam(model.parameters(), 1e-6)

        def train() -> None:
            optimiser.zero_grad()
            self.loss(model).backward()
            optimiser.step()

        return train

    def check(self) -> None:
        """Compare values and gradients.

        Raises:
            Different: they differ by more than rounding.
        """
        results = {name: self.infer(name)[0] for name in self.models}
        mean = results[who.OURS].mean()
        compare(f"{self.name}: values", results[who.HAND] - mean, results[who.OURS] - mean, VALUES[self.name])
        gradients = {}
        for name, model in self.models.items():
            self.loss(model).backward()
            gradients[name] = torch.cat([weights.grad.flatten() for weights in model.parameters()])
            model.zero_grad()
        compare(f"{self.name}: gradients", gradients[who.HAND], gradients[who.OURS], GRADIENTS[self.name])


def peak(name: str, competitor: str, kind: str, settings: Settings) -> int:
    """Bytes of a step at its peak, above images, weights and the state of Adam."""
    work = Work(name, settings)
    work.models = {competitor: work.models[competitor]}
    return measuring.peak(work.step(competitor, kind), settings.device)


def steps(settings: Settings) -> list[dict[str, Any]]:
    """Steps of both models: interleaved times, and peak memory."""
    cases = []
    for name, title in MODELS.items():
        started, work = time.perf_counter(), Work(name, settings)
        work.check()
        for kind in KINDS:
            calls = {competitor: work.step(competitor, kind) for competitor in work.models}
            seconds = measuring.interleaved(calls, settings.repeats, budget=60.0)
            taken: dict[str, int | None] = dict.fromkeys(work.models)
            for competitor in work.models:
                arguments = name, competitor, kind, settings
                with suppress(LeftOut):
                    taken[competitor] = measuring.isolated(peak, *arguments, device=settings.device)
            times = {competitor: measuring.spread(each) for competitor, each in seconds.items()}
            cases.append({"case": f"{title}, {kind}, 1 x 4 views", "times": times, "peak": taken})
        print(f"  {title}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return cases


def on_gpu(settings: Settings) -> list[dict[str, Any]]:
    """Steps, and models per second in batches and one by one, in bfloat16."""
    cases = steps(settings)
    for name, title in MODELS.items():
        for scenes in (BATCH, 1):
            work = Work(name, settings, scenes)
            with torch.autocast(settings.device, torch.bfloat16):
                taken = measuring.interleaved({who.OURS: partial(work.infer, who.OURS)}, settings.repeats, 3)[who.OURS]
            target = RATE if scenes == BATCH else 1e3 / LATENCY_MS
            case, rates = f"{title}, bfloat16, {scenes} x 4 views", [scenes / seconds for seconds in taken]
            cases.append(measuring.rate(case, "models/s", rates, target if name == "voxel-lsm" else None))
    return cases


def imports(settings: Settings) -> list[dict[str, Any]]:
    """The operators against torch and kornia, imported by new processes alternately, with files in the cache."""
    codes = {"lsmgeo": "from lsmgeo import Unproject, VoxelGrid", "torch, kornia": "import torch, kornia"}
    runs = {name: partial(subprocess.run, [sys.executable, "-c", code], check=True) for name, code in codes.items()}
    seconds = measuring.interleaved(runs, settings.repeats or 11)
    case = {"case": "importing", "times": {name: measuring.spread(each) for name, each in seconds.items()}}
    goal = report.ratio(case, *codes, 1.1, at_least=False)
    return [{**case, "goals": [{**goal, "goal": " : ".join(codes.values())}]}]
