"""The training loop, from top to bottom."""

from __future__ import annotations

import contextlib
import json
import os
import time
import warnings
from dataclasses import asdict, dataclass, field, replace
from math import ceil, isfinite
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from lsmgeo.data import write_atomic
from lsmgeo.errors import CheckpointError, TrainingError
from lsmgeo.models.creating import settings_of
from lsmgeo.models.weights import CHECKPOINTS, checkpoint_folders, checksum, fill_model, step_folder, tensors_of
from lsmgeo.training.batches import Need, open_shapes, training_batches, validation_batches
from lsmgeo.training.checkpoints import Checkpoint, check_config, load_latest, save_checkpoint
from lsmgeo.training.config import TrainingConfig
from lsmgeo.training.launch import (
    StopRequest,
    any_true,
    catch_stop,
    check_agreement,
    decided,
    gather,
    hold_folder,
    make_model,
    started,
)
from lsmgeo.training.logs import RunLog
from lsmgeo.training.optim import (
    TIMED_STEPS,
    StepGuard,
    find_gradients,
    learning_rate,
    loss_steps,
    make_optimiser,
    move_parameters,
)
from lsmgeo.training.validation import Evaluation, evaluate_model

if TYPE_CHECKING:
    from accelerate import Accelerator

__all__ = ["Trained", "train"]

CONFIG = "config.json"
# Of the steps that are timed, the first are slower than the others will be.
SLOW_STEPS = 5


@dataclass(frozen=True)
class Trained:
    """A run that has ended.

    Attributes:
        folder: the run's.
        step: how many steps it has taken.
        checkpoint: of this step.
        best: the step of the best evaluation, None where there was none.
        evaluation: the last one; None where none was made since the run began or was resumed.
        ended: "steps", "minutes" or "stop", which is after a signal.
        is_first: whether this is the first process of the run.
        exit_code: what the process should end with: 0, or 128 plus the signal's number.
    """

    folder: Path
    step: int
    checkpoint: Path
    best: int | None
    evaluation: Evaluation | None
    ended: str
    is_first: bool = True
    exit_code: int = 0


@dataclass
class Place:
    """Where a run is, the same in all processes."""

    step: int = 0  # batches that were taken, also those whose gradient was not finite
    moved: int = 0  # steps that moved the parameters
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    evaluated: int = 0  # the step of the last evaluation
    best: int | None = None
    best_value: float | None = None
    measured: dict[str, Any] | None = None  # what the last evaluation found
    timed: list[list[float]] = field(default_factory=list)  # views and CPU seconds of the steps before there is a plan


def train(config: TrainingConfig, out: str | os.PathLike[str], *, quiet: bool = False) -> Trained:
    """Train a model, or go on where a run stopped.

    The folder holds afterwards ``config.json``, ``log.jsonl``, ``tensorboard``, ``pictures`` and ``checkpoints``. A run
    that is resumed, after a signal or after a kill, ends with the same weights, bit by bit on a CPU, as one that never
    stopped. With `torchrun`, every process calls this; gradients are as if one process had taken all shapes.

    Args:
        config: of the run.
        out: the run's folder; where it holds checkpoints, the run is resumed.
        quiet: whether to show no progress.

    Returns:
        `Trained`.

    Raises:
        OptionError, DataError: settings or data that cannot be used.
        CheckpointError: the folder is another run's, or its checkpoints cannot be used, or the last one not be written.
        TrainingError: losses or gradients were not finite, again and again; processes do not start from the same; or
            another process trains in the folder.
    """
    folder = Path(out)
    seen = list(checkpoint_folders(folder))
    checkpoint = load_latest(folder)
    config = decided(config, checkpoint)
    # One layer of the release never gets a gradient, and what convolves the state gets none from a single view.
    has_idle_parameters = (
        config.model.variant == "release" or config.data.view_range[0] == 1 or config.run.loss_views == "random"
    )
    with (
        started(config.run, has_idle_parameters=has_idle_parameters) as accelerator,
        catch_stop() as stop,
    ):
        return _train(config, folder, checkpoint, seen, accelerator, stop, quiet=quiet)


