"""The state of a run: set up before the first step or restored from a checkpoint, then measured, planned and saved."""

from __future__ import annotations

import contextlib
import json
import time
import warnings
from collections.abc import Generator
from dataclasses import asdict, dataclass, field, replace
from math import ceil, isfinite
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from lsmgeo.data import Batch, write_atomic
from lsmgeo.errors import CheckpointError
from lsmgeo.models.creating import settings_of
from lsmgeo.models.weights import CHECKPOINTS, checksum, fill_model, step_folder, tensors_of
from lsmgeo.training.batches import Need, open_shapes, training_batches, validation_batches
from lsmgeo.training.checkpoints import Checkpoint, check_config, save_checkpoint
from lsmgeo.training.config import TrainingConfig
from lsmgeo.training.launch import StopRequest, check_agreement, gather, make_model
from lsmgeo.training.logs import RunLog
from lsmgeo.training.optim import StepGuard, make_optimiser
from lsmgeo.training.validation import Evaluation, evaluate_model

if TYPE_CHECKING:
    from accelerate import Accelerator

__all__ = ["Progress", "Run"]

CONFIG = "config.json"
# The first of the timed steps are slower than later ones.
SLOW_STEPS = 5


@dataclass
class Progress:
    """The progress of a run, the same in all processes; checkpoints keep it as "place"."""

    step: int = 0  # steps taken, including those whose gradient was not finite
    moved: int = 0  # steps that moved the parameters
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    evaluated: int = 0  # the step of the last evaluation
    best: int | None = None
    best_value: float | None = None
    measured: dict[str, Any] | None = None  # by the last evaluation
    timed: list[list[float]] = field(default_factory=list)  # views and CPU seconds of the steps before the plan


