"""One step of training: gradients of the mean loss over all shapes of all processes, Adam, and steps not to take."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import distributed, nn

from lsmgeo._torch_compat import multiply_all
from lsmgeo.data import Batch
from lsmgeo.errors import TrainingError
from lsmgeo.models.losses import sum_loss
from lsmgeo.training.config import OptimiserConfig, RunConfig

if TYPE_CHECKING:
    from accelerate import Accelerator

__all__ = [
    "TIMED_STEPS",
    "Gradients",
    "StepGuard",
    "find_gradients",
    "learning_rate",
    "loss_steps",
    "make_optimiser",
    "move_parameters",
]

Steps = str | Sequence[int] | None
# How many are timed where CPU minutes say when a run ends.
TIMED_STEPS = 30
# So many skipped steps are forgiven whatever share of all steps they are.
FORGIVEN = 5


class Gradients(NamedTuple):
    """What `find_gradients` leaves in the parameters' ``grad``, and of what.

    Attributes:
        loss: the mean over all shapes of all processes.
        norm: of the gradient of this mean.
        factor: what ``grad`` is still to be multiplied by to be this gradient.
    """

    loss: float
    norm: float
    factor: float

    @property
    def is_finite(self) -> bool:
        """Whether the parameters may follow it; the same in all processes, as loss and norm are."""
        return math.isfinite(self.loss) and math.isfinite(self.norm)


class StepGuard:
    """Counts the steps that must not be taken, and ends a training that has too many of them.

    A single gradient that is not finite poisons Adam's moments for good. A step whose loss or gradient is not finite in
    any process is taken by none: neither parameters, nor the optimiser's moments, nor the schedule move. A scaler of
    mixed precision is still to be updated, or it never lowers its scale.

    Args:
        in_a_row: so many skipped steps in succession end the training; so do more than 5 that are ...
        share: ... a larger share of all steps.

    Example:
        >>> guard = StepGuard(in_a_row=2)
        >>> guard.check(1, is_bad=False), guard.check(2, is_bad=True, names=("chair-0",))
        (True, False)
        >>> guard.check(3, is_bad=True, names=("lamp-7",))
        Traceback (most recent call last):
            ...
        lsmgeo.errors.TrainingError: the loss or the gradient was not finite in 2 steps in succession; the parameters \
