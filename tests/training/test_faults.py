"""What goes wrong in the middle of a run, and that nothing is lost by it: F1, F2, F5, F6, F8 of the real loop."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from lsmgeo.errors import CheckpointError, TrainingError
from lsmgeo.training import RunConfig, loop, optim, run_state
from lsmgeo.training import logs as log_module
from tests.training.faults import Points, fill, in_child, in_processes, kill, leftovers
from tests.training.runs import (
    assert_same_end,
    assert_same_run,
    configure,
    end_of,
    events,
    losses,
    run,
)

KILLS = 14  # moments of a save at which a run is killed


def ask(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def at_call(monkeypatch, owner, name: str, number: int, before: Callable[[], object]) -> None:
    """Do something before a function's n-th call, from 1."""
    function, calls = getattr(owner, name), []

    def replacement(*arguments, **options):
        calls.append(1)
        if len(calls) == number:
            before()
        return function(*arguments, **options)

    monkeypatch.setattr(owner, name, replacement)


def during_save(monkeypatch, number: int, points: Points) -> None:
    """Count only the points of a process's n-th save, from 1."""
    save, calls = run_state.save_checkpoint, []

    def replacement(*arguments, **options):
        calls.append(1)
        if len(calls) != number:
            return save(*arguments, **options)
        with points.counted():
            return save(*arguments, **options)

    monkeypatch.setattr(run_state, "save_checkpoint", replacement)


# F1: killed


