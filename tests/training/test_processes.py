"""Two processes learn what one learns from the same shapes (gloo)."""

from __future__ import annotations

import dataclasses
import os
import signal

import pytest
import torch

from lsmgeo.training import loop
from lsmgeo.training.optim import loss_views_of
from tests.training.faults import in_processes
from tests.training.runs import assert_same_learning, configure, end_of, events, run


@pytest.fixture(scope="module")
def together(shards, tmp_path_factory):
    """The same in two processes."""
    folder = tmp_path_factory.mktemp("together")
    assert in_processes(lambda rank: run(configure(shards, steps=3, batch=2), folder)) == [0, 0]
    return folder


def test_two_processes_learn_what_one_learns(plain, together):
    assert events(together, "start")[0]["processes"] == 2
    assert_same_learning(together, plain)


def test_two_processes_plan_together_and_take_steps_of_one_view(shards, tmp_path):
    """What convolves the state has no gradient after one view; the first process's number of steps is everybody's."""
    config = configure(shards, steps=None, cpu_minutes=1e-3, batch=1)
    config = dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, views=2),
        run=dataclasses.replace(config.run, loss_views="random"),
    )
    assert {tuple(loss_views_of(config.run, step, 2)) for step in range(6)} == {(0,), (1,)}
    assert in_processes(lambda rank: run(config, tmp_path)) == [0, 0]
    assert [line["steps"] for line in events(tmp_path, "plan")] == [31]
    assert end_of(tmp_path)[0] == 31


def test_two_processes_evaluate_the_same_set(plain, together):
    (ours,), (theirs,) = events(together, "evaluation"), events(plain, "evaluation")
    assert ours["iou"] == pytest.approx(theirs["iou"], rel=1e-3)
    assert ours["loss"] == pytest.approx(theirs["loss"], rel=1e-3)


def test_only_the_first_process_writes(together):
    lines = events(together)
    assert [line["event"] for line in lines].count("start") == 1
    assert len(events(together, "step")) == 3


def test_processes_that_begin_differently_are_reported(shards, tmp_path):
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
