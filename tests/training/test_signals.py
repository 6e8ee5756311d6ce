"""Being asked to stop, at any moment (F5)."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time

import pytest
import torch
from torch.utils.data import DataLoader

from lsmgeo.errors import TrainingError
from lsmgeo.training.launch import any_true, catch_stop, check_agreement, gather, ignore_stop
from tests.training.faults import in_child, in_processes


def ask(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


def test_the_first_signal_sets_a_flag_and_the_handler_comes_back():
    seen = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        with catch_stop() as stop:
            assert not stop
            assert stop.exit_code == 0
            ask()
            assert stop
            assert (stop.signal, stop.exit_code) == (signal.SIGTERM, 143)
        assert seen == []
        ask()
        assert seen == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_the_handler_comes_back_after_an_error():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ValueError, match="inside"), catch_stop():
        raise ValueError("inside")
    assert signal.getsignal(signal.SIGTERM) is before


def test_without_it_nothing_is_caught():
    def work() -> None:
        with catch_stop():
            pass
        ask()

    assert in_child(work) == -signal.SIGTERM


def test_the_second_signal_ends_the_process_at_once():
    def work() -> None:
        with catch_stop():
            ask()
            try:
                ask()
            finally:
                os._exit(7)  # not reached: a second signal waits for no block

    assert in_child(work) == 143


def test_another_signal_after_the_first_changes_nothing():
    with catch_stop() as stop:
        ask(signal.SIGINT)
        assert stop.exit_code == 130
        ask(signal.SIGTERM)  # another one changes nothing: torchrun answers Ctrl-C with a signal of its own
        assert stop.exit_code == 130


def test_another_thread_only_gets_a_flag():
    found = []

    def work() -> None:
        with catch_stop() as stop:
            found.append(bool(stop))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [False]


def test_a_wait_for_data_ends_with_the_signal():
    def slow():
        yield 1
        threading.Timer(0.05, ask).start()
        time.sleep(60)
        yield 2

    with catch_stop() as stop:
        items = slow()
        assert stop.next_item(items) == 1
        assert stop.next_item(items) is None
        assert stop
        # Nothing is waited for once it is set.
        assert stop.next_item(iter([3])) is None


def test_handlers_of_errors_on_the_way_do_not_swallow_the_signal():
    def stubborn():
        while True:
            try:
                ask()
                time.sleep(60)
            except Exception:
                continue
        yield

    with catch_stop() as stop:
        assert stop.next_item(stubborn()) is None


def test_the_end_of_the_data_passes():
    with catch_stop() as stop:
        with pytest.raises(StopIteration):
            stop.next_item(iter([]))
        ask()  # after the wait: only sets the flag
        assert stop


def test_a_signal_at_any_moment_of_a_wait_is_seen():
    """Bombarded by a timer, a wait either gives its item or ends with the flag set; nothing else comes out."""
    outcomes = set()
    for trial in range(300):
        with catch_stop() as stop:
            signal.signal(signal.SIGALRM, stop._handle)
            signal.setitimer(signal.ITIMER_REAL, 2e-6 * (trial + 1))
            item = stop.next_item(iter([trial]))
            while not stop:
                pass
            outcomes.add(item is None)
            assert item in (None, trial)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    assert outcomes


class Slow(torch.utils.data.Dataset):
    def __len__(self) -> int:
        return 100

    def __getitem__(self, index: int) -> int:
        time.sleep(60 if index else 0)
        return index


def test_workers_outlive_a_signal_to_the_whole_group_and_end_with_the_run():
    """As a cluster's scheduler sends it. A worker that died would end the run with an error instead."""

    def work() -> None:
        os.setpgid(0, 0)
        loader = DataLoader(Slow(), 1, num_workers=1, worker_init_fn=ignore_stop, multiprocessing_context="fork")
        inherited = set(multiprocessing.active_children())  # a fork takes over its parent's list of children
        with catch_stop() as stop:
            items = iter(loader)
            assert stop.next_item(items).tolist() == [0]
            threading.Timer(0.1, os.killpg, (os.getpgid(0), signal.SIGTERM)).start()
            assert stop.next_item(items) is None
            (worker,) = set(multiprocessing.active_children()) - inherited
            assert worker.is_alive()
            worker.kill()
        raise SystemExit(stop.exit_code)

    assert in_child(work, timeout=30) == 143


def test_processes_agree():
    def work(rank: int) -> None:
        torch.distributed.init_process_group("gloo")
        assert any_true(rank == 1)
        assert not any_true(False)
        assert gather({"rank": rank}) == [{"rank": 0}, {"rank": 1}]
        check_agreement({"parameters": "ab"})
        # Each names the other.
        with pytest.raises(TrainingError, match=f"data is {rank} here and {1 - rank} in process {1 - rank}"):
            check_agreement({"parameters": "ab", "data": rank})
        with catch_stop() as stop:
            if rank == 1:
                ask()
            assert bool(stop) == (rank == 1)
            assert any_true(bool(stop))
            assert not any_true(stop.signal is not None and rank == 0)

    assert in_processes(work) == [0, 0]


def test_a_single_process_gathers_its_own_value():
    assert any_true(True)
    assert not any_true(False)
    assert gather(3) == [3]
    check_agreement({"anything": object()})
