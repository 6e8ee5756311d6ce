"""The loop: its batches and losses, its end, its messages and files."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import os
import shutil
import time
from unittest import mock

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn.functional import binary_cross_entropy_with_logits

from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Recipe, render_set
from lsmgeo.errors import OptionError, TrainingError
from lsmgeo.metrics import median_depth_error, voxel_iou
from lsmgeo.models import compute_loss, create, load
from lsmgeo.training import (
    DataConfig,
    ModelConfig,
    OptimiserConfig,
    RunConfig,
    TrainingConfig,
    launch,
    optim,
    read_config,
    run_state,
)
from lsmgeo.training.batches import Need, open_shapes, training_batches, validation_batches
from lsmgeo.training.checkpoints import load_latest
from tests.training import faults
from tests.training.runs import assert_same_learning, configure, end_of, events, losses, run, write_shapes

CPU = torch.device("cpu")


def first_batches(config, count):
    """What the first steps of a run take."""
    shapes = open_shapes(config.data, Need(32, 16, False), seed=3, device=CPU, is_training=True)
    options = {"start": 0, "batch": config.run.batch, "workers": 0, "device": CPU, "rank": 0, "processes": 1}
    with contextlib.closing(training_batches(shapes, seed=3, **options)) as batches:
        return list(itertools.islice(batches, count))


def test_accumulated_batches_are_one_batch(shards, plain, tmp_path):
    run(configure(shards, steps=3, batch=2, accumulation=2), tmp_path)
    assert_same_learning(tmp_path, plain)


def test_a_step_follows_the_gradient_of_the_mean_loss(shards, plain):
    """The first logged loss and norm, from only the model, the batch and torch."""
    config = configure(shards, steps=3, batch=4)
    (batch,) = first_batches(config, 1)
    assert not batch.view_mask.all()  # scenes of one view and of two: steps weigh, not scenes
    torch.manual_seed(3)
    model = create("voxel-lsm", preset="tiny", **config.model.settings)
    loss = compute_loss(model(batch.images, batch.cameras, batch.view_mask), batch)
    loss.backward()
    squares = [(p.grad.double() ** 2).sum() for p in model.parameters() if p.grad is not None]
    expected = torch.stack(squares).sum() ** 0.5
    first = events(plain, "step")[0]
    assert first["loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert first["gradient_norm"] == pytest.approx(expected.item(), rel=1e-4)


def test_long_gradients_are_cut(shards, plain, tmp_path):
    """A step of Adam does not depend on scale, but its first moment does: a tenth of the clipped gradient."""
    run(configure(shards, steps=1, batch=4, clip_norm=0.01), tmp_path)
    assert events(tmp_path, "step")[0]["gradient_norm"] == pytest.approx(events(plain, "step")[0]["gradient_norm"])
    _, _, optimiser = end_of(tmp_path)
    moments = [state["exp_avg"] for state in optimiser["state"].values()]
    assert float(torch.stack([(m.double() ** 2).sum() for m in moments]).sum() ** 0.5) == pytest.approx(1e-3, rel=1e-3)


def test_an_evaluation_is_what_its_log_says(shards, plain):
    (line,) = events(plain, "evaluation")
    assert line["step"] == 3
    config = configure(shards)
    shapes = open_shapes(config.data, Need(32, 16, False), seed=3, device=CPU, is_training=False, views=2)
    model = load(plain)
    found = {1: [], 2: []}
    for batch in validation_batches(shapes, seed=3, count=2, batch=1, device=CPU):
        with torch.no_grad():
            output = model(batch.images, batch.cameras, batch.view_mask)
        for view in found:
            found[view].append(float(voxel_iou(output.logits[:, view - 1].sigmoid(), batch.occupancy)))
    assert {int(view): value for view, value in line["iou"].items()} == pytest.approx(
        {view: float(np.mean(values)) for view, values in found.items()}, rel=1e-4
    )
    assert line["per_category"] == pytest.approx({"chair": line["iou"]["2"]})


@pytest.mark.parametrize("loss_views", ["random", "last"])
def test_the_loss_of_some_views(shards, tmp_path, loss_views):
    """Every logged loss, from the predictions after every view; the model learns too slowly to change."""
    config = configure(shards, steps=4, batch=4)
    config = dataclasses.replace(
        config,
        run=dataclasses.replace(config.run, loss_views=loss_views),
        data=dataclasses.replace(config.data, views=(1, 2) if loss_views == "last" else 2),
        optimiser=OptimiserConfig(learning_rate=1e-30),
    )
    run(config, tmp_path)
    torch.manual_seed(3)
    model = create("voxel-lsm", preset="tiny", **config.model.settings)
    drawn, expected, of_every = [], [], []
    for step, batch in enumerate(first_batches(config, 4)):
        drawn.append(-1 if loss_views == "last" else optim.loss_views_of(config.run, step, 2)[0])
        with torch.no_grad():
            output = model(batch.images, batch.cameras, batch.view_mask)
        # A scene of one view ends with its prediction after the first.
        predicted = output.logits[:, drawn[-1]]
        expected.append(float(binary_cross_entropy_with_logits(predicted, batch.occupancy.float())))
        of_every.append(float(compute_loss(output, batch)))
    assert set(drawn) == ({-1} if loss_views == "last" else {0, 1})
    assert list(losses(tmp_path).values()) == pytest.approx(expected, rel=1e-6)
    assert of_every != pytest.approx(expected, rel=1e-5)


def test_what_a_run_leaves(shards, tmp_path):
    config = configure(shards, steps=2, pictures=1, tensorboard=True)
    trained = run(config, tmp_path)
    assert (trained.step, trained.ended, trained.exit_code, trained.is_first) == (2, "steps", 0, True)
    assert trained.checkpoint == tmp_path / "checkpoints" / "step_00000002"
    expected = launch.resolve_config(config, None)
    assert read_config(tmp_path / "config.json").to_dict() == expected.to_dict()
    assert [line["event"] for line in events(tmp_path)] == [
        *("start", "checkpoint", "step", "step", "evaluation", "checkpoint", "stop"),
    ]
    with Image.open(tmp_path / "pictures" / "predicted_00000002.png") as picture:
        assert picture.size == (3 * 96 + 2 * 4, 2 * 96 + 4)  # 2 views and the truth; 2 rows of a shape
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert board.Tags()["images"] == ["predicted"]
    assert [item.value for item in board.Scalars("train/loss")] == pytest.approx(list(losses(tmp_path).values()))
    assert {"iou/1_views", "iou/2_views", "loss/held_back"} <= set(board.Tags()["scalars"])


def test_the_best_is_kept(shards, tmp_path):
    trained = run(configure(shards, steps=5, evaluate_every=1, keep=1), tmp_path)
    values = {line["step"]: line["iou"]["2"] for line in events(tmp_path, "evaluation")}
    assert trained.best == max(values, key=lambda step: values[step])
    kept = {int(path.name[5:]) for path in (tmp_path / "checkpoints").glob("step_*")}
    assert kept == {trained.best, 5}


def depth_errors_of(model, config):
    """The error of all depth maps after one view and after two: the mean of the categories, by the number of views."""
    shapes = open_shapes(
        config.data, Need(32, None, True), seed=config.run.seed, device=CPU, is_training=False, views=2
    )
    found = {1: {}, 2: {}}
    for batch in validation_batches(shapes, seed=config.run.seed, count=2, batch=1, device=CPU):
        with torch.no_grad():
            output = model(batch.images, batch.cameras, batch.view_mask)
        for view, categories in found.items():
            errors = median_depth_error(output.depth[0, view - 1], batch.depth[0], batch.mask[0]).error
            categories.setdefault(batch.category[0], []).append(float(errors.mean()))
    return {view: np.mean([np.mean(of_one) for of_one in errors.values()]) for view, errors in found.items()}


def test_depth_is_learnt_and_drawn(tmp_path):
    render_set("synthetic-13", tmp_path / "shards", Recipe(0, 3, 32, (16,)), shapes=13, jobs=1)
    config = TrainingConfig(
        model=ModelConfig(name="depth-lsm", preset="tiny"),
        data=DataConfig(source=str(tmp_path / "shards"), views=(1, 2), validation_split="train", limit=4, workers=0),
        run=RunConfig(steps=1, batch=2, evaluate_shapes=2, evaluate_views=2, pictures=1, tensorboard=False),
    )
    trained = run(config, tmp_path / "run")
    assert trained.evaluation.measure == "depth_error"
    assert set(trained.evaluation.by_view) == {1, 2}
    assert trained.evaluation.by_view == pytest.approx(depth_errors_of(load(tmp_path / "run"), config), rel=1e-4)
    (line,) = events(tmp_path / "run", "evaluation")
    assert {int(view): value for view, value in line["depth_error"].items()} == trained.evaluation.by_view
    assert trained.evaluation.is_better_than(9.0)
    assert not trained.evaluation.is_better_than(0.0)
    with Image.open(tmp_path / "run" / "pictures" / "predicted_00000001.png") as picture:
        assert picture.size == (2 * 96 + 4, 5 * 96 + 4 * 4)


def test_the_loss_of_depth_after_a_random_view_is_that_of_the_views_so_far(tmp_path):
    """Every logged loss, from only the first views of the step's batch; the model learns too slowly to change."""
    render_set("synthetic-13", tmp_path / "shards", Recipe(0, 3, 32, (16,)), shapes=13, jobs=1)
    config = TrainingConfig(
        model=ModelConfig(name="depth-lsm", preset="tiny"),
        data=DataConfig(source=str(tmp_path / "shards"), views=3, validation_split="train", limit=4, workers=0),
        optimiser=OptimiserConfig(learning_rate=1e-30),
        run=RunConfig(steps=4, batch=2, loss_views="random", evaluate_shapes=1, pictures=0, log_every=1, seed=3),
    )
    run(config, tmp_path / "run")
    torch.manual_seed(3)
    model = create("depth-lsm", preset="tiny")
    shapes = open_shapes(config.data, Need(32, None, True), seed=3, device=CPU, is_training=True)
    options = {"start": 0, "batch": 2, "workers": 0, "device": CPU, "rank": 0, "processes": 1}
    expected, drawn = [], []
    with contextlib.closing(training_batches(shapes, seed=3, **options)) as batches:
        for step, batch in enumerate(itertools.islice(batches, 4)):
            views = optim.loss_views_of(config.run, step, 3)[0] + 1
            cameras = CameraTensors(*(field[:, :views] for field in batch.cameras))
            with torch.no_grad():
                depth = model(batch.images[:, :views], cameras, steps="last").depth[:, 0]
            on = batch.mask[:, :views] & (batch.depth[:, :views] > 0)
            expected.append(float((depth - batch.depth[:, :views])[on].abs().mean()))
            drawn.append(views)
    assert len(set(drawn)) > 1
    assert list(losses(tmp_path / "run").values()) == pytest.approx(expected, rel=1e-5)


