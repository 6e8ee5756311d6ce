"""Small training runs: shards of random blobs, the smallest network, and what a run has left behind."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from collections.abc import Collection
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsmgeo.cameras import orbit
from lsmgeo.data import Sample, encode_sample, hash_settings, write_shard
from lsmgeo.training import (
    DataConfig,
    ModelConfig,
    OptimiserConfig,
    RunConfig,
    Trained,
    TrainingConfig,
    loop,
    train,
)
from lsmgeo.training.checkpoints import load_latest

SIZES = {"encoder_channels": (4, 4), "grid_channels": (4,), "feature_channels": 4, "hidden_channels": 4}
TRAINING, HELD_BACK = 6, 2


def write_shapes(folder: Path, empty: Collection[int] = ()) -> Path:
    """Shards of shapes to train on and others to evaluate on, 3 views of 32 pixels each, some without a voxel."""
    generator = torch.Generator().manual_seed(0)
    items = []
    for number in range(TRAINING + HELD_BACK):
        cameras = orbit(
            40.0 * number + torch.tensor([0.0, 100.0, 230.0]), 20.0, 2.0, focal_length=50.0, height=32, width=32
        )
        images = torch.rand(3, 3, 32, 32, generator=generator)
        occupancy = torch.rand(16, 16, 16, generator=generator) < 0.3
        occupancy &= number not in empty
        sample = Sample(images, cameras, None, None, occupancy, None, "chair", f"chair-{number}")
        items.append((number, encode_sample(sample, number, split="train" if number < TRAINING else "val")))
    write_shard(folder / "set-000000.tar", items, hash_settings({"made": "by a test"}))
    return folder


def configure(shards: Path, *, workers: int = 0, clip_norm: float | None = None, **run: object) -> TrainingConfig:
    """A run of 2 shapes a step, so 3 steps an epoch, that says and keeps everything."""
    settings = {
        "steps": 6, "batch": 2, "device": "cpu", "tensorboard": False, "pictures": 0, "evaluate_every": 1000,
        "evaluate_shapes": 2, "checkpoint_every": 2, "log_every": 1, "keep": 2, "seed": 3, **run,
    }  # fmt: skip
    return TrainingConfig(
        model=ModelConfig(name="voxel-lsm", preset="tiny", settings=SIZES),
        data=DataConfig(source=str(shards), views=(1, 2), workers=workers),
        optimiser=OptimiserConfig(learning_rate=0.01, warm_up=3, clip_norm=clip_norm),
        run=RunConfig(**settings),
    )


def run(config: TrainingConfig, folder: Path) -> Trained:
    return train(config, folder, quiet=True)


def events(folder: Path, name: str | None = None) -> list[dict]:
    """The lines of a run's log."""
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if name in (None, line["event"])]


def losses(folder: Path) -> dict[int, float | str]:
    """The loss of every step that was taken; of a step that was taken twice both must agree."""
    found: dict[int, float | str] = {}
    for line in events(folder, "step"):
        assert found.setdefault(line["step"], line["loss"]) == line["loss"], f"step {line['step']} differs"
    return found


def end_of(folder: Path) -> tuple[int, dict[str, Tensor], dict]:
    """Step, weights and optimiser's state at the end of a run."""
    checkpoint = load_latest(folder)
    return checkpoint.step, dict(checkpoint.weights.tensors), checkpoint.part("optimiser")


def assert_same_end(folder: Path, expected: Path) -> None:
    """Two runs ended at one step with equal numbers, bit by bit, and every loss on the way was the same."""
    (step, weights, moments), (step_there, weights_there, moments_there) = end_of(folder), end_of(expected)
    assert step == step_there
    torch.testing.assert_close(weights, weights_there, rtol=0, atol=0)
    torch.testing.assert_close(moments, moments_there, rtol=0, atol=0)
    assert losses(folder).items() <= losses(expected).items()


def assert_same_run(folder: Path, expected: Path) -> None:
    """And the log of one has every step of the other."""
    assert_same_end(folder, expected)
    assert losses(folder).keys() == losses(expected).keys()


def assert_same_learning(folder: Path, expected: Path) -> None:
    """Losses, gradients and weights of two runs agree as sums in another order do."""
    for ours, theirs in zip(events(folder, "step"), events(expected, "step"), strict=True):
        for name in ("step", "loss", "gradient_norm", "learning_rate"):
            assert ours[name] == pytest.approx(theirs[name], rel=2e-4), (name, ours["step"])
    torch.testing.assert_close(end_of(folder)[1], end_of(expected)[1], rtol=1e-3, atol=1e-3)


def changed(config: TrainingConfig, group: str, **settings: object) -> TrainingConfig:
    return dataclasses.replace(config, **{group: dataclasses.replace(getattr(config, group), **settings)})


def stop_in(monkeypatch, step: int) -> None:
    """Ask to stop in the middle of a step, the first of the process being 1."""
    find, calls = loop.find_gradients, []

    def find_gradients(*arguments, **options):
        calls.append(1)
        if len(calls) == step:
            os.kill(os.getpid(), signal.SIGTERM)
        return find(*arguments, **options)

    monkeypatch.setattr(loop, "find_gradients", find_gradients)