class Run:
    """One process of a run. Construction opens data and weights and restores the checkpoint; it writes nothing."""

    log: RunLog  # from `open_log` on

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        checkpoint: Checkpoint | None,
        accelerator: Accelerator,
        stop: StopRequest,
    ) -> None:
        settings, data, device = config.run, config.data, accelerator.device
        self.config, self.folder, self.checkpoint = config, folder, checkpoint
        self.accelerator, self.stop = accelerator, stop
        self.rank, self.processes = accelerator.process_index, accelerator.num_processes
        # A resumed run has its own weights.
        self.model = make_model(
            config.model if checkpoint is None else replace(config.model, weights=None), settings, device
        )
        voxels = self.model.resolution if self.model.output == "voxels" else None
        need = Need(self.model.image_size, voxels, self.model.output == "depth")
        self.most_views = data.view_range[1]
        self.shapes = open_shapes(data, need, seed=settings.seed, device=device, is_training=True, folder=folder)
        views = settings.evaluate_views or self.most_views
        self.held_back = open_shapes(data, need, seed=settings.seed, device=device, is_training=False, views=views)
        # About how many terms the loss of a batch has.
        self.terms = settings.batch * (voxels**3 if voxels else self.most_views * need.image_size**2)
        self.optimiser = make_optimiser(self.model, config.optimiser)
        self.guard = StepGuard(in_a_row=settings.max_bad_steps, share=settings.max_bad_fraction)
        self.progress = Progress()
        self.evaluation: Evaluation | None = None
        self.saved: Path | None = None
        self.is_saved = False  # whether the checkpoint of this step holds everything
        if checkpoint is not None:
            self._restore(checkpoint)
        parameters = checksum({}, tensors_of(self.model))[:16]
        check_agreement(
            {"the configuration": self.identity, "the step": self.progress.step, "the parameters": parameters}
        )
        self.wrapped = accelerator.prepare_model(self.model)
        self._loading = {"seed": settings.seed, "batch": settings.batch, "device": device}
        self._loading |= {"rank": self.rank, "processes": self.processes}
        self._begin = time.monotonic() - self.progress.seconds
        self._cpu_begin = time.process_time() - self.progress.cpu_seconds

    def _restore(self, checkpoint: Checkpoint) -> None:
        settings, before = self.config.run, checkpoint.config["run"]
        free = self.config.free() + (() if before["steps"] is not None else ("run.steps",))
        check_config(checkpoint, self.identity, free=free)
        fill_model(self.model, checkpoint.weights)
        checkpoint.restore("optimiser", self.optimiser)
        checkpoint.restore("guard", self.guard)
        if self.accelerator.scaler is not None:
            checkpoint.restore("scaler", self.accelerator.scaler)
        self.progress = Progress(**checkpoint.part("place"))
        if any(before[key] != getattr(settings, key) for key in ("evaluate_shapes", "evaluate_views")):
            # Measures on other shapes or views are not comparable.
            self.progress.best = self.progress.best_value = None
        self.saved, self.is_saved = checkpoint.path, True

    @property
    def identity(self) -> dict[str, Any]:
        """Settings and data that must be the same in all processes and when a run is resumed."""
        return {**self.config.to_dict(), "processes": self.processes, "shapes": self.shapes.identity}

    @property
    def shapes_per_step(self) -> int:
        """The number of shapes per step, over all processes."""
        return self.config.run.batch * self.config.run.accumulation * self.processes

    @property
    def evaluated_shapes(self) -> int:
        """The number of shapes per evaluation."""
        return min(self.config.run.evaluate_shapes, len(self.held_back))

    def seconds(self) -> float:
        """Seconds of the run so far, over all resumes."""
        return time.monotonic() - self._begin

    def cpu_seconds(self) -> float:
        """CPU seconds of the run so far, over all resumes."""
        return time.process_time() - self._cpu_begin

    def batches(self) -> Generator[Batch, None, None]:
        """Endless batches from this step on."""
        start = self.progress.step * self.shapes_per_step
        return training_batches(self.shapes, start=start, workers=self.config.data.workers, **self._loading)

    def open_log(self, *, quiet: bool) -> RunLog:
        """Open the log for writing."""
        step, is_writer = self.progress.step, self.rank == 0
        self.log = RunLog(self.folder, self.config.run, step=step, is_writer=is_writer, quiet=quiet)
        return self.log

    def log_start(self) -> None:
        """Log the start or the resumption of the run."""
        step, device, parameters = self.progress.step, self.accelerator.device, self.model.parameters()
        weights = sum(parameter.numel() for parameter in parameters)
        self.log.event(
            "start" if self.checkpoint is None else "resume",
            step=step,
            model=settings_of(self.model),
            parameters=weights,
            shapes=len(self.shapes),
            held_back=self.evaluated_shapes,
            processes=self.processes,
            device=str(device),
        )
        self.log.say(
            f"{self.model.name}, {weights:,} parameters, on {device}"
            f"{f', {self.processes} processes' if self.processes > 1 else ''}: {len(self.shapes)} shapes, "
            f"{self.shapes_per_step} per step; evaluated on {self.evaluated_shapes}"
            f"{'' if self.checkpoint is None else f'; resumes at step {step} from {self.checkpoint.path}'}"
        )

    def write_config(self) -> None:
        """Write ``config.json``."""
        if self.rank == 0:
            write_atomic(self.folder / CONFIG, json.dumps(self.config.to_dict(), indent=1).encode())

    def save(self, *, must: bool) -> None:
        """Save a checkpoint of this step; where that fails, an error if it `must` be saved, else a warning."""
        progress, scaler, folder = self.progress, self.accelerator.scaler, self.folder / CHECKPOINTS
        progress.seconds, progress.cpu_seconds = self.seconds(), self.cpu_seconds()
        state = {
            "optimiser": self.optimiser.state_dict(),
            "guard": self.guard.state_dict(),
            "scaler": None if scaler is None else scaler.state_dict(),
            "place": asdict(progress),
        }
        reason = None
        if self.rank == 0:
            try:
                path = save_checkpoint(
                    folder,
                    progress.step,
                    model=self.model,
                    state=state,
                    config=self.identity,
                    about={} if progress.measured is None else {"validation": progress.measured},
                    keep=self.config.run.keep,
                    best=progress.best,
                )
                self.log.event("checkpoint", step=progress.step, path=path.name)
            except CheckpointError as error:
                reason = str(error)
                self.log.event("checkpoint_failed", step=progress.step, reason=reason)
        # The other processes wait here, and learn whether it was written.
        reason = gather(reason)[0]
        if reason is None:
            self.saved, self.is_saved = folder / step_folder(progress.step), True
        elif must:
            raise CheckpointError(folder, reason)
        else:
            warnings.warn(f"{reason}; the run continues without this checkpoint", stacklevel=3)

    def measure(self, shapes: int, images: int = 0) -> Evaluation | None:
        """Evaluate the model on this many held-out shapes, keeping some for images; None where a stop was requested."""
        settings, workers = self.config.run, min(1, self.config.data.workers)
        some = validation_batches(self.held_back, count=shapes, workers=workers, **self._loading)
        with contextlib.closing(some):
            return evaluate_model(
                self.model, some, self.stop, region=settings.region, loss=settings.loss, images=images
            )

    def evaluate(self) -> bool:
        """Evaluate, log, and note the best; False where a stop was requested."""
        progress, begun = self.progress, self.seconds()
        found = self.measure(self.config.run.evaluate_shapes, self.config.run.pictures if self.rank == 0 else 0)
        if found is None:
            return False
        self.evaluation, progress.evaluated = found, progress.step
        by_view = [value if isfinite(value) else None for value in found.by_view.values()]
        progress.measured = {"step": progress.step, "measure": found.measure, "by_view": by_view}
        if found.is_better_than(progress.best_value):
            progress.best, progress.best_value = progress.step, found.value
        self.is_saved = False
        self.log.evaluation(progress.step, found, seconds=self.seconds() - begun, best=progress.best)
        return True

    def plan(self) -> bool:
        """Set the number of steps that fill the CPU minutes, from measured times; False where a stop was requested."""
        settings, progress = self.config.run, self.progress
        assert settings.cpu_minutes is not None
        by_views: dict[float, list[float]] = {}
        for views, seconds in progress.timed[SLOW_STEPS:] or progress.timed:
            by_views.setdefault(views, []).append(seconds)
        # Numbers of views are drawn uniformly, but so few draws are uneven.
        step_seconds = mean(mean(seconds) for seconds in by_views.values())
        for _ in range(2):  # the first batch is slower than the others
            begun = self.cpu_seconds()
            if self.measure(settings.batch * self.processes) is None:
                return False
        batches = ceil(self.evaluated_shapes / (settings.batch * self.processes))
        evaluation_seconds = (self.cpu_seconds() - begun) * batches
        left = 60 * settings.cpu_minutes - self.cpu_seconds() - evaluation_seconds
        more = int(left / (step_seconds + evaluation_seconds / settings.evaluate_every))
        steps = gather(progress.step + max(1, more))[0]
        self.config = replace(self.config, run=replace(settings, steps=steps))
        progress.timed.clear()
        self.is_saved = False
        self.log.plan(steps)
        return True