def test_minutes_end_a_run(shards, tmp_path):
    trained = run(configure(shards, steps=None, minutes=1e-6), tmp_path)
    assert (trained.ended, trained.step, trained.exit_code) == ("minutes", 0, 0)
    trained = run(configure(shards, steps=1), tmp_path)
    assert (trained.ended, trained.step) == ("steps", 1)


def test_minutes_count_over_resumes(shards, tmp_path, monkeypatch):
    """A run whose clock advances by a minute at every reading, and then stops."""

    def set_clock(now):
        monkeypatch.setattr("lsmgeo.training.run_state.time", mock.Mock(wraps=time, monotonic=now))

    set_clock(itertools.count(1000.0, 60.0).__next__)
    run(configure(shards, steps=1), tmp_path)
    minutes = load_latest(tmp_path).part("place")["seconds"] / 60
    assert minutes >= 3
    set_clock(lambda: 5.0)
    trained = run(configure(shards, steps=3, minutes=minutes - 0.5), tmp_path)
    assert (trained.ended, trained.step) == ("minutes", 1)
    trained = run(configure(shards, steps=3, minutes=minutes + 0.5), tmp_path)
    assert (trained.ended, trained.step) == ("steps", 3)
    assert load_latest(tmp_path).part("place")["seconds"] == pytest.approx(60 * minutes)