are unharmed. Last: step 2 with chair-0; step 3 with lamp-7
    """

    def __init__(self, *, in_a_row: int = 3, share: float = 0.001) -> None:
        self.in_a_row, self.share = in_a_row, share
        self._state = {"steps": 0, "skipped": 0, "in_a_row": 0}
        self._last: list[str] = []

    def check(self, step: int, *, is_bad: bool, names: Sequence[str] = (), scale: float | None = None) -> bool:
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


def make_optimiser(model: nn.Module, config: OptimiserConfig) -> torch.optim.Optimizer:
    """Adam, or AdamW where weights decay."""
    kind = torch.optim.AdamW if config.weight_decay else torch.optim.Adam
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return kind(parameters, lr=config.learning_rate, betas=config.betas, weight_decay=config.weight_decay, fused=True)


def find_gradients(
    wrapped: nn.Module,
    batches: Sequence[Batch],
    optimiser: torch.optim.Optimizer,
    accelerator: Accelerator,
    run: RunConfig,
    *,
    steps: Steps,
    terms: float,
) -> Gradients:
    """The loss of some batches in every process, and its gradient in the parameters' ``grad``.

    Processes and batches may hold differently many terms of the loss, since shapes have differently many views. So sums
    are differentiated, and divided by the number of all terms in the end: shapes weigh the same wherever they are.

    Args:
        wrapped: the model, as the accelerator prepared it; its gradients are None.
        batches: of this process, one after the other.
        optimiser: of its parameters.
        accelerator: of the run.
        run: says which loss.
        steps: after which views the loss is taken, see `loss_steps`.
        terms: about how many terms a batch has: sums are divided by it, so that gradients are of an ordinary size.
    """
    sums = torch.zeros(2, device=accelerator.device)
    for index, batch in enumerate(batches):
        is_last = index == len(batches) - 1
        with contextlib.nullcontext() if is_last else accelerator.no_sync(wrapped):
            if isinstance(steps, list):
                # What is read later reaches no loss of voxels; of depth, that of the views so far counts.
                batch = batch.first_views(max(steps) + 1)
            output = wrapped(batch.images, batch.cameras, batch.view_mask, steps=steps)
            part, number = sum_loss(output, batch, region=run.region, loss=run.loss, steps=steps)
            accelerator.backward(part / terms)
        sums += torch.stack((part.detach(), number))
    if accelerator.num_processes > 1:
        distributed.all_reduce(sums)
    if accelerator.scaler is not None:
        accelerator.scaler.unscale_(optimiser)
    of_all, number = sums.tolist()
    # The processes' gradients were averaged, and are to be added.
    factor = terms * accelerator.num_processes / max(number, 1.0)
    gradients = [parameter.grad for parameter in wrapped.parameters() if parameter.grad is not None]
    return Gradients(of_all / max(number, 1.0), factor * float(torch.nn.utils.get_total_norm(gradients)), factor)


def move_parameters(
    optimiser: torch.optim.Optimizer, accelerator: Accelerator, found: Gradients, *, rate: float, clip: float | None
) -> None:
    """Take a step.

    Args:
        optimiser: its parameters hold what `find_gradients` found.
        accelerator: of the run; its scaler, if there is one, is updated by the caller.
        found: their loss and norm, finite.
        rate: the learning rate.
        clip: the largest norm; None for no such limit.
    """
    factor = found.factor * (1.0 if clip is None or found.norm <= clip else clip / found.norm)
    groups = optimiser.param_groups
    gradients = [parameter.grad for group in groups for parameter in group["params"] if parameter.grad is not None]
    multiply_all(gradients, factor)
    for group in groups:
        group["lr"] = rate
    if accelerator.scaler is None:
        optimiser.step()
    else:
        accelerator.scaler.step(optimiser)


def learning_rate(config: OptimiserConfig, taken: int, steps: int | None, *, hold: int = 0) -> float:
    """The learning rate of a step.

    Equation: with t = steps taken before, w = warm_up, n = steps and h = hold: ``min(1, (t + 1) / w)`` times the
    configured rate, and with a cosine times ``(1 + cos(pi max(0, t - h) / (n - h))) / 2``.

    Args:
        config: of the optimiser.
        taken: how many steps moved the parameters before; skipped ones do not count.
        steps: where the run ends; None where that is not known yet, in the first `hold` steps.
        hold: steps before a cosine begins.

    Example:
        >>> config = OptimiserConfig(learning_rate=1.0, schedule="cosine", warm_up=4)
        >>> [learning_rate(config, taken, 100) for taken in (0, 50)]
        [0.25, 0.5]
    """
    rate = config.learning_rate
    if config.warm_up:
        rate *= min(1.0, (taken + 1) / config.warm_up)
    if config.schedule == "cosine" and steps is not None:
        rate *= 0.5 * (1 + math.cos(math.pi * min(1.0, max(0, taken - hold) / max(1, steps - hold))))
    return rate


def loss_steps(run: RunConfig, step: int, views: int) -> Steps:
    """After which views the loss of a step is taken, as the models take it: the same in all processes.

    Args:
        run: of the run.
        step: which.
        views: the most that a shape has.
    """
    if run.loss_views == "every":
        return None
    if run.loss_views == "last":
        return "last"
    # From the seed and the step alone, so that no state of a generator need be saved.
    state = np.random.SeedSequence([2, run.seed, step, 0x76696577]).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
    return [int(torch.randint(views, (1,), generator=generator))]
