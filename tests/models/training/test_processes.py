"""Two processes learn what one learns from the same shapes (gloo)."""

from __future__ import annotations

import dataclasses
import os
import signal

import pytest
import torch

from lsmgeo.errors import CheckpointError
from lsmgeo.models.training import loop
from lsmgeo.models.training.optimising import loss_steps
from tests.models.training.faults import in_processes
from tests.models.training.runs import configure, end_of, events, run, write_shapes


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return write_shapes(tmp_path_factory.mktemp("shards"))


@pytest.fixture(scope="module")
def alone(shards, tmp_path_factory):
    """Three steps of four shapes with one or two views, in one process."""
    folder = tmp_path_factory.mktemp("alone")
    run(configure(shards, steps=3, batch=4), folder)
    return folder


@pytest.fixture(scope="module")
def together(shards, tmp_path_factory):
    """The same in two processes."""
    folder = tmp_path_factory.mktemp("together")
    assert in_processes(lambda rank: run(configure(shards, steps=3, batch=2), folder)) == [0, 0]
    return folder


def test_two_processes_learn_what_one_learns(alone, together):
    assert events(together, "start")[0]["processes"] == 2
    for ours, theirs in zip(events(together, "step"), events(alone, "step"), strict=True):
        for name in ("step", "loss", "gradient_norm", "learning_rate"):
            assert ours[name] == pytest.approx(theirs[name], rel=2e-4), (name, ours["step"])
    (_, weights, _), (_, weights_there, _) = end_of(together), end_of(alone)
    torch.testing.assert_close(weights, weights_there, rtol=1e-3, atol=1e-3)


def test_two_processes_plan_together_and_take_steps_of_one_view(shards, tmp_path):
    """What convolves the state has no gradient after one view; the first process's number of steps is everybody's."""
    config = configure(shards, steps=None, cpu_minutes=1e-3, batch=1)
    config = dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, views=2),
        run=dataclasses.replace(config.run, loss_views="random"),
    )
    assert {tuple(loss_steps(config.run, step, 2)) for step in range(6)} == {(0,), (1,)}
    assert in_processes(lambda rank: run(config, tmp_path)) == [0, 0]
    assert [line["steps"] for line in events(tmp_path, "plan")] == [31]
    assert end_of(tmp_path)[0] == 31


def test_two_processes_evaluate_the_same_set(alone, together):
    (ours,), (theirs,) = events(together, "evaluation"), events(alone, "evaluation")
    assert ours["iou"] == pytest.approx(theirs["iou"], rel=1e-3)
    assert ours["loss"] == pytest.approx(theirs["loss"], rel=1e-3)


def test_the_first_process_alone_writes(together):
    lines = events(together)
    assert [line["event"] for line in lines].count("start") == 1
    assert len(events(together, "step")) == 3


def test_one_process_does_not_go_on_with_the_run_of_two(shards, together):
    with pytest.raises(CheckpointError, match="processes was 2 and is 1 now"):
        run(configure(shards, steps=4, batch=2), together)


def test_processes_that_begin_differently_are_told(shards, tmp_path):
    """One of them was given another seed: neither trains."""

    def begin(rank):
        run(configure(shards, steps=1, batch=2, seed=rank), tmp_path)

    assert in_processes(begin) == [1, 1]
    assert not (tmp_path / "checkpoints").exists()


def test_a_stop_asked_of_one_process_stops_both(shards, together, tmp_path):
    def begin(rank):
        find, calls = loop.find_gradients, []

        def find_gradients(*arguments, **options):
            calls.append(1)
            if rank == 1 and len(calls) == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            return find(*arguments, **options)

        loop.find_gradients = find_gradients
        trained = run(configure(shards, steps=3, batch=2), tmp_path)
        assert (trained.ended, trained.step) == ("stop", 1)
        raise SystemExit(trained.exit_code)

    assert in_processes(begin) == [0, 143]
    assert end_of(tmp_path)[0] == 1
    assert in_processes(lambda rank: run(configure(shards, steps=3, batch=2), tmp_path)) == [0, 0]
    torch.testing.assert_close(end_of(tmp_path)[1], end_of(together)[1], rtol=0, atol=0)
