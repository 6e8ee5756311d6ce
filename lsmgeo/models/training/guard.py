"""Steps that must not be taken: a single gradient that is not finite poisons Adam's moments for good."""

from __future__ import annotations

from collections.abc import Sequence

from lsmgeo.errors import TrainingError

__all__ = ["StepGuard"]

# So many skipped steps are forgiven whatever share of all steps they are.
FORGIVEN = 5


class StepGuard:
    """Counts the steps that must not be taken, and ends a training that has too many of them.

    A step whose loss or gradient is not finite in any process is taken by none: neither parameters, nor the optimiser's
    moments, nor the schedule move. A scaler of mixed precision is still to be updated, or it never lowers its scale.

    Args:
        in_a_row: so many skipped steps in succession end the training; so do more than 5 that are ...
        share: ... a larger share of all steps.

    Example:
        >>> guard = StepGuard(in_a_row=2)
        >>> guard.admits(1, is_bad=False), guard.admits(2, is_bad=True, names=("chair-0",))
        (True, False)
        >>> guard.admits(3, is_bad=True, names=("lamp-7",))
        Traceback (most recent call last):
            ...
        lsmgeo.errors.TrainingError: the loss or the gradient was not finite in 2 steps in succession; the parameters \
are unharmed. Last: step 2 with chair-0; step 3 with lamp-7
    """

    def __init__(self, *, in_a_row: int = 3, share: float = 0.001) -> None:
        self.in_a_row, self.share = in_a_row, share
        self._state = {"steps": 0, "skipped": 0, "in_a_row": 0}
        self._last: list[str] = []

    def admits(self, step: int, *, is_bad: bool, names: Sequence[str] = (), scale: float | None = None) -> bool:
        """Say whether a step may be taken.

        Args:
            step: its number.
            is_bad: whether the loss or the gradient is not finite in any process; the same in all of them.
            names: of the shapes in the batch, for the message.
            scale: the scaler's, if all losses were finite in mixed precision with float16. Gradients that overflow
                under a scale above 1 are how the scaler finds its scale: the step is skipped, and not counted.

        Returns:
            Whether to take it.

        Raises:
            TrainingError: too many were skipped; the message holds the numbers and shapes of the last of them.
        """
        state = self._state
        state["steps"] += 1
        if not is_bad:
            state["in_a_row"] = 0
            return True
        if scale is not None and scale > 1:
            return False
        state["skipped"] += 1
        state["in_a_row"] += 1
        self._last = [*self._last, f"step {step} with {', '.join(names) or 'no names'}"][-self.in_a_row :]
        if state["in_a_row"] >= self.in_a_row:
            reason = f"{state['in_a_row']} steps in succession"
        elif state["skipped"] > max(FORGIVEN, self.share * state["steps"]):
            reason = f"{state['skipped']} of {state['steps']} steps"
        else:
            return False
        last = "; ".join(self._last)
        reason = f"the loss or the gradient was not finite in {reason}; the parameters are unharmed. Last: {last}"
        raise TrainingError(reason)

    def state_dict(self) -> dict[str, int]:
        """How many steps were judged, skipped, and skipped in succession."""
        return self._state.copy()

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on counting from a state.

        Args:
            state: as from `state_dict`.
        """
        self._state = {name: state[name] for name in self._state}
