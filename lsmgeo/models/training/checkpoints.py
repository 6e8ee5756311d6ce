"""Checkpoints that are whole or not there: what a run saves, and how it comes back to it bit by bit.

A checkpoint is a folder. It is written under another name, brought to the disk file by file, and renamed, so that
neither a kill nor a loss of power at any moment leaves less than the checkpoints from before. ``meta.json`` holds size
and SHA-256 of the files and of itself; what does not match is not read.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import lsmgeo
from lsmgeo._checks import check_whole
from lsmgeo.errors import CheckpointError, OptionError
from lsmgeo.models.run_folders import WEIGHTS, checkpoint_folders, step_folder
from lsmgeo.models.training.revision import code_revision
from lsmgeo.models.weights import Weights, encode_weights, fill_model, parse_weights, read_file

__all__ = ["Checkpoint", "check_config", "clear_leftovers", "load_checkpoint", "load_latest", "save_checkpoint"]

FORMAT = 1
LATEST = "LATEST"
META = "meta.json"
STATE = "state.pt"
MAX_META_BYTES = 1 << 24

# A folder or file on its way in (tmp) or out (old), and the process that it belongs to.
_LEFTOVER = re.compile(r"(?P<name>step_\d{8,18}|LATEST)\.(?P<kind>tmp|old)-\d+")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checkpoint that was read and verified.

    Args:
        path: its folder.
        step: how many steps had been taken.
        config: the configuration of the run that saved it.
        best: the step of the best checkpoint at that time, if any was called that.
        weights: the model's tensors, and the settings that the model is made from.
        state: everything else by name: optimiser, schedule, sampler, random numbers, ...
    """

    path: Path
    step: int
    config: Mapping[str, Any]
    best: int | None
    weights: Weights
    state: Mapping[str, Any]

    def part(self, name: str) -> Any:
        """One part of the state.

        Args:
            name: as it was given to `save_checkpoint`.

        Raises:
            CheckpointError: there is none of this name.
        """
        if name not in self.state:
            there = ", ".join(sorted(self.state)) or "nothing"
            raise CheckpointError(self.path, f"{STATE} has no {name!r}; it has {there}")
        return self.state[name]

    def restore(self, name: str, target: Any) -> None:
        """Give a part of the state to an object's ``load_state_dict``.

        Args:
            name: as it was given to `save_checkpoint`.
            target: optimiser, schedule, scaler, sampler, guard: whatever has ``load_state_dict``.

        Raises:
            CheckpointError: there is no such part, or the object cannot use it.
        """
        state = self.part(name)
        try:
            if isinstance(target, torch.optim.Optimizer):
                _check_moments(target, state)
            target.load_state_dict(state)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError) as error:
            reason = f"missing key {error}" if isinstance(error, KeyError) else str(error)
            raise CheckpointError(self.path, f"{name} does not fit this run: {reason}") from error

    def restore_model(self, model: nn.Module) -> None:
        """Copy the weights into a model.

        Args:
            model: of the same settings as the one that was saved.

        Raises:
            CheckpointError: a tensor is missing, too many, or of another shape or dtype; the message names it.
        """
        fill_model(model, self.weights)


def save_checkpoint(
    folder: str | os.PathLike[str],
    step: int,
    *,
    model: nn.Module,
    state: Mapping[str, Any],
    config: Mapping[str, Any],
    keep: int = 3,
    best: int | None = None,
) -> Path:
    """Write a checkpoint, wholly or not at all, then remove the oldest ones. One process of a run does this.

    Args:
        folder: the run's folder of checkpoints; made if it is not there.
        step: how many steps have been taken.
        model: a model of `lsmgeo.models.create`, not wrapped.
        state: everything else that a resumed run needs, by name: numbers, strings, tensors, lists and dicts of them.
        config: the configuration, in types that JSON has; `check_config` compares with it.
        keep: how many of the newest checkpoints stay.
        best: the step of the best checkpoint so far, which stays too.

    Returns:
        The checkpoint's folder.

    Raises:
        CheckpointError: it cannot be written: the disk is full, the folder is read-only, and the like. The checkpoints
            from before are as they were and nothing half-written stays.
    """
    folder, keep, step = (
        Path(folder),
        check_whole("save_checkpoint", "keep", keep, 1),
        check_whole("save_checkpoint", "step", step, 0),
    )
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    files = {WEIGHTS: encode_weights(model, about={"step": step, "training": dict(config)}), STATE: buffer.getvalue()}
    files[META] = _encode_meta(files, step, config, best)
    final = folder / step_folder(step)
    temporary = folder / f"{final.name}.tmp-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(folder)
        os.mkdir(temporary)
        for name, content in files.items():
            _write(temporary / name, content)
        _sync(temporary)
        _take_place(temporary, final)
        _sync(folder)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CheckpointError(final, f"cannot be written ({error})") from error
    # From here on the checkpoint stands, and whatever fails is repaired by the next one.
    try:
        _write_latest(folder, final.name)
        _prune(folder, step, keep, best)
    except OSError as error:
        warnings.warn(f"{folder}: {final.name} is saved; tidying up failed ({error})", stacklevel=2)
    return final


