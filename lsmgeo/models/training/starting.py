"""What stands before the first step: processes and their devices, and the model."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from lsmgeo.errors import DataError, OptionError, TrainingError
from lsmgeo.models.creating import MODELS, create, settings_of
from lsmgeo.models.model import Model
from lsmgeo.models.training.checkpoints import Checkpoint
from lsmgeo.models.training.config import ModelConfig, RunConfig, TrainingConfig
from lsmgeo.models.weights import load

if TYPE_CHECKING:
    from accelerate import Accelerator

__all__ = ["decided", "fast_precision", "hold_folder", "make_model", "started"]


def decided(config: TrainingConfig, checkpoint: Checkpoint | None) -> TrainingConfig:
    """A configuration with what is left to the trainer filled in: as a run that goes on has it, else for this hardware.

    Args:
        config: of the run; precision may be "auto", `channels_last` None, `steps` None where `cpu_minutes` are given.
        checkpoint: that the run goes on from, if any.
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

    Args:
        device: "auto" or "cpu".
    """
    if device != "cpu" and torch.cuda.is_available():
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "no"
    return "bf16" if torch.cpu.get_capabilities().get("amx_bf16") else "no"


@contextlib.contextmanager
def started(run: RunConfig, *, has_idle_parameters: bool) -> Iterator[Accelerator]:
    """The processes of a run, as `torchrun` started them, or this one alone.

    Args:
        run: says device and precision.
        has_idle_parameters: whether some parameters get no gradient, always or from some batches.

    Raises:
        OptionError: accelerate is not installed, or the device cannot compute in this precision.
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
    was_distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
    AcceleratorState._reset_state(reset_partial_state=True)  # of another run in this process
    try:
        yield Accelerator(cpu=is_cpu, mixed_precision=run.precision, kwargs_handlers=[options])
    finally:
        if not was_distributed and torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        AcceleratorState._reset_state(reset_partial_state=True)


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Keep a run's folder for this process: two that trained in it would take each other's checkpoints away.

    Raises:
        TrainingError: another process holds it.
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
        # A lock of the process, which its workers do not inherit: it ends with the process, however that ends.
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
    """The model that is trained, with weights from the seed or from a file.

    Raises:
        OptionError: there is no such model, or the file holds another.
        CheckpointError: the file cannot be used.
    """
    torch.manual_seed(run.seed)
    model = create(config.name, preset=config.preset, variant=config.variant, **config.settings)
    if config.weights is not None:
        other = load(config.weights)
        theirs = settings_of(other)
        for key, mine in settings_of(model).items():
            if mine != theirs.get(key):
                there = f"{key} is {theirs.get(key)!r} in {config.weights}, {mine!r} here"
                raise OptionError(f"model: weights are of another model: {there}")
        model.load_state_dict(other.state_dict())
    model.to(device)
    if run.channels_last:
        formats = {4: torch.channels_last, 5: torch.channels_last_3d}
        for parameter in model.parameters():
            if parameter.dim() in formats:
                parameter.data = parameter.data.contiguous(memory_format=formats[parameter.dim()])
    return model.train()