def _train(
    config: TrainingConfig,
    folder: Path,
    checkpoint: Checkpoint | None,
    seen: list[int],
    accelerator: Accelerator,
    stop: StopRequest,
    *,
    quiet: bool,
) -> Trained:
    run, data = config.run, config.data
    device, rank, processes = accelerator.device, accelerator.process_index, accelerator.num_processes

    # A run that goes on has its weights.
    beginning = config.model if checkpoint is None else replace(config.model, weights=None)
    model = make_model(beginning, run, device)
    need = Need(model.image_size, model.resolution if model.output == "voxels" else None, model.output == "depth")
    most = data.view_range[1]
    shapes = open_shapes(data, need, seed=run.seed, device=device, is_training=True, folder=folder)
    held_back = open_shapes(
        data, need, seed=run.seed, device=device, is_training=False, views=run.evaluate_views or most
    )
    optimiser = make_optimiser(model, config.optimiser)
    guard = StepGuard(in_a_row=run.max_bad_steps, share=run.max_bad_fraction)
    place = Place()

    def identity() -> dict[str, Any]:
        return {**config.to_dict(), "processes": processes, "shapes": shapes.identity}

    if checkpoint is not None:
        was_planned = checkpoint.config["run"]["steps"] is not None
        check_config(checkpoint, identity(), free=config.free() + (() if was_planned else ("run.steps",)))
        fill_model(model, checkpoint.weights)
        checkpoint.restore("optimiser", optimiser)
        checkpoint.restore("guard", guard)
        if accelerator.scaler is not None:
            checkpoint.restore("scaler", accelerator.scaler)
        place = Place(**checkpoint.part("place"))
        before = checkpoint.config["run"]
        if any(before[key] != getattr(run, key) for key in ("evaluate_shapes", "evaluate_views")):
            # What was measured on other shapes or views is no measure of what comes.
            place.best = place.best_value = None
    parameters = checksum({}, tensors_of(model))[:16]
    check_agreement({"the configuration": identity(), "the step": place.step, "the parameters": parameters})

    wrapped = accelerator.prepare_model(model)
    taken_a_step = run.batch * run.accumulation * processes
    loading: dict[str, Any] = {"seed": run.seed, "batch": run.batch, "device": device}
    loading |= {"rank": rank, "processes": processes}
    batches = training_batches(shapes, start=place.step * taken_a_step, workers=data.workers, **loading)
    # About how many terms the loss of a batch has.
    terms = run.batch * (need.voxels**3 if need.voxels else most * need.image_size**2)
    saved = None if checkpoint is None else checkpoint.path
    saved_step = None if checkpoint is None else checkpoint.step
    weights = sum(parameter.numel() for parameter in model.parameters())
    evaluation: Evaluation | None = None
    ended = ""
    begin, cpu_begin = time.monotonic() - place.seconds, time.process_time() - place.cpu_seconds

    def write_config() -> None:
        write_atomic(folder / CONFIG, json.dumps(config.to_dict(), indent=1).encode())

    def save(*, must: bool) -> None:
        nonlocal saved, saved_step
        place.seconds, place.cpu_seconds = time.monotonic() - begin, time.process_time() - cpu_begin
        state = {
            "optimiser": optimiser.state_dict(),
            "guard": guard.state_dict(),
            "scaler": None if accelerator.scaler is None else accelerator.scaler.state_dict(),
            "place": asdict(place),
        }
        reason = None
        if rank == 0:
            try:
                path = save_checkpoint(
                    folder / CHECKPOINTS,
                    place.step,
                    model=model,
                    state=state,
                    config=identity(),
                    about={} if place.measured is None else {"validation": place.measured},
                    keep=run.keep,
                    best=place.best,
                )
                log.event("checkpoint", step=place.step, path=path.name)
            except CheckpointError as error:
                reason = str(error)
                log.event("checkpoint_failed", step=place.step, reason=reason)
        # The others wait here until it stands, and hear whether it does.
        reason = gather(reason)[0]
        if reason is None:
            saved, saved_step = folder / CHECKPOINTS / step_folder(place.step), place.step
        elif must:
            raise CheckpointError(folder / CHECKPOINTS, reason)
        else:
            warnings.warn(f"{reason}; the run goes on without this checkpoint", stacklevel=3)

    def measure(shapes: int, pictures: int) -> Evaluation | None:
        workers = min(1, data.workers)
        with contextlib.closing(validation_batches(held_back, count=shapes, workers=workers, **loading)) as some:
            return evaluate_model(model, some, stop, region=run.region, loss=run.loss, pictures=pictures)

    def planned() -> int | None:
        """The number of steps that fill the CPU minutes, by the time of a step and of an evaluation; None at a stop."""
        assert run.cpu_minutes is not None
        by_views: dict[float, list[float]] = {}
        for views, seconds in place.timed[SLOW_STEPS:] or place.timed:
            by_views.setdefault(views, []).append(seconds)
        # Numbers of views are drawn evenly, but so few draws are not even.
        step_seconds = mean(mean(seconds) for seconds in by_views.values())
        for _ in range(2):  # the first batch is slower than the others
            begun = time.process_time()
            if measure(run.batch * processes, 0) is None:
                return None
        batches_of_all = ceil(min(run.evaluate_shapes, len(held_back)) / (run.batch * processes))
        evaluation_seconds = (time.process_time() - begun) * batches_of_all
        left = 60 * run.cpu_minutes - (time.process_time() - cpu_begin) - evaluation_seconds
        more = int(left / (step_seconds + evaluation_seconds / run.evaluate_every))
        return gather(place.step + max(1, more))[0]

    # Nothing is written before all is found to fit. The readers are closed whatever happens: they are deaf to the
    # signals with which Python ends its children.
    with (
        hold_folder(folder) if rank == 0 else contextlib.nullcontext(),
        contextlib.closing(RunLog(folder, run, step=place.step, is_writer=rank == 0, quiet=quiet)) as log,
        contextlib.closing(batches),
    ):
        if rank == 0:
            if list(checkpoint_folders(folder)) != seen:
                raise TrainingError(f"another process has trained in {folder} while this one started")
            write_config()
        log.event(
            "start" if checkpoint is None else "resume",
            step=place.step,
            model=settings_of(model),
            parameters=weights,
            shapes=len(shapes),
            held_back=min(run.evaluate_shapes, len(held_back)),
            processes=processes,
            device=str(device),
        )
        log.say(
            f"{model.name}, {weights:,} parameters, on {device}"
            f"{f', {processes} processes' if processes > 1 else ''}: {len(shapes)} shapes, {taken_a_step} a step; "
            f"evaluated on {min(run.evaluate_shapes, len(held_back))}"
            f"{'' if checkpoint is None else f'; goes on at step {place.step} of {checkpoint.path}'}"
        )
        while True:
            if not ended and run.steps is not None and place.step >= run.steps:
                ended = "steps"

            if place.step > place.evaluated and ended != "stop" and (ended or place.step % run.evaluate_every == 0):
                begun = time.monotonic()
                found = measure(run.evaluate_shapes, run.pictures if rank == 0 else 0)
                if found is None:
                    ended = "stop"
                else:
                    evaluation, place.evaluated = found, place.step
                    place.measured = {
                        "step": place.step,
                        "measure": found.measure,
                        "by_view": [value if isfinite(value) else None for value in found.by_view.values()],
                    }
                    # Whatever was saved of this step does not know of it.
                    saved_step = None
                    if found.is_better_than(place.best_value):
                        place.best, place.best_value = place.step, found.value
                    log.evaluation(place.step, found, seconds=time.monotonic() - begun, best=place.best)

            plans = run.cpu_minutes is not None and run.steps is None and place.step >= TIMED_STEPS and not ended
            if plans:
                steps = planned()
                if steps is None:
                    ended = "stop"
                else:
                    run = replace(run, steps=steps)
                    config = replace(config, run=run)
                    place.timed.clear()
                    log.plan(steps)
                    saved_step = None  # whatever was saved of this step does not know of it
            is_due = ended or plans or place.step % run.checkpoint_every == 0 or place.step == place.best
            if is_due and place.step != saved_step:
                # The first tells before the work whether the folder can be written. Without a plan that is saved a run
                # that goes on would make another.
                save(must=bool(ended) or plans or place.step == 0)
            if plans and rank == 0:
                write_config()
            if ended:
                break

            begun, cpu_begun = time.monotonic(), time.process_time()
            # None as soon as a stop is asked for.
            taken = [batch for _ in range(run.accumulation) if (batch := stop.next_item(batches)) is not None]
            waited = time.monotonic() - begun
            if any_true(len(taken) < run.accumulation or bool(stop)):
                ended = "stop"
                continue
            if run.minutes is not None and any_true(begun - begin > 60 * run.minutes):
                ended = "minutes"
                continue

            after = loss_steps(run, place.step, most)
            gradients = find_gradients(wrapped, taken, optimiser, accelerator, run, steps=after, terms=terms)
            place.step += 1
            hold = TIMED_STEPS if run.cpu_minutes is not None else 0
            rate = learning_rate(config.optimiser, place.moved, run.steps, hold=hold)
            if gradients.is_finite:
                guard.admits(place.step, is_bad=False)
                move_parameters(optimiser, accelerator, gradients, rate=rate, clip=config.optimiser.clip_norm)
                place.moved += 1
            else:
                names = [name for part in gather([name for batch in taken for name in batch.name]) for name in part]
                numbers = {"loss": gradients.loss, "gradient_norm": gradients.norm}
                log.event("skipped", step=place.step, **numbers, shapes=names)
                log.say(f"step {place.step}: the loss or the gradient is not finite; skipped")
                is_scaled = accelerator.scaler is not None and isfinite(gradients.loss)
                scale = accelerator.scaler.get_scale() if is_scaled else None
                try:
                    guard.admits(place.step, is_bad=True, names=names, scale=scale)
                except TrainingError:
                    save(must=False)
                    log.event("stop", step=place.step, reason="not finite")
                    raise
            if accelerator.scaler is not None:
                accelerator.scaler.update()
            optimiser.zero_grad()

            seconds = time.monotonic() - begun
            if run.cpu_minutes is not None and run.steps is None:
                views = after[0] + 1 if isinstance(after, list) else most
                place.timed.append([float(views), time.process_time() - cpu_begun])
            if place.step % run.log_every == 0:
                log.step(
                    place.step,
                    epoch=place.step * taken_a_step / len(shapes),
                    loss=gradients.loss,
                    gradient_norm=gradients.norm,
                    learning_rate=rate,
                    seconds=seconds,
                    waited=waited,
                )
            if place.step == 1:
                log.say(f"step 1: loss {gradients.loss:.4f}")
            log.progress(place.step, f"loss {gradients.loss:.4f}, {seconds:.2f} s a step")
        log.event(
            "stop",
            step=place.step,
            reason=ended,
            seconds=round(place.seconds, 1),
            cpu_seconds=round(time.process_time() - cpu_begin, 1),
        )
    assert saved is not None
    return Trained(folder, place.step, saved, place.best, evaluation, ended, rank == 0, stop.exit_code)