def load_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read and verify a checkpoint.

    Args:
        path: a checkpoint; or a run folder or its folder of checkpoints, for the newest one that verifies. If that is
            not the newest that is there, a warning names both.

    Raises:
        CheckpointError: there is none, all are damaged, or it is of a newer format.
    """
    path = Path(path)
    if (path / META).is_file() and not checkpoint_folders(path):
        return _read(path)
    checkpoint = load_latest(path)
    if checkpoint is None:
        raise CheckpointError(path, "holds no checkpoint")
    return checkpoint


def load_latest(path: str | os.PathLike[str]) -> Checkpoint | None:
    """Read the newest checkpoint that verifies; if that is not the newest that is there, a warning names both.

    Args:
        path: a run folder or its folder of checkpoints.

    Returns:
        The checkpoint, or None where nothing was ever saved.

    Raises:
        CheckpointError: there are checkpoints, and none verifies; or the newest is of a newer format.
    """
    path = Path(path)
    folders = checkpoint_folders(path)
    damaged: list[CheckpointError] = []
    for step, folder in folders.items():
        try:
            checkpoint = _read(folder)
            if checkpoint.step != step:
                raise CheckpointError(folder, f"is the checkpoint of step {checkpoint.step}, by its {META}")
        except _NewerFormatError:
            raise
        except CheckpointError as error:
            damaged.append(error)
            continue
        if damaged:
            reasons = "; ".join(map(str, damaged))
            warnings.warn(f"damaged: {reasons}. Going back to {folder}", stacklevel=2)
        else:
            _warn_of_missing(folder)
        return checkpoint
    if damaged:
        raise CheckpointError(path, f"no checkpoint verifies; the newest: {damaged[0]}")
    return None


def check_config(checkpoint: Checkpoint, config: Mapping[str, Any], *, free: Collection[str] = ()) -> None:
    """Refuse to resume a run as another one.

    Args:
        checkpoint: what to resume from.
        config: of the resuming run, as for `save_checkpoint`.
        free: dotted names of what may differ, for example "run.steps"; a name of a section frees all of it.

    Raises:
        CheckpointError: another value is different, missing or new; the message names the first.
    """
    # What JSON makes of it (lists of tuples, strings of keys) is what the checkpoint holds.
    before, now = _flatten(checkpoint.config), _flatten(json.loads(_canonical(config)))
    for key in sorted(before.keys() | now.keys()):
        if any(key == name or key.startswith(name + ".") for name in free):
            continue
        was, there = before.get(key, "missing"), now.get(key, "missing")
        if was != there:
            raise CheckpointError(checkpoint.path, f"belongs to another run: {key} is {was!r} there and {there!r} here")


def clear_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove what a killed process left half-written. Only the run that owns the folder may do this.

    Args:
        folder: the run's folder of checkpoints; it need not exist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return
    for item in sorted(folder.iterdir()):
        match = _LEFTOVER.fullmatch(item.name)
        if match is None:
            continue
        if match["kind"] == "old" and not (folder / match["name"]).exists():
            # Killed between the two renames of `_take_place`.
            os.rename(item, folder / match["name"])
        elif item.is_dir():
            shutil.rmtree(item, ignore_errors=True)
        else:
            item.unlink(missing_ok=True)


class _NewerFormatError(CheckpointError):
    """No damage: falling back would throw a newer version's work away."""


