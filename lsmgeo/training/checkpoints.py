"""Checkpoints of a run, written atomically, from which it resumes bit by bit.

A checkpoint is a folder. It is written under another name, synced to the disk file by file, and renamed, so that the
checkpoints from before survive a kill or a loss of power at any moment. ``meta.json`` holds size and SHA-256 of the
files and of itself; files that do not match are not read.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import lsmgeo
from lsmgeo.data.atomic_files import atomic_folder, clear_leftovers, remove_folder, write_atomic
from lsmgeo.errors import CheckpointError, DataError, OptionError
from lsmgeo.models.weights import (
    CHECKPOINTS,
    STEP,
    WEIGHTS,
    NewerFormatError,
    Weights,
    checkpoint_folders,
    encode_weights,
    newest_checkpoint,
    parse_weights,
    read_file,
    step_folder,
)

__all__ = ["Checkpoint", "check_config", "load_latest", "save_checkpoint"]

FORMAT = 1
LATEST = "LATEST"
META = "meta.json"
STATE = "state.pt"
MAX_META_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A verified checkpoint.

    Args:
        path: its folder.
        step: how many steps had been taken.
        config: of the run that saved it.
        best: the step of the best checkpoint at that time, if any.
        weights: the model's tensors and settings.
        state: everything else by name: optimiser, guard, progress of the run, ...
    """

    path: Path
    step: int
    config: Mapping[str, Any]
    best: int | None
    weights: Weights
    state: Mapping[str, Any]

    def part(self, name: str) -> Any:
        """One part of the state; a CheckpointError where there is none of this name."""
        if name not in self.state:
            known = ", ".join(sorted(self.state)) or "nothing"
            raise CheckpointError(self.path, f"{STATE} has no {name!r}; it has {known}")
        return self.state[name]

    def restore(self, name: str, target: Any) -> None:
        """Give a part of the state to an object's ``load_state_dict``; a CheckpointError where it does not fit."""
        state = self.part(name)
        try:
            if hasattr(target, "param_groups"):
                _check_moments(target.param_groups, state)
            target.load_state_dict(state)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError) as error:
            reason = f"missing key {error}" if isinstance(error, KeyError) else str(error)
            raise CheckpointError(self.path, f"{name} does not fit this run: {reason}") from error


def save_checkpoint(
    folder: str | os.PathLike[str],
    step: int,
    *,
    model: nn.Module,
    state: Mapping[str, Any],
    config: Mapping[str, Any],
    keep: int = 3,
    best: int | None = None,
    about: Mapping[str, Any] | None = None,
) -> Path:
    """Write a checkpoint atomically, then remove the oldest ones. One process of a run does this.

    Args:
        folder: the run's folder of checkpoints; made if it does not exist.
        step: how many steps have been taken.
        model: a model of `lsmgeo.models.create`, not wrapped.
        state: everything else that a resumed run needs, by name: numbers, strings, tensors, lists and dicts of them.
        config: the configuration, in types that JSON has; `check_config` compares with it.
        keep: how many of the newest checkpoints stay.
        best: the step of the best checkpoint so far, which stays too.
        about: further notes to keep with the weights, in types that JSON has.

    Returns:
        The checkpoint's folder.

    Raises:
        CheckpointError: it cannot be written (the disk is full, the folder is read-only, ...). The checkpoints from
            before are unchanged and nothing half-written stays.
        OptionError: the state or the configuration holds what a checkpoint cannot, or `load` could not build the model.
    """
    folder = Path(folder)
    final = folder / step_folder(step)
    about = {"step": step, "training": json.loads(_canonical(config)), **(about or {})}
    files = {WEIGHTS: encode_weights(model, about=about), STATE: _encode_state(state)}
    files[META] = _encode_meta(files, step, config, best)
    try:
        clear_leftovers(folder)
        with atomic_folder(final, replace=True) as made:
            for name, content in files.items():
                write_atomic(made / name, content)
    except DataError as error:
        raise CheckpointError(final, error.reason) from error
    # The checkpoint is written; the next save makes up for failures from here on.
    try:
        write_atomic(folder / LATEST, f"{final.name}\n".encode())
        # Checkpoints of later steps are damaged, or this run would have resumed from them; it replaces them later.
        for number in [number for number in checkpoint_folders(folder) if number <= step][keep:]:
            if number != best:
                remove_folder(folder / step_folder(number))
    except DataError as error:
        warnings.warn(f"{final} is saved; tidying up after it failed ({error})", stacklevel=2)
    return final


def load_latest(path: str | os.PathLike[str]) -> Checkpoint | None:
    """Read and verify a checkpoint, or the newest one that is not damaged; a warning names those of later steps.

    Args:
        path: a checkpoint, a run folder or its folder of checkpoints.

    Returns:
        The checkpoint, or None where nothing was ever saved.

    Raises:
        CheckpointError: there are checkpoints, and none verifies; or the newest is of a newer format.
    """
    path = Path(path)
    if (path / META).is_file():
        return _read(path)
    problems = []
    newest = max(checkpoint_folders(path), default=-1)
    if missing := _missing(path / CHECKPOINTS if (path / CHECKPOINTS).is_dir() else path, newest):
        problems.append(f"{missing}: is missing, and {LATEST} names it")
    return newest_checkpoint(path, _read, problems)


