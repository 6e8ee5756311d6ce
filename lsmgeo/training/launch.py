"""Start and stop of a run: devices, the model, signals, agreement of processes.

A signal sets a flag, and training ends at the next point where nothing is lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import distributed

from lsmgeo.errors import DataError, OptionError, TrainingError
from lsmgeo.models.blocks import Model
from lsmgeo.models.creating import MODELS, create, settings_of
from lsmgeo.models.weights import load
from lsmgeo.training.checkpoints import Checkpoint
from lsmgeo.training.config import ModelConfig, RunConfig, TrainingConfig

if TYPE_CHECKING:
    from accelerate import Accelerator

__all__ = [
    "StopRequest",
    "any_true",
    "catch_stop",
    "check_agreement",
    "fast_precision",
    "gather",
    "hold_folder",
    "ignore_stop",
    "make_model",
    "resolve_config",
    "start_accelerator",
]

Item = TypeVar("Item")


def resolve_config(config: TrainingConfig, checkpoint: Checkpoint | None) -> TrainingConfig:
    """Fill in the settings that the trainer chooses: those of a resumed run, else the best for this hardware.

    They are precision "auto", `channels_last` None, and `steps` None where `cpu_minutes` are given.
    """
    run = config.run
    before = {} if checkpoint is None else checkpoint.config.get("run", {})
    model: Any = MODELS.get(config.model.name)
    choices: dict[str, Any] = {}
    if run.precision == "auto":
        choices["precision"] = before.get("precision") or fast_precision(run.device)
    if run.channels_last is None:
        choices["channels_last"] = before.get("channels_last", getattr(model, "prefers_channels_last", False))
    if run.steps is None and run.cpu_minutes is not None:
        choices["steps"] = before.get("steps")
    return replace(config, run=replace(run, **choices))


def fast_precision(device: str) -> str:
    """The precision in which the hardware multiplies fastest: "bf16" or "no".

    A CPU without units for bfloat16 is slower in it than in float32 (docs/experiments).
    """
    if device != "cpu" and torch.cuda.is_available():
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "no"
    return "bf16" if torch.cpu.get_capabilities().get("amx_bf16") else "no"


@contextlib.contextmanager
def start_accelerator(run: RunConfig, *, has_idle_parameters: bool) -> Iterator[Accelerator]:
    """The accelerator of a run, over the processes that `torchrun` started or this one.

    Args:
        run: has device and precision.
        has_idle_parameters: whether some parameters get no gradient, always or from some batches.

    Raises:
        OptionError: accelerate is not installed, or the device does not support this precision.
    """
    try:
        from accelerate import Accelerator
        from accelerate.state import AcceleratorState
        from accelerate.utils import DistributedDataParallelKwargs
    except ImportError as error:
        raise OptionError("train: accelerate is needed; pip install 'lsmgeo[train]'") from error

    is_cpu = run.device == "cpu" or not torch.cuda.is_available()
    if run.precision == "fp16" and is_cpu:
        raise OptionError("run: precision must be 'no' or 'bf16' on a CPU; got 'fp16'")
    options = DistributedDataParallelKwargs(gradient_as_bucket_view=True, find_unused_parameters=has_idle_parameters)
    was_distributed = distributed.is_available() and distributed.is_initialized()
    AcceleratorState._reset_state(reset_partial_state=True)  # of another run in this process
    try:
        yield Accelerator(cpu=is_cpu, mixed_precision=run.precision, kwargs_handlers=[options])
    finally:
        if not was_distributed and distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()
        AcceleratorState._reset_state(reset_partial_state=True)


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Lock a run's folder for this process: two processes would remove each other's checkpoints.

    Raises:
        TrainingError: another process has locked it.
        DataError: it cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise DataError(folder, f"cannot be written ({error})") from error
    try:
        # Workers do not inherit this lock; it ends with the process, also after a kill.
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            raise TrainingError(f"another process trains in {folder}") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def make_model(config: ModelConfig, run: RunConfig, device: torch.device) -> Model:
    """The model to train, with weights from the seed or from a file.

    Raises:
        OptionError: there is no such model, or the file is of another one.
        CheckpointError: the file cannot be used.
    """
    torch.manual_seed(run.seed)
    model = create(config.name, preset=config.preset, variant=config.variant, **config.settings)
    if config.weights is not None:
        other = load(config.weights)
        theirs = settings_of(other)
        for key, mine in settings_of(model).items():
            if mine != theirs.get(key):
                difference = f"{key} is {theirs.get(key)!r} in {config.weights}, {mine!r} here"
                raise OptionError(f"model: weights are of another model: {difference}")
        model.load_state_dict(other.state_dict())
    model.to(device)
    if run.channels_last:
        formats = {4: torch.channels_last, 5: torch.channels_last_3d}
        for parameter in model.parameters():
            if parameter.dim() in formats:
                parameter.data = parameter.data.contiguous(memory_format=formats[parameter.dim()])
    return model.train()


class StopRequest:
    """Whether a signal asked this process to stop; see `catch_stop`."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._waiting = False

    def __bool__(self) -> bool:
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """The process's exit code: 128 plus the signal's number, 143 for SIGTERM; 0 without a signal."""
        return 0 if self.signal is None else 128 + self.signal

    def next_item(self, items: Iterator[Item]) -> Item | None:
        """The next of ``items``, or None as soon as a stop is requested, however long the item would take.

        After None the iterator may be broken: do not use it.
        """
        try:
            try:
                # Set first: a signal between the two lines is noticed by one of them.
                self._waiting = True
                return None if self else next(items)
            finally:
                self._waiting = False
        except _Asked:
            return None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal == number:
            # A second request ends at once; a checkpoint cut off here is as after a loss of power.
            os._exit(128 + number)
        if self:  # Ctrl-C reaches torchrun too, which then sends SIGTERM to its processes
            return
        self.signal = number
        if self._waiting:
            self._waiting = False
            raise _Asked


