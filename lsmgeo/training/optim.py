"""A training step: gradients of the mean loss over all shapes of all processes, Adam, and the guard."""

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
    "loss_views_of",
    "make_optimiser",
    "move_parameters",
]

Steps = str | Sequence[int] | None  # as the models take them
# Steps that are timed where CPU minutes limit a run.
TIMED_STEPS = 30
# Skipped steps that are allowed, whatever their share of all steps.
FORGIVEN = 5


class Gradients(NamedTuple):
    """The result of `find_gradients`, beside the parameters' ``grad``.

    Attributes:
        loss: the mean over all shapes of all processes.
        norm: of the gradient of this mean.
        factor: ``grad`` times this factor is that gradient.
    """

    loss: float
    norm: float
    factor: float

    @property
    def is_finite(self) -> bool:
        """Whether loss and norm are finite; the same in all processes."""
        return math.isfinite(self.loss) and math.isfinite(self.norm)


class StepGuard:
    """Counts the steps that must be skipped, and ends a training that has too many of them.

    One gradient that is not finite corrupts Adam's moments permanently. A step whose loss or gradient is not finite in
    any process is skipped by all: parameters, the optimiser's moments and the schedule stay. The scaler of mixed
    precision must still be updated, or it never lowers its scale.

    Args:
        in_a_row: this many skipped steps in a row end the training.
        share: more than 5 skipped steps that are also more than this share of all steps end it too.

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
        """Whether a step may be taken.

        Args:
            step: its number.
            is_bad: whether the loss or the gradient is not finite in any process; the same in all of them.
            names: of the shapes in the batch, for the message.
            scale: the scaler's, if all losses were finite in mixed precision with float16. Gradients that overflow
                under a scale above 1 are how the scaler finds its scale: the step is skipped, and not counted.

        Raises:
            TrainingError: too many were skipped; the message has the numbers and shapes of the last of them.
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
        """Numbers of steps checked, skipped, and skipped in a row."""
        return self._state.copy()

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue to count from a `state_dict`."""
        self._state = {name: state[name] for name in self._state}


def make_optimiser(model: nn.Module, config: OptimiserConfig) -> torch.optim.Optimizer:
    """Adam, or AdamW with weight decay."""
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

    Numbers of views differ between shapes, and with them the numbers of terms of processes and batches. So sums are
    differentiated, and finally divided by the number of all terms: shapes weigh the same in every batch and process.

    Args:
        wrapped: the model, as the accelerator prepared it; its gradients are None.
        batches: of this process.
        optimiser: of its parameters.
        accelerator: of the run.
        run: the settings of the loss.
        steps: after which views the loss is taken, see `loss_views_of`.
        terms: about how many terms a batch has; sums are divided by it to give gradients of usual size.
    """
    sums = torch.zeros(2, device=accelerator.device)
    for index, batch in enumerate(batches):
        is_last = index == len(batches) - 1
        with contextlib.nullcontext() if is_last else accelerator.no_sync(wrapped):
            if isinstance(steps, list):
                # Later views change no loss of voxels; of depth, only the views so far count.
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
    # The processes' gradients were averaged, and must be summed.
    factor = terms * accelerator.num_processes / max(number, 1.0)
    gradients = [parameter.grad for parameter in wrapped.parameters() if parameter.grad is not None]
    return Gradients(of_all / max(number, 1.0), factor * float(torch.nn.utils.get_total_norm(gradients)), factor)


def move_parameters(
    optimiser: torch.optim.Optimizer, accelerator: Accelerator, found: Gradients, *, rate: float, clip: float | None
) -> None:
    """Take a step along finite gradients, clipped to the norm `clip`; the caller updates the scaler."""
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
        steps: of the run; None where that is not known yet, in the first `hold` steps.
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


def loss_views_of(run: RunConfig, step: int, views: int) -> Steps:
    """After which of at most `views` views the loss of a step is taken: the same in all processes."""
    if run.loss_views == "every":
        return None
    if run.loss_views == "last":
        return "last"
    # A function of the seed and the step, so that no state of a generator is saved.
    state = np.random.SeedSequence([2, run.seed, step, 0x76696577]).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
    return [int(torch.randint(views, (1,), generator=generator))]