def check_config(checkpoint: Checkpoint, config: Mapping[str, Any], *, free: Collection[str] = ()) -> None:
    """Refuse to resume from a checkpoint of another run.

    Args:
        checkpoint: to resume from.
        config: of this run, as for `save_checkpoint`.
        free: dotted names of settings that may differ, such as "run.steps".

    Raises:
        CheckpointError: another value is different, missing or new; the message names the first.
    """
    # The checkpoint holds the configuration as JSON does (lists for tuples).
    before, now = dict(_leaves(checkpoint.config)), dict(_leaves(json.loads(_canonical(config))))
    for key in sorted(before.keys() | now.keys()):
        was, is_now = before.get(key, "missing"), now.get(key, "missing")
        if was != is_now and key not in free:
            raise CheckpointError(checkpoint.path, f"belongs to another run: {key} was {was!r} and is {is_now!r} now")


def _encode_state(state: Mapping[str, Any]) -> bytes:
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    try:
        # Fail now, and not after a loss of power, where it cannot be read back.
        torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)
    except Exception as error:
        reason = str(error)[:400]
        raise OptionError(f"save_checkpoint: state must consist of numbers, text and tensors; {reason}") from error
    return buffer.getvalue()


def _encode_meta(files: Mapping[str, bytes], step: int, config: Mapping[str, Any], best: int | None) -> bytes:
    meta = {
        "format": FORMAT,
        "step": step,
        "best": best,
        "files": {
            name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in files.items()
        },
        "config": json.loads(_canonical(config)),
        "versions": {"lsmgeo": lsmgeo.__version__, "torch": torch.__version__},
        "saved_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    meta["sha256"] = hashlib.sha256(_canonical(meta).encode()).hexdigest()
    return json.dumps(meta, indent=1).encode()


def _canonical(value: Mapping[str, Any]) -> str:
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OptionError(f"save_checkpoint: config must consist of what JSON has; {error}") from error


def _read(folder: Path) -> Checkpoint:
    meta = _read_meta(folder / META)
    contents = {}
    try:
        entries = [(name, meta["files"][name]["bytes"], meta["files"][name]["sha256"]) for name in (WEIGHTS, STATE)]
        step, config, best = meta["step"], meta["config"], meta["best"]
    except (KeyError, TypeError) as error:
        raise CheckpointError(folder / META, f"lacks what a checkpoint needs ({error})") from error
    for name, size, digest in entries:
        contents[name] = content = read_file(folder / name)
        if len(content) != size:
            raise CheckpointError(folder / name, f"has {len(content)} bytes instead of {size}")
        if hashlib.sha256(content).hexdigest() != digest:
            raise CheckpointError(folder / name, "is damaged: its SHA-256 does not match the saved one")
    weights = parse_weights(contents[WEIGHTS], folder / WEIGHTS)
    try:
        state = torch.load(io.BytesIO(contents[STATE]), map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(folder / STATE, f"cannot be read ({str(error)[:400]})") from error
    if not isinstance(state, dict):
        raise CheckpointError(folder / STATE, f"must hold a dict; it holds a {type(state).__name__}")
    match = STEP.fullmatch(folder.name)
    if match and int(match[1]) != step:
        raise CheckpointError(folder, f"is the checkpoint of step {step}, as its {META} says")
    return Checkpoint(folder, step, config, best, weights, state)


def _read_meta(path: Path) -> dict[str, Any]:
    content = read_file(path, MAX_META_BYTES)
    try:
        meta = json.loads(content)
        if not isinstance(meta, dict):
            raise ValueError("no object")
        found = meta.pop("sha256", None)
        is_whole = found == hashlib.sha256(_canonical(meta).encode()).hexdigest()
    except (ValueError, RecursionError) as error:
        raise CheckpointError(path, f"is damaged ({str(error)[:200]})") from error
    version = meta.get("format")
    if isinstance(version, int) and version > FORMAT and (is_whole or found is None):
        reason = f"is of format {version}, made by a newer lsmgeo; this one reads up to {FORMAT}"
        raise NewerFormatError(path, reason)
    if not is_whole:
        raise CheckpointError(path, "is damaged: its SHA-256 does not match the saved one")
    return meta


def _missing(folder: Path, newest: int) -> Path | None:
    """The checkpoint that ``LATEST`` in a folder names, if it is later than the newest one there."""
    try:
        named = read_file(folder / LATEST, 64).decode("ascii").strip()
    except (CheckpointError, UnicodeDecodeError):
        return None
    is_later = re.fullmatch(r"step_\d{8,18}", named) and int(named.removeprefix("step_")) > newest
    return folder / named if is_later else None


def _check_moments(groups: list[dict[str, Any]], state: Mapping[str, Any]) -> None:
    """Refuse moments of another shape than their parameter, which optimisers' ``load_state_dict`` accepts."""
    shapes = [tuple(parameter.shape) for group in groups for parameter in group["params"]]
    for index, moments in state["state"].items():
        for name, moment in moments.items():
            if isinstance(moment, Tensor) and moment.dim() and tuple(moment.shape) != shapes[index]:
                raise ValueError(f"{name} of parameter {index} is {tuple(moment.shape)}, the parameter {shapes[index]}")


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
