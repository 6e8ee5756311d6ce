"""The training loop; `run_state` holds what it saves, restores, measures and plans."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from lsmgeo.data import Batch
from lsmgeo.errors import TrainingError
from lsmgeo.models.weights import checkpoint_folders
from lsmgeo.training.checkpoints import load_latest
from lsmgeo.training.config import TrainingConfig
from lsmgeo.training.launch import any_true, catch_stop, gather, hold_folder, resolve_config, start_accelerator
from lsmgeo.training.optim import (
    TIMED_STEPS,
    Gradients,
    find_gradients,
    learning_rate,
    loss_views_of,
    move_parameters,
)
from lsmgeo.training.run_state import Run
from lsmgeo.training.validation import Evaluation

__all__ = ["Trained", "train"]


@dataclass(frozen=True)
class Trained:
    """A finished run.

    Attributes:
        folder: of the run.
        step: how many steps it has taken.
        checkpoint: of this step.
        best: the step of the best evaluation, None where there was none.
        evaluation: the last since the run began or was resumed, if any.
        ended: "steps", "minutes", or "stop" after a signal.
        is_first: whether this is the first process of the run.
        exit_code: for the process: 0, or 128 plus the signal's number.
    """

    folder: Path
    step: int
    checkpoint: Path
    best: int | None
    evaluation: Evaluation | None
    ended: str
    is_first: bool = True
    exit_code: int = 0


def train(config: TrainingConfig, out: str | os.PathLike[str], *, quiet: bool = False) -> Trained:
    """Train a model, or resume a run that stopped.

    The folder then holds ``config.json``, ``log.jsonl``, ``tensorboard``, ``pictures`` and ``checkpoints``. A run that
    is resumed, after a signal or a kill, ends with the same weights, bit by bit on a CPU, as one that never stopped.
    With `torchrun`, every process calls this; gradients equal those of one process with all shapes.

    Args:
        config: of the run.
        out: the run's folder; where it holds checkpoints, the run is resumed.
        quiet: whether to show no progress.

    Returns:
        `Trained`.

    Raises:
        OptionError, DataError: settings or data that cannot be used.
        CheckpointError: the folder is another run's, its checkpoints cannot be used, or the last one cannot be written.
        TrainingError: losses or gradients were repeatedly not finite; processes start from different states; or another
            process trains in the folder.
    """
    folder = Path(out)
    found = list(checkpoint_folders(folder))
    checkpoint = load_latest(folder)
    config = resolve_config(config, checkpoint)
    # One layer of the release never gets a gradient, and convolutions of the state get none from a single view.
    has_idle_parameters = (
        config.model.variant == "release" or config.data.view_range[0] == 1 or config.run.loss_views == "random"
    )
    with (
        start_accelerator(config.run, has_idle_parameters=has_idle_parameters) as accelerator,
        catch_stop() as stop,
    ):
        run = Run(config, folder, checkpoint, accelerator, stop)
        is_first = run.rank == 0
        # Nothing is written until data, weights and checkpoint fit. The readers are always closed: they ignore the
        # signals with which Python ends its children.
        with (
            hold_folder(folder) if is_first else contextlib.nullcontext(),
            contextlib.closing(run.open_log(quiet=quiet)),
            contextlib.closing(run.batches()) as batches,
        ):
            if is_first and list(checkpoint_folders(folder)) != found:
                raise TrainingError(f"another process has trained in {folder} while this one started")
            run.write_config()
            run.log_start()
            ended = _take_steps(run, batches)
        assert run.saved is not None
        return Trained(
            folder, run.progress.step, run.saved, run.progress.best, run.evaluation, ended, is_first, stop.exit_code
        )


def _take_steps(run: Run, batches: Iterator[Batch]) -> str:
    """Evaluate, plan, save and take a step until the run ends; returns why it ended."""
    progress, optimiser, accelerator, log, stop = run.progress, run.optimiser, run.accelerator, run.log, run.stop
    rates = run.config.optimiser
    settings, ended = run.config.run, ""
    while True:
        if settings.steps is not None and progress.step >= settings.steps:
            ended = ended or "steps"

        is_due = ended or progress.step % settings.evaluate_every == 0
        if is_due and ended != "stop" and progress.step > progress.evaluated and not run.evaluate():
            ended = "stop"

        is_unplanned = settings.cpu_minutes is not None and settings.steps is None
        plans = is_unplanned and progress.step >= TIMED_STEPS and not ended
        if plans:
            ended = "" if run.plan() else "stop"
            settings = run.config.run  # with its number of steps

        is_due = ended or plans or progress.step % settings.checkpoint_every == 0 or progress.step == progress.best
        if is_due and not run.is_saved:
            # The first checkpoint shows early that the folder can be written. A plan that is not saved would be made
            # again, differently, by a resumed run.
            run.save(must=bool(ended) or plans or progress.step == 0)
        if plans:
            run.write_config()
        if ended:
            seconds, cpu_seconds = round(progress.seconds, 1), round(run.cpu_seconds(), 1)
            log.event("stop", step=progress.step, reason=ended, seconds=seconds, cpu_seconds=cpu_seconds)
            return ended

        begun, cpu_begun = run.seconds(), run.cpu_seconds()
        # None as soon as a stop is requested.
        taken = [batch for _ in range(settings.accumulation) if (batch := stop.next_item(batches)) is not None]
        waited = run.seconds() - begun
        if any_true(len(taken) < settings.accumulation or bool(stop)):
            ended = "stop"
            continue
        if settings.minutes is not None and any_true(begun > 60 * settings.minutes):
            ended = "minutes"
            continue

        after = loss_views_of(settings, progress.step, run.most_views)
        gradients = find_gradients(run.wrapped, taken, optimiser, accelerator, settings, steps=after, terms=run.terms)
        progress.step += 1
        run.is_saved = False
        hold = TIMED_STEPS if settings.cpu_minutes is not None else 0
        rate = learning_rate(rates, progress.moved, settings.steps, hold=hold)
        if gradients.is_finite:
            run.guard.check(progress.step, is_bad=False)
            move_parameters(optimiser, accelerator, gradients, rate=rate, clip=rates.clip_norm)
            progress.moved += 1
        else:
            _skip_step(run, gradients, taken)
        if accelerator.scaler is not None:
            accelerator.scaler.update()
        optimiser.zero_grad()

        seconds = run.seconds() - begun
        if settings.cpu_minutes is not None and settings.steps is None:
            views = after[0] + 1 if isinstance(after, list) else run.most_views
            progress.timed.append([float(views), run.cpu_seconds() - cpu_begun])
        if progress.step % settings.log_every == 0:
            log.step(
                progress.step,
                epoch=progress.step * run.shapes_per_step / len(run.shapes),
                loss=gradients.loss,
                gradient_norm=gradients.norm,
                learning_rate=rate,
                seconds=seconds,
                waited=waited,
            )
        if progress.step == 1:
            log.say(f"step 1: loss {gradients.loss:.4f}")
        log.progress(progress.step, f"loss {gradients.loss:.4f}, {seconds:.2f} s per step")


def _skip_step(run: Run, gradients: Gradients, taken: Sequence[Batch]) -> None:
    """Log a step whose loss or gradient is not finite; a TrainingError after too many of them."""
    step, scaler = run.progress.step, run.accelerator.scaler
    names = [name for part in gather([name for batch in taken for name in batch.name]) for name in part]
    run.log.event("skipped", step=step, loss=gradients.loss, gradient_norm=gradients.norm, shapes=names)
    run.log.say(f"step {step}: the loss or the gradient is not finite; skipped")
    scale = scaler.get_scale() if scaler is not None and isfinite(gradients.loss) else None
    try:
        run.guard.check(step, is_bad=True, names=names, scale=scale)
    except TrainingError:
        run.save(must=False)
        run.log.event("stop", step=step, reason="not finite")
        raise
