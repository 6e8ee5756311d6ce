"""The learnt machines against themselves on hand-written operators: ``python -m benchmarks.models [--only NAME]``.

A training step and an inference step of the preset "paper"; the rival is the same model, with the same weights, whose
unprojection or plane sweep is what `benchmarks.rivals` writes by hand on `grid_sample`, with depth and ray directions
appended and the sweep's channels stacked for a 1x1 convolution. Outputs and gradients are compared first.

With ``--device cuda`` also models a second and the latency of one, in bfloat16, images on the GPU.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, conv2d, l1_loss

from benchmarks import contenders as who
from benchmarks import gate, memory, report, rivals, timing
from benchmarks.settings import Settings, parse
from lsmgeo import models
from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.functional import Projected, Unprojected

MODELS = {"voxel-lsm": "V-LSM", "depth-lsm": "D-LSM"}
KINDS = ("inference", "training")
# Float32 pixels move a sample by 1e-4 pixel at most; one in some hundred thousand samples changes its nearest voxel.
VALUES, GRADIENTS = {"voxel-lsm": 1e-3, "depth-lsm": 1e-2}, {"voxel-lsm": 1e-2, "depth-lsm": 5e-2}
# What the GPU is to reach: models a second in batches of 16, and milliseconds of one.
BATCH, RATE, LATENCY_MS = 16, 1000.0, 8.0


class HandUnproject(nn.Module):
    """What V-LSM and D-LSM ask of `lsmgeo.Unproject`, written by hand."""

    def __init__(self, centers: Tensor) -> None:
        super().__init__()
        self.register_buffer("centers", centers, persistent=False)

    def forward(self, features: Tensor, cameras: CameraTensors, view_mask: None = None) -> Unprojected:
        K, E = cameras.intrinsics, cameras.cam_from_world
        volume, visible = rivals.unproject(features, K, E, self.centers, image_size(cameras))
        R, t = E[..., :3, :3], E[..., :3, 3]
        points = self.centers.reshape(-1, 3)
        depth = points @ R[..., 2, :, None] + t[..., 2, None, None]  # (B, V, N, 1)
        away = points - camera_centers(R, t)[..., None, :]
        beside = torch.cat((depth, nn.functional.normalize(away, dim=-1)), -1).movedim(-1, 2)
        beside = beside.reshape(*beside.shape[:3], *self.centers.shape[:3])
        return Unprojected(torch.cat((volume, beside.to(volume.dtype)), 2), visible)


class HandProjectReduce(nn.Module):
    """What D-LSM asks of `lsmgeo.rays.ProjectReduce`, written by hand."""

    def __init__(self, weight: nn.Parameter, depths: Tensor, mode: str) -> None:
        super().__init__()
        self.weight, self.mode = weight, {"nearest": "nearest", "trilinear": "smooth"}[mode]
        self.register_buffer("depths", depths, persistent=False)

    def forward(
        self, volume: Tensor, cameras: CameraTensors, view_mask: None = None, *, size: tuple[int, int]
    ) -> Projected:
        K, E = cameras.intrinsics, cameras.cam_from_world
        image = image_size(cameras)
        maps, visible = rivals.plane_sweep_project(volume, K, E, self.depths, image, size, -0.5, 0.5, self.mode)
        R, t = E[..., :3, :3], E[..., :3, 3]
        points = rivals.sweep_points(K, E, self.depths, image, size)
        away = points - camera_centers(R, t)[:, :, None, None]
        direction = nn.functional.normalize(away, dim=-1).movedim(-1, 2)  # (B, V, 3, P, h w)
        direction = direction.reshape(*direction.shape[:4], *size)
        depth = self.depths[:, None, None].expand_as(direction[:, :, :1])
        stacked = torch.cat((maps, depth.to(maps.dtype), direction.to(maps.dtype)), 2).flatten(2, 3)
        mapped = conv2d(stacked.flatten(0, 1), self.weight)
        return Projected(mapped.unflatten(0, stacked.shape[:2]), visible)


def image_size(cameras: CameraTensors) -> tuple[int, int]:
    height, width = (int(torch.as_tensor(size).flatten()[0]) for size in cameras[2:])
    return height, width


def camera_centers(R: Tensor, t: Tensor) -> Tensor:
    return -(R.transpose(-1, -2) @ t[..., None])[..., 0]


def by_hand(model: models.VoxelLSM | models.DepthLSM) -> models.VoxelLSM | models.DepthLSM:
    """A copy with the same weights."""
    twin = copy.deepcopy(model)
    device = next(model.parameters()).device
    twin.unproject = HandUnproject(model.unproject.grid.centers().to(device))
    if model.output == "depth":
        twin.sweep = HandProjectReduce(twin.sweep.weight, model.sweep.depths.to(device), model.sweep.mode)
    return twin


class Work:
    """A model of each contender, and what it sees: B scenes of 4 views."""

    def __init__(self, name: str, settings: Settings, scenes: int = 1, views: int = 4) -> None:
        torch.manual_seed(0)
        preset = "tiny" if settings.quick else "paper"
        model = models.create(name, preset=preset).to(settings.device)
        self.name, self.device = name, settings.device
        self.models = {who.OURS: model, who.HAND: by_hand(model)}
        size = model.image_size
        azimuth = torch.rand(scenes, views) * 360
        cameras = orbit(azimuth, torch.rand(scenes, views) * 50 - 20, 2.0, focal_length=1.875 * size, height=size,
                        width=size)  # fmt: skip
        self.cameras = CameraTensors(*(torch.as_tensor(part).to(settings.device) for part in cameras))
        self.images = torch.rand(scenes, views, 3, size, size).to(settings.device)
        if model.output == "voxels":
            self.truth = (torch.rand(scenes, 1, *model.grid.shape) < 0.1).float().to(settings.device)
        else:
            self.truth = (1.5 + torch.rand(scenes, 1, views, size, size)).to(settings.device)

    def loss(self, model: nn.Module) -> Tensor:
        """After every view, as in training."""
        output = model(self.images, self.cameras)[0]
        truth = self.truth.expand_as(output)
        return binary_cross_entropy_with_logits(output, truth) if self.name == "voxel-lsm" else l1_loss(output, truth)

    def step(self, contender: str, kind: str) -> Callable[[], Any]:
        """One step: forward, loss, backward and Adam; or from images to the result."""
        model = self.models[contender]
        if kind == "inference":
            return lambda: model.run(self.images, self.cameras, by_view=False)
        optimiser = torch.optim.Adam(model.parameters(), 1e-6)

        def train() -> None:
            optimiser.zero_grad()
            self.loss(model).backward()
            optimiser.step()

        return train

    def check(self) -> None:
        """Compare values and gradients.

        Raises:
            benchmarks.gate.Different: they differ by more than rounding.
        """
        results = {name: model.run(self.images, self.cameras, by_view=False)[0] for name, model in self.models.items()}
        mean = results[who.OURS].mean()
        gate.compare(f"{self.name}: values", results[who.HAND] - mean, results[who.OURS] - mean, VALUES[self.name])
        gradients = {}
        for name, model in self.models.items():
            self.loss(model).backward()
            gradients[name] = torch.cat([weights.grad.flatten() for weights in model.parameters()])
            model.zero_grad()
        gate.compare(f"{self.name}: gradients", gradients[who.HAND], gradients[who.OURS], GRADIENTS[self.name])


def peak(name: str, contender: str, kind: str, settings: Settings, threads: int) -> int:
    """In a process of its own: bytes of a step at its peak, above images, weights, and what Adam keeps."""
    torch.set_num_threads(threads)
    work = Work(name, settings)
    del work.models[who.HAND if contender == who.OURS else who.OURS]
    return memory.peak(work.step(contender, kind), settings.device)


def measured_peak(*arguments: Any) -> int | None:
    """Bytes, or None where the system tells none."""
    if arguments[3].device == "cuda":
        return peak(*arguments)
    return memory.alone(peak, *arguments) if memory.can_measure() else None


def compare(name: str, settings: Settings) -> list[dict[str, Any]]:
    """The steps of one model: times in turn, and peak memory."""
    started = time.perf_counter()
    work = Work(name, settings)
    work.check()
    cases = []
    for kind in KINDS:
        turns = {contender: work.step(contender, kind) for contender in work.models}
        seconds = timing.interleaved(turns, settings.repeats, budget=60.0, fewest=timing.FEWEST, device=settings.device)
        taken = {
            contender: measured_peak(name, contender, kind, settings, torch.get_num_threads())
            for contender in work.models
        }
        scenes, views = work.images.shape[:2]
        cases.append(
            {
                "case": f"{MODELS[name]}, {kind}, {scenes} x {views} views",
                "times": {contender: timing.spread(each) for contender, each in seconds.items()},
                "peak": taken,
            }
        )
    print(f"  {MODELS[name]}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return cases


def rates(name: str, settings: Settings) -> list[dict[str, Any]]:
    """Models a second in batches, and of one alone, in bfloat16 on a GPU."""
    cases = []
    for scenes in (BATCH, 1):
        work = Work(name, settings, scenes)
        model = work.models[who.OURS].to(memory_format=torch.channels_last)

        def infer(model: Any = model, work: Work = work) -> Any:
            with torch.autocast("cuda", torch.bfloat16):
                return model.run(work.images, work.cameras, by_view=False)

        seconds = timing.interleaved({who.OURS: infer}, settings.repeats, warm_up=3, budget=10.0, device="cuda")[
            who.OURS
        ]
        middle = timing.spread(seconds)["median_ms"]
        goal = name == "voxel-lsm"
        cases.append(
            {
                "case": f"{MODELS[name]}, bfloat16, {scenes} x {work.images.shape[1]} views",
                "rate": 1e3 * scenes / middle,
                "unit": "models/s",
                "slowest": scenes / max(seconds),
                "fastest": scenes / min(seconds),
                "target": (RATE if scenes == BATCH else 1e3 / LATENCY_MS) if goal else None,
            }
        )
    return cases


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--only", choices=tuple(MODELS), help="one model; its rows alone are replaced")
    options, others = parser.parse_known_args(argv)
    settings = parse(__doc__, others)
    names = [options.only] if options.only else list(MODELS)
    cases = [case for name in names for case in compare(name, settings)]
    report.show(report.model_rows(cases), "one step; medians, and peaks above images and weights")
    if settings.device == "cuda":
        found = [case for name in names for case in rates(name, settings)]
        report.show(report.rate_rows(found), "models a second")
        cases += found
    kept = "models" if settings.device == "cpu" else "models_gpu"
    path = timing.RESULTS / f"{kept}.json"
    if options.only and settings.folder is not None and path.is_file():
        before = json.loads(path.read_text(encoding="utf-8"))["cases"]
        others = [case for case in before if not case["case"].startswith(MODELS[options.only])]
        cases = sorted((*others, *cases), key=lambda case: not case["case"].startswith(MODELS["voxel-lsm"]))
    settings.save(kept, cases)


if __name__ == "__main__":
    main()