class _Asked(BaseException):
    """Interrupts a wait for data; handlers of ordinary errors do not catch it."""


@contextlib.contextmanager
def catch_stop() -> Iterator[StopRequest]:
    """Inside this context the first SIGTERM or SIGINT only sets a flag; the same again ends the process at once.

    Training checks the flag wherever it spends time: between steps, between the batches of an evaluation, after a
    checkpoint, and while waiting for data (`StopRequest.next_item`). The handlers from before are restored at the end.
    Outside the main thread, where Python allows no handlers, the flag stays unset.

    Example:
        >>> with catch_stop() as stop:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        ...     bool(stop), stop.exit_code
        (True, 143)
    """
    request = StopRequest()
    before = {}
    try:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                before[number] = signal.signal(number, request._handle)
        yield request
    finally:
        for number, handler in before.items():
            # None: a handler that was not set from Python cannot be set back from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def ignore_stop(worker: int = 0) -> None:
    """A ``worker_init_fn``: the worker ignores SIGTERM and SIGINT and ends with its parent, which saves first."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def any_true(flag: bool) -> bool:
    """Whether the flag is true in any process. All processes must call this together."""
    return any(gather(flag))


def gather(value: Item) -> list[Item]:
    """The values of all processes in the order of their ranks. All processes must call this together."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return [value]
    values: list[Item | None] = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]


def check_agreement(state: Mapping[str, object]) -> None:
    """Refuse to train where processes start from different states.

    Args:
        state: what must be the same in all processes, by name: the configuration, checksums of parameters and of data.

    Raises:
        TrainingError: a value differs; the message names it and the first process that differs.
    """
    for rank, others in enumerate(gather(dict(state))):
        for name, own in state.items():
            if own != (other := others[name]):
                raise TrainingError(f"processes do not agree: {name} is {own!r} here and {other!r} in process {rank}")