def test_weights_to_begin_with(shards, plain, tmp_path):
    config = configure(shards, steps=1, batch=4)
    begun = dataclasses.replace(config, model=dataclasses.replace(config.model, weights=str(plain)))
    run(begun, tmp_path / "run")
    assert losses(tmp_path / "run")[1] != losses(plain)[1]
    other = {**config.model.settings, "hidden_channels": 8}
    with pytest.raises(OptionError, match="weights are of another model: hidden_channels is 4 in"):
        run(dataclasses.replace(begun, model=dataclasses.replace(begun.model, settings=other)), tmp_path / "other")


def test_a_run_that_another_process_began_meanwhile_is_left_alone(shards, tmp_path, monkeypatch):
    run(configure(shards, steps=2), tmp_path / "other")
    make = run_state.make_model

    def make_model(*arguments):
        shutil.copytree(tmp_path / "other", tmp_path / "run")
        return make(*arguments)

    monkeypatch.setattr(run_state, "make_model", make_model)
    with pytest.raises(TrainingError, match="another process has trained in"):
        run(configure(shards, seed=9), tmp_path / "run")
    assert (tmp_path / "run" / "config.json").read_bytes() == (tmp_path / "other" / "config.json").read_bytes()


def test_two_runs_do_not_share_a_folder(shards, tmp_path):
    """Another process holds the folder while this one would train in it."""
    ready, wait = os.pipe(), os.pipe()

    def hold():
        with launch.hold_folder(tmp_path):
            os.write(ready[1], b"1")
            os.read(wait[0], 1)

    child = faults.start(hold)
    os.read(ready[0], 1)
    try:
        with pytest.raises(TrainingError, match="another process trains in"):
            run(configure(shards, steps=1), tmp_path)
    finally:
        os.write(wait[1], b"1")
        assert faults.wait(child) == 0
    assert run(configure(shards, steps=1), tmp_path).step == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"precision": "fp16"}, "precision must be 'no' or 'bf16' on a CPU"),
        ({"evaluate_views": 9}, "views; 9 are asked for"),
    ],
)
def test_what_is_impossible_is_reported_before_the_work(shards, tmp_path, changes, message):
    with pytest.raises((OptionError, OSError), match=message):
        run(configure(shards, **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_written_is_reported_before_the_work(shards, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot be written"):
        run(configure(shards), tmp_path / "file")


def test_fewer_bits(shards, plain, tmp_path):
    run(configure(shards, steps=3, batch=4, precision="bf16", channels_last=True), tmp_path)
    for step, loss in losses(tmp_path).items():
        assert loss == pytest.approx(losses(plain)[step], rel=0.05)
    assert {tensor.dtype for tensor in end_of(tmp_path)[1].values()} == {torch.float32}


def test_learning_rates():
    config = OptimiserConfig(learning_rate=2.0, schedule="cosine", warm_up=10)
    rates = [optim.learning_rate(config, taken, 100) for taken in range(101)]
    assert rates[0] == pytest.approx(0.2)
    assert rates[50] == pytest.approx(1.0)
    assert rates[100] == 0.0
    assert rates[75] == pytest.approx(2.0 * 0.5 * (1 - math.sqrt(0.5)))
    constant = OptimiserConfig(learning_rate=2.0)
    assert {optim.learning_rate(constant, taken, None) for taken in (0, 7, 10**6)} == {2.0}


def test_a_cosine_may_wait_until_its_end_is_known():
    config = OptimiserConfig(learning_rate=2.0, schedule="cosine", warm_up=10)
    known, unknown = ([optim.learning_rate(config, t, steps, hold=30) for t in range(30)] for steps in (90, None))
    assert known == unknown
    assert known[9:] == [2.0] * 21
    assert optim.learning_rate(config, 60, 90, hold=30) == pytest.approx(1.0)
    assert optim.learning_rate(config, 90, 90, hold=30) == 0.0


def test_what_is_left_to_the_trainer_is_decided_once(shards, tmp_path, monkeypatch):
    """bf16 where the CPU has AMX; a resumed run keeps it without AMX."""
    left = configure(shards, precision="auto")
    for has_amx, expected in ((False, "no"), (True, "bf16")):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda has_amx=has_amx: {"amx_bf16": has_amx})
        resolved = launch.resolve_config(left, None)
        assert (resolved.run.precision, resolved.run.channels_last) == (expected, False)
    run(configure(shards, steps=1, precision="auto"), tmp_path / "run")
    assert read_config(tmp_path / "run" / "config.json").run.precision == "bf16"
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": False})
    assert run(configure(shards, steps=2, precision="auto"), tmp_path / "run").step == 2
    r2n2 = dataclasses.replace(left, model=ModelConfig(name="r2n2", preset="tiny"))
    assert launch.resolve_config(r2n2, None).run.channels_last is True


def test_weights_say_what_they_reached(shards, tmp_path):
    run(configure(shards, steps=2, evaluate_every=1), tmp_path)
    measured = [line["iou"] for line in events(tmp_path, "evaluation")]
    for step, iou in enumerate(measured, 1):
        about = load_latest(tmp_path / "checkpoints" / f"step_{step:08d}").weights.about
        assert about["validation"] == {"step": step, "measure": "iou", "by_view": [iou["1"], iou["2"]]}


def test_shapes_without_voxels_count_in_no_mean(tmp_path):
    folder = write_shapes(tmp_path / "shards", empty={6})
    run(configure(folder, steps=1), tmp_path / "run")
    (line,) = events(tmp_path / "run", "evaluation")
    model = load(tmp_path / "run")
    shapes = open_shapes(configure(folder).data, Need(32, 16, False), seed=3, device=CPU, is_training=False, views=2)
    expected = []
    for batch in validation_batches(shapes, seed=3, count=2, batch=1, device=CPU):
        if batch.occupancy.any():
            with torch.no_grad():
                logits = model(batch.images, batch.cameras, batch.view_mask).logits
            expected.append(float(voxel_iou(logits[:, 1].sigmoid(), batch.occupancy)))
    assert len(expected) == 1
    assert line["iou"]["2"] == pytest.approx(expected[0], rel=1e-5)