def test_a_run_killed_in_a_save_goes_on_as_if_it_had_not_been(config, whole, half, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        points = Points()
        during_save(patch, 1, points)
        run(config, shutil.copytree(half, tmp_path / "counted"))
    count = len(points.calls)
    resumed_at = []
    for at in sorted({number * (count - 1) // (KILLS - 1) for number in range(KILLS)}):
        folder = shutil.copytree(half, tmp_path / str(at))

        def killed(folder=folder, at=at) -> None:
            with monkeypatch.context() as patch:
                during_save(patch, 1, Points(kill, at))
                run(config, folder)

        assert in_child(killed) == -signal.SIGKILL
        run(config, folder)
        assert_same_end(folder, whole)
        assert leftovers(folder / "checkpoints") == []
        resumed_at.append(events(folder, "resume")[-1]["step"])
    assert resumed_at == sorted(resumed_at)
    assert set(resumed_at) == {2, 4}


@pytest.mark.parametrize("step", [1, 3])
def test_a_run_killed_in_a_step_goes_on_as_if_it_had_not_been(config, whole, tmp_path, monkeypatch, step):
    def killed() -> None:
        at_call(monkeypatch, loop, "move_parameters", step, lambda: kill(""))
        run(config, tmp_path)

    assert in_child(killed) == -signal.SIGKILL
    run(config, tmp_path)
    assert_same_run(tmp_path, whole)


# F2: the disk is full


def limit(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def test_a_disk_that_is_full_for_a_while_costs_no_step(config, whole, begun, monkeypatch):
    """Files may not grow beyond 20 kB from step 3 to 5, so that of the save at step 4 only a part has room."""
    points = 20_000, resource.RLIM_INFINITY

    def work() -> None:
        at_call(monkeypatch, loop, "find_gradients", 1, lambda: limit(points[0]))
        at_call(monkeypatch, loop, "find_gradients", 3, lambda: limit(points[1]))
        with pytest.warns(UserWarning, match=r"step_00000004: cannot be written .*File too large.* the run continues"):
            run(config, begun)

    assert in_child(work) == 0
    assert_same_end(begun, whole)
    assert losses(begun).keys() == {1, 2, 3, 4, 5, 6}
    assert sorted(os.listdir(begun / "checkpoints")) == ["LATEST", "step_00000002", "step_00000006"]
    assert [line["step"] for line in events(begun, "checkpoint_failed")] == [4]


def test_a_disk_that_stays_full_ends_the_run_with_an_error_and_the_last_checkpoint(config, whole, begun, monkeypatch):
    def work() -> None:
        at_call(monkeypatch, loop, "find_gradients", 1, lambda: limit(20_000))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with pytest.raises(CheckpointError, match="File too large"):
                run(config, begun)

    assert in_child(work) == 0
    assert leftovers(begun / "checkpoints") == []
    assert end_of(begun)[0] == 2
    run(config, begun)
    assert_same_end(begun, whole)


@pytest.mark.parametrize("at", [0, 6, 14])
def test_a_save_without_room_is_tried_again(config, whole, begun, monkeypatch, at):
    during_save(monkeypatch, 1, Points(fill, at))
    with pytest.warns(UserWarning, match=r"No space left on device.* the run continues"):
        run(config, begun)
    assert_same_run(begun, whole)


def test_a_stop_right_after_a_failed_save_saves(config, whole, begun, monkeypatch):
    """The save that is due at step 4 fails, and the process is asked to stop at the same step."""
    with monkeypatch.context() as patch:
        at_call(patch, run_state, "save_checkpoint", 1, ask)
        during_save(patch, 1, Points(fill, 0))
        with pytest.warns(UserWarning, match="the run continues"):
            stopped = run(config, begun)
    assert (stopped.step, stopped.ended) == (4, "stop")
    assert end_of(begun)[0] == 4
    run(config, begun)
    assert_same_end(begun, whole)


# F5: asked to stop


def test_a_stop_in_an_evaluation_puts_it_off(shards, whole, begun, monkeypatch):
    config = configure(shards, evaluate_every=4)
    batches, calls = run_state.validation_batches, []

    def asking(*arguments, **options):
        for batch in batches(*arguments, **options):
            calls.append(1)
            if len(calls) == 1:
                ask()
            yield batch

    with monkeypatch.context() as patch:
        patch.setattr(run_state, "validation_batches", asking)
        stopped = run(config, begun)
    assert (stopped.step, stopped.exit_code) == (4, 143)
    assert 4 not in [line["step"] for line in events(begun, "evaluation")]
    run(config, begun)
    assert_same_end(begun, whole)
    assert [line["step"] for line in events(begun, "evaluation")] == [2, 4, 6]


@pytest.mark.parametrize("at", [1, 9, 25])
def test_a_stop_in_a_save_ends_after_it(config, whole, begun, monkeypatch, at):
    with monkeypatch.context() as patch:
        during_save(patch, 1, Points(ask, at))
        stopped = run(config, begun)
    assert (stopped.step, stopped.exit_code) == (4, 143)
    assert [line["step"] for line in events(begun, "checkpoint")] == [0, 2, 4]
    run(config, begun)
    assert_same_run(begun, whole)


def test_a_stop_while_waiting_for_data_does_not_wait(config, whole, begun, monkeypatch):
    batches = run_state.training_batches

    def slow(*arguments, **options):
        for number, batch in enumerate(batches(*arguments, **options), 1):
            if number == 2:
                threading.Timer(0.1, ask).start()
                time.sleep(60)
            yield batch

    with monkeypatch.context() as patch:
        patch.setattr(run_state, "training_batches", slow)
        stopped = run(config, begun)
    assert (stopped.step, stopped.exit_code) == (3, 143)
    run(config, begun)
    assert_same_run(begun, whole)


def test_a_second_signal_ends_a_save_at_once(config, whole, begun, monkeypatch):
    def impatient(_: str) -> None:
        ask()
        ask()

    def work() -> None:
        during_save(monkeypatch, 1, Points(impatient, 9))
        run(config, begun)

    assert in_child(work) == 143
    assert leftovers(begun / "checkpoints") != []
    run(config, begun)
    assert_same_end(begun, whole)
    assert leftovers(begun / "checkpoints") == []


def test_the_signal_is_caught_only_in_training(config, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    run(configure(Path(config.data.source), steps=1), tmp_path)
    assert signal.getsignal(signal.SIGTERM) is before


# F6: numbers that are not finite


def poison(monkeypatch, steps: set[int]) -> None:
    """Make the loss of some steps NaN, the first of the process being 1, and with it all gradients."""
    loss, calls = optim.sum_loss, []

    def poisoned(*arguments, **options):
        calls.append(1)
        total, count = loss(*arguments, **options)
        return (total * math.nan if len(calls) in steps else total), count

    monkeypatch.setattr(optim, "sum_loss", poisoned)


def numbers(folder: Path) -> torch.Tensor:
    """All weights and moments of a run's end."""
    _, weights, moments = end_of(folder)
    found = [*weights.values(), *(x for state in moments["state"].values() for x in state.values())]
    return torch.cat([torch.as_tensor(x).float().reshape(-1) for x in found])


def test_a_step_that_is_not_finite_is_skipped_and_named(config, shards, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        poison(patch, {3})
        run(config, tmp_path)
    assert numbers(tmp_path).isfinite().all()
    (skipped,) = events(tmp_path, "skipped")
    assert (skipped["step"], skipped["loss"]) == (3, "nan")
    assert len(skipped["shapes"]) == 2
    assert all(name.startswith("chair-") for name in skipped["shapes"])
    # The schedule, which warms up over three steps, waits as well.
    rates = [line["learning_rate"] for line in events(tmp_path, "step")]
    assert rates[2:4] == [0.01, 0.01]
    assert torch.load(next(tmp_path.glob("checkpoints/*06/state.pt")), weights_only=True)["guard"]["skipped"] == 1


def test_a_skipped_step_leaves_everything_as_it_was(config, whole, tmp_path, monkeypatch):
    """The last step is skipped: the end is that of a run of one step less."""
    with monkeypatch.context() as patch:
        poison(patch, {6})
        run(config, tmp_path / "poisoned")
    run(configure(Path(config.data.source), steps=5), tmp_path / "shorter")
    for one, other in zip(end_of(tmp_path / "poisoned")[1:], end_of(tmp_path / "shorter")[1:], strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_three_steps_in_a_row_end_the_run_which_loses_nothing(config, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        poison(patch, {3, 4, 5})
        with pytest.raises(
            TrainingError, match=r"in 3 steps in succession.*step 3 with chair-\d, chair-\d; step 4 with"
        ):
            run(config, tmp_path)
    assert end_of(tmp_path)[0] == 5
    assert numbers(tmp_path).isfinite().all()
    assert [line["step"] for line in events(tmp_path, "skipped")] == [3, 4, 5]
    run(config, tmp_path)
    assert numbers(tmp_path).isfinite().all()
    assert end_of(tmp_path)[0] == 6


def test_a_loss_that_is_not_finite_in_one_process_is_skipped_by_both(config, shards, tmp_path, monkeypatch):
    def work(rank: int) -> None:
        poison(monkeypatch, {2} if rank == 1 else set())
        trained = run(configure(shards, steps=3), tmp_path)
        assert (trained.step, trained.ended) == (3, "steps")

    assert in_processes(work) == [0, 0]
    assert numbers(tmp_path).isfinite().all()
    (skipped,) = events(tmp_path, "skipped")
    assert skipped["step"] == 2
    assert len(skipped["shapes"]) == 4
    with pytest.raises(CheckpointError, match="processes was 2 and is 1 now"):
        run(configure(shards, steps=4), tmp_path)


# F8: folders that vanish or cannot be written


def test_a_log_that_cannot_be_written_is_reported_once_and_costs_nothing(config, whole, begun, monkeypatch):
    opened = os.open

    def full(path, *arguments, **options):
        if str(path).endswith("log.jsonl"):
            fill("open")
        return opened(path, *arguments, **options)

    monkeypatch.setattr(log_module.os, "open", full)
    with pytest.warns(UserWarning, match=r"log.jsonl: cannot be written .*No space left") as told:
        run(config, begun)
    assert len(told) == 1
    assert_same_end(begun, whole)


@pytest.mark.parametrize("before", [b"", b'{"event": "step", "st'])
def test_lines_of_the_log_are_whole_on_a_disk_with_room_for_half_a_line(tmp_path, before):
    """And where a loss of power left half a line, the next begins anew."""
    path = tmp_path / "log.jsonl"
    path.write_bytes(before)

    def work() -> None:
        log = log_module.RunLog(tmp_path, RunConfig(steps=1, tensorboard=False), step=0, quiet=True)
        log.event("first", value=1)
        limit(path.stat().st_size + 10)
        with pytest.warns(UserWarning, match=r"log.jsonl: cannot be written"):
            log.event("second", value=2)
        limit(resource.RLIM_INFINITY)
        log.event("third", value=3)

    assert in_child(work) == 0
    lines = [line for line in path.read_bytes().splitlines() if line != before]
    assert [json.loads(line)["event"] for line in lines] == ["first", "third"]


def test_checkpoints_that_vanish_are_written_again(config, whole, begun, monkeypatch):
    at_call(monkeypatch, loop, "find_gradients", 1, lambda: shutil.rmtree(begun / "checkpoints"))
    run(config, begun)
    assert_same_end(begun, whole)


def test_a_run_folder_that_vanishes_is_made_again(config, whole, begun, monkeypatch):
    at_call(monkeypatch, loop, "find_gradients", 1, lambda: shutil.rmtree(begun))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the lines of the log until the next checkpoint
        run(config, begun)
    assert_same_end(begun, whole)


def test_a_folder_that_cannot_be_written_is_reported_before_the_work(config, tmp_path, monkeypatch):
    (tmp_path / "checkpoints").write_text("")
    at_call(monkeypatch, loop, "find_gradients", 1, lambda: pytest.fail("worked in vain"))
    with pytest.raises(CheckpointError, match="cannot be written"):
        run(config, tmp_path)