def _encode_meta(files: Mapping[str, bytes], step: int, config: Mapping[str, Any], best: int | None) -> bytes:
    canonical = _canonical(config)
    meta = {
        "format": FORMAT,
        "step": step,
        "best": best,
        "files": {
            name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in files.items()
        },
        "config": json.loads(canonical),
        "config_sha256": hashlib.sha256(canonical.encode()).hexdigest(),
        "versions": {"lsmgeo": lsmgeo.__version__, "git": code_revision(), "torch": torch.__version__},
        "saved_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    meta["sha256"] = hashlib.sha256(_canonical(meta).encode()).hexdigest()
    return json.dumps(meta, indent=1).encode()


def _canonical(value: Mapping[str, Any]) -> str:
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OptionError(f"save_checkpoint: config must consist of what JSON has; {error}") from error


def _write(path: Path, content: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(descriptor, rest) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _take_place(temporary: Path, final: Path) -> None:
    if final.exists():
        # A folder cannot replace a full one in one step; `clear_leftovers` takes the old one back if the second fails.
        old = final.with_name(f"{final.name}.old-{os.getpid()}")
        os.rename(final, old)
        try:
            os.rename(temporary, final)
        except OSError:
            os.rename(old, final)
            raise
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.rename(temporary, final)


def _write_latest(folder: Path, name: str) -> None:
    temporary = folder / f"{LATEST}.tmp-{os.getpid()}"
    try:
        _write(temporary, f"{name}\n".encode())
        os.rename(temporary, folder / LATEST)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    _sync(folder)


def _prune(folder: Path, step: int, keep: int, best: int | None) -> None:
    # Those of later steps are damaged, or this run would have resumed from them; they go when it reaches their steps.
    older = [path for number, path in checkpoint_folders(folder).items() if number <= step and number != best]
    for path in older[keep - (best == step) :]:
        # Renamed first: half a checkpoint must not look like a damaged one.
        leftover = path.with_name(f"{path.name}.tmp-{os.getpid()}")
        os.rename(path, leftover)
        shutil.rmtree(leftover)


def _read(folder: Path) -> Checkpoint:
    meta = _read_meta(folder / META)
    contents = {}
    for name in (WEIGHTS, STATE):
        size, digest = meta["files"][name]["bytes"], meta["files"][name]["sha256"]
        contents[name] = content = read_file(folder / name)
        if len(content) != size:
            raise CheckpointError(folder / name, f"has {len(content)} bytes instead of {size}")
        if hashlib.sha256(content).hexdigest() != digest:
            raise CheckpointError(folder / name, "is damaged: its SHA-256 is not the one that was saved")
    weights = parse_weights(contents[WEIGHTS], folder / WEIGHTS)
    try:
        state = torch.load(io.BytesIO(contents[STATE]), map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(folder / STATE, f"cannot be read ({str(error)[:400]})") from error
    if not isinstance(state, dict):
        raise CheckpointError(folder / STATE, f"holds no state but {type(state).__name__}")
    return Checkpoint(folder, meta["step"], meta["config"], meta["best"], weights, state)


def _read_meta(path: Path) -> dict[str, Any]:
    content = read_file(path, MAX_META_BYTES)
    try:
        meta = json.loads(content)
        if not isinstance(meta, dict):
            raise ValueError("no object")
        found = meta.pop("sha256", None)
        is_whole = found == hashlib.sha256(_canonical(meta).encode()).hexdigest()
    except (ValueError, RecursionError, OptionError) as error:
        raise CheckpointError(path, f"is damaged ({str(error)[:200]})") from error
    version = meta.get("format")
    if isinstance(version, int) and version > FORMAT and (is_whole or found is None):
        reason = f"is of format {version}, made by a newer lsmgeo; this one reads up to {FORMAT}"
        raise _NewerFormatError(path, reason)
    if not is_whole:
        raise CheckpointError(path, "is damaged: its SHA-256 is not the one that was saved")
    return meta


def _warn_of_missing(newest: Path) -> None:
    """Say when the pointer names a later checkpoint than there is."""
    try:
        named = read_file(newest.parent / LATEST, 64).decode("ascii").strip()
    except (CheckpointError, UnicodeDecodeError):
        return
    if re.fullmatch(r"step_\d{8,18}", named) and int(named[5:]) > int(newest.name[5:]):
        warnings.warn(f"missing: {newest.with_name(named)}, which {LATEST} names. Going back to {newest}", stacklevel=3)


def _check_moments(optimiser: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """``load_state_dict`` of optimisers takes moments of any shape."""
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for index, moments in state["state"].items():
        for name, moment in moments.items():
            shape = tuple(parameters[index].shape)
            if isinstance(moment, Tensor) and moment.dim() and tuple(moment.shape) != shape:
                raise ValueError(f"{name} of parameter {index} is {tuple(moment.shape)}, the parameter {shape}")


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    return dict(_leaves(values, prefix))


def _leaves(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
