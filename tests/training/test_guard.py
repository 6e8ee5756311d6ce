"""Steps that are not finite are counted, named, and end the training where they are too many (F6)."""

from __future__ import annotations

import pytest

from lsmgeo.errors import TrainingError
from lsmgeo.training.optim import StepGuard


def test_good_steps_are_taken_and_bad_ones_not():
    guard = StepGuard()
    assert [guard.check(step, is_bad=step == 3) for step in range(1, 6)] == [True, True, False, True, True]
    assert guard.state_dict() == {"steps": 5, "skipped": 1, "in_a_row": 0}


def test_three_in_a_row_end_it_and_are_named():
    guard = StepGuard(in_a_row=3)
    for step, bad in enumerate([True, True, False, True, True], 1):
        guard.check(step, is_bad=bad, names=(f"chair-{step}", "lamp-0"))
    with pytest.raises(
        TrainingError, match=r"in 3 steps in succession.* unharmed.*4 with chair-4, lamp-0.*6 with bed-6$"
    ):
        guard.check(6, is_bad=True, names=("bed-6",))


@pytest.mark.parametrize(("share", "ends_at"), [(0.001, 12), (0.0, 12), (0.49, 12), (0.5, None), (1.0, None)])
def test_a_larger_share_of_all_steps_ends_it(share, ends_at):
    """Every second step is bad: of 12, the sixth, which is the first above the 5 that are forgiven."""
    guard = StepGuard(share=share)
    ended = None
    for step in range(1, 100):
        try:
            guard.check(step, is_bad=step % 2 == 0)
        except TrainingError:
            ended = step
            break
    assert ended == ends_at


def test_rare_ones_are_forgiven_over_a_long_run():
    guard = StepGuard()
    for step in range(1, 20_001):
        guard.check(step, is_bad=step % 1001 == 0)
    assert guard.state_dict()["skipped"] == 19


def test_a_scaler_that_looks_for_its_scale_is_not_counted():
    guard = StepGuard(in_a_row=2)
    assert not any(guard.check(step, is_bad=True, scale=65536.0 / 2**step) for step in range(10))
    assert guard.state_dict()["skipped"] == 0
    guard.check(10, is_bad=True, scale=1.0)
    with pytest.raises(TrainingError, match="2 steps in succession"):
        guard.check(11, is_bad=True, scale=0.5)


def test_a_resumed_run_goes_on_counting():
    guard, resumed = StepGuard(in_a_row=2), StepGuard(in_a_row=2)
    guard.check(1, is_bad=True)
    resumed.load_state_dict(guard.state_dict())
    with pytest.raises(TrainingError):
        resumed.check(2, is_bad=True)
    # The state was copied.
    assert guard.state_dict()["steps"] == 1
