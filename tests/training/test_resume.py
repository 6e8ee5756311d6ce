"""A run that stopped and went on is the run that never stopped, bit by bit (F9, F10, F11)."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import random
import shutil
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from lsmgeo.errors import CheckpointError
from lsmgeo.models import create
from lsmgeo.training import OptimiserConfig, TrainingConfig, loop, read_config, run_state
from lsmgeo.training.checkpoints import load_latest
from tests.training.runs import (
    assert_same_end,
    assert_same_run,
    changed,
    configure,
    events,
    run,
    stop_in,
)


@pytest.mark.parametrize("step", [1, 3, 4])
def test_a_run_stopped_at_a_step_goes_on_as_if_it_had_not(shards, whole, tmp_path, monkeypatch, step):
    with monkeypatch.context() as patch:
        stop_in(patch, step)
        stopped = run(configure(shards), tmp_path)
    assert (stopped.step, stopped.ended, stopped.exit_code) == (step, "stop", 143)
    assert stopped.checkpoint.name == f"step_{step:08d}"
    assert run(configure(shards), tmp_path).ended == "steps"
    assert_same_run(tmp_path, whole)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_run_stopped_at_every_step_goes_on_as_if_it_had_not(shards, tmp_path, monkeypatch):
    """40 steps; each of 40 runs stops once, at another step, and one more run stops at all of them."""
    config = configure(shards, steps=40, checkpoint_every=1000)
    expected = tmp_path / "whole"
    run(config, expected)
    for step in range(1, 40):
        folder = tmp_path / str(step)
        with monkeypatch.context() as patch:
            stop_in(patch, step)
            assert run(config, folder).step == step
        run(config, folder)
        assert_same_run(folder, expected)
    folder = tmp_path / "all"
    for step in range(1, 40):
        with monkeypatch.context() as patch:
            stop_in(patch, 1)
            assert run(config, folder).step == step
    run(config, folder)
    assert_same_run(folder, expected)


def test_the_comparison_can_fail(shards, whole, tmp_path):
    """Another seed, a step more or less, a learning rate that is off by a hair."""
    run(configure(shards, seed=4), tmp_path / "seed")
    run(configure(shards, steps=5), tmp_path / "steps")
    config = configure(shards)
    rate = dataclasses.replace(config.optimiser, learning_rate=config.optimiser.learning_rate * (1 + 1e-6))
    run(dataclasses.replace(config, optimiser=rate), tmp_path / "rate")
    for name in ("seed", "steps", "rate"):
        with pytest.raises(AssertionError):
            assert_same_end(tmp_path / name, whole)


def test_nothing_is_drawn_from_generators_of_all(shards, whole, begun, monkeypatch):
    """No state of them is saved: they are set to something else before every step, in a run that stops and resumes.

    Its first checkpoint is of an earlier version, which did save it.
    """
    find, save, seeds = loop.find_gradients, run_state.save_checkpoint, itertools.count(100)

    def find_gradients(*arguments, **options):
        seed = next(seeds)
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the generator of all
        torch.manual_seed(seed)
        return find(*arguments, **options)

    def save_checkpoint(*arguments, state, **options):
        state = {**state, "random": {"torch": torch.get_rng_state(), "cuda": [], "python": [3, torch.ones(625), None]}}
        return save(*arguments, state=state, **options)

    monkeypatch.setattr(loop, "find_gradients", find_gradients)
    monkeypatch.setattr(run_state, "save_checkpoint", save_checkpoint)
    with monkeypatch.context() as patch:
        stop_in(patch, 2)
        assert run(configure(shards), begun).step == 4
    assert "random" in load_latest(begun).state
    run(configure(shards), begun)
    assert_same_run(begun, whole)


# Four workers on two cores give a warning that they are many, and work as they should.
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize(
    "changes",
    [{}, {"evaluate_every": 1, "checkpoint_every": 1}, {"workers": 1},
     pytest.param({"workers": 4}, marks=pytest.mark.long)],
)  # fmt: skip
def test_the_same_seed_gives_the_same_run_whatever_is_done_beside(shards, whole, tmp_path, changes):
    run(configure(shards, **changes), tmp_path)
    assert_same_run(tmp_path, whole)
    assert len(events(tmp_path, "evaluation")) == (6 if "evaluate_every" in changes else 1)


def test_a_run_goes_on_with_other_workers_and_later_checkpoints(shards, whole, begun):
    run(configure(shards, workers=2, checkpoint_every=3, keep=1), begun)
    assert_same_end(begun, whole)
    assert sorted(os.listdir(begun / "checkpoints"))[0] == "LATEST"


def test_a_finished_run_stays_as_it_is(shards, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    again = run(configure(shards), folder)
    assert (again.step, again.ended) == (6, "steps")
    assert_same_end(folder, whole)
    assert len(events(folder, "checkpoint")) == len(events(whole, "checkpoint"))


def test_a_damaged_checkpoint_costs_steps_and_nothing_else(shards, whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / "checkpoints" / "step_00000006" / "state.pt").write_bytes(b"")
    with pytest.warns(UserWarning, match=r"step_00000006.* Going back to .*step_00000004"):
        run(configure(shards), folder)
    assert_same_end(folder, whole)
    assert [line["step"] for line in events(folder, "resume")] == [4]


@pytest.mark.parametrize(
    ("group", "values", "named"),
    [
        ("run", {"batch": 3}, r"run\.batch was 2 and is 3 now"),
        ("model", {"name": "r2n2", "settings": {}}, r"model\.name was 'voxel-lsm' and is 'r2n2' now"),
        ("optimiser", {"learning_rate": 0.1}, r"optimiser\.learning_rate was 0\.01 and is 0\.1 now"),
        ("data", {"views": 2}, r"data\.views was \[1, 2\] and is 2 now"),
    ],
)
def test_another_run_is_refused_by_the_name_of_what_differs(shards, begun, group, values, named):
    before = sorted(os.listdir(begun / "checkpoints"))
    with pytest.raises(CheckpointError, match=named):
        run(changed(configure(shards), group, **values), begun)
    assert sorted(os.listdir(begun / "checkpoints")) == before


def test_weights_of_another_shape_and_states_without_a_part_are_refused(shards, begun, monkeypatch):
    checkpoint = load_latest(begun)
    state = {name: value for name, value in checkpoint.state.items() if name != "guard"}
    other = dataclasses.replace(checkpoint, state=state)
    monkeypatch.setattr(loop, "load_latest", lambda folder: other)
    with pytest.raises(CheckpointError, match=r"state\.pt has no 'guard'"):
        run(configure(shards), begun)
    weights = dataclasses.replace(checkpoint.weights, tensors=create("voxel-lsm", preset="tiny").state_dict())
    other = dataclasses.replace(checkpoint, weights=weights)
    with pytest.raises(CheckpointError, match="float32; the model has"):
        run(configure(shards), begun)


# The first 5 of 30 steps take 9 s, and so does the first of two trial evaluations; 2.5 s are left after the last one.
CPU_MINUTES = (5 * 9 + 25 + 9 + 4 + 4 + 2.5) / 60


@pytest.fixture(scope="module")
def timed_config(shards) -> TrainingConfig:
    config = configure(shards, steps=None, cpu_minutes=CPU_MINUTES, checkpoint_every=8)
    return dataclasses.replace(config, optimiser=OptimiserConfig(learning_rate=0.01, schedule="cosine"))


@contextlib.contextmanager
def cpu_clock(second: float = 1.0, *, is_new: bool = True):
    """A clock on which a step takes a second, an evaluation 4, and nothing else any time; the first of each take 9."""
    now = [0.0]

    def takes(seconds, work, slow=0):
        calls = itertools.count()

        def wrapped(*arguments, **options):
            now[0] += 9 if next(calls) < slow else seconds
            return work(*arguments, **options)

        return wrapped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_state, "time", mock.Mock(wraps=time, process_time=lambda: now[0]))
        patch.setattr(loop, "find_gradients", takes(second, loop.find_gradients, slow=5 if is_new else 0))
        patch.setattr(run_state, "evaluate_model", takes(4.0, run_state.evaluate_model, slow=1))
        yield


@pytest.fixture(scope="module")
def timed(timed_config, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("timed")
    with cpu_clock():
        run(timed_config, folder)
    return folder


def test_cpu_minutes_become_a_number_of_steps(timed, timed_config):
    """What is left after 30 steps and the evaluations is filled with steps of a second: the slow ones do not count."""
    assert [line["steps"] for line in events(timed, "plan")] == [32]
    (stop,) = events(timed, "stop")
    assert (stop["step"], stop["reason"], stop["cpu_seconds"]) == (32, "steps", 5 * 9 + 27 + 9 + 4 + 4)
    assert read_config(timed / "config.json").run.steps == 32
    rates = {line["step"]: line["learning_rate"] for line in events(timed, "step")}
    assert rates[30] == pytest.approx(0.01)
    assert rates[32] == pytest.approx(0.005)


def test_steps_that_were_planned_are_never_planned_again(timed, timed_config, tmp_path, monkeypatch):
    """A run killed after the plan resumes bit by bit on a slower machine; so does one with a given number of steps."""
    with cpu_clock(), monkeypatch.context() as patch:
        stop_in(patch, 31)
        assert run(timed_config, tmp_path / "killed").step == 31
    with cpu_clock(second=50.0, is_new=False):
        run(timed_config, tmp_path / "killed")
    assert_same_end(tmp_path / "killed", timed)
    assert len(events(tmp_path / "killed", "plan")) == 1
    run(read_config(timed / "config.json"), tmp_path / "told")
    assert_same_end(tmp_path / "told", timed)


@pytest.mark.parametrize("step", [3, 29])
def test_a_run_killed_while_it_is_timed_is_timed_on(timed, timed_config, tmp_path, monkeypatch, step):
    with cpu_clock(), monkeypatch.context() as patch:
        stop_in(patch, step)
        assert run(timed_config, tmp_path).step == step
    with cpu_clock(is_new=step == 3):
        run(timed_config, tmp_path)
    # What was slow again at step 4 to 8 is in the time, not in the plan of step 29.
    assert (load_latest(tmp_path).step == 32) == (step == 29)
    if step == 29:
        assert_same_end(tmp_path, timed)


def test_a_stop_while_a_run_is_planned_leaves_no_plan(timed_config, tmp_path, monkeypatch):
    """SIGTERM comes in step 30: its evaluation is cut short, and a plan made of it would be wrong for good.

    The 9 s that it took are gone, and leave no time for more than the one step that there always is.
    """
    with cpu_clock(), monkeypatch.context() as patch:
        stop_in(patch, 30)
        stopped = run(timed_config, tmp_path)
    assert (stopped.step, stopped.ended) == (30, "stop")
    assert load_latest(tmp_path).config["run"]["steps"] is None
    assert events(tmp_path, "plan") == []
    with cpu_clock(is_new=False):
        run(timed_config, tmp_path)
    assert [line["steps"] for line in events(tmp_path, "plan")] == [31]


def test_a_configuration_that_knows_more_than_the_checkpoint_is_not_refused(timed, timed_config, tmp_path, monkeypatch):
    """The plan is in config.json, and the newest checkpoint that verifies is from before it."""
    with cpu_clock(), monkeypatch.context() as patch:
        stop_in(patch, 20)
        run(timed_config, tmp_path)
    with cpu_clock(is_new=False):
        run(read_config(timed / "config.json"), tmp_path)
    assert_same_end(tmp_path, timed)
