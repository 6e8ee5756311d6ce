"""Weights of models in one file: safetensors, with the model's settings and a checksum.

Everything in such a file is checked before it is used: its header is bounded, and names, shapes, dtypes and count of
its tensors are compared with those of the model that the settings describe before that model is allocated.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lsmgeo._checks import check_flag
from lsmgeo.data.atomic_files import write_atomic
from lsmgeo.data.read_files import read_bytes
from lsmgeo.errors import CheckpointError, DataError, LsmGeoError, OptionError
from lsmgeo.models.blocks import Model
from lsmgeo.models.creating import from_settings, settings_of

__all__ = [
    "CHECKPOINTS",
    "STEP",
    "WEIGHTS",
    "NewerFormatError",
    "Weights",
    "checkpoint_folders",
    "checksum",
    "encode_weights",
    "fill_model",
    "load",
    "newest_checkpoint",
    "parse_weights",
    "read_file",
    "read_weights",
    "step_folder",
    "tensors_of",
    "write_weights",
]

# Where a run keeps its checkpoints: RUN/checkpoints/step_00000100/{model.safetensors, state.pt, meta.json}.
CHECKPOINTS = "checkpoints"
WEIGHTS = "model.safetensors"
# ".old": a checkpoint that was being replaced when the process was killed.
STEP = re.compile(r"step_(\d{8,18})(\.old-\d+)?")

FORMAT = "lsmgeo-weights-1"
MAX_FILE_BYTES = 1 << 34
MAX_HEADER_BYTES = 1 << 22
MAX_TENSORS = 10_000
DTYPES = {
    torch.float64: "F64", torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.int64: "I64",
    torch.int32: "I32", torch.uint8: "U8", torch.bool: "BOOL",
}  # fmt: skip

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class Weights:
    """The content of a file of weights.

    Args:
        path: the file.
        settings: of the model.
        about: the notes kept with the weights.
        tensors: by the names of the model's ``state_dict``.
    """

    path: Path
    settings: Mapping[str, Any]
    about: Mapping[str, Any]
    tensors: Mapping[str, Tensor]


def write_weights(
    path: str | os.PathLike[str], model: nn.Module, *, about: Mapping[str, Any] | None = None, half: bool = False
) -> Path:
    """Write a model to one file, atomically; `load` reads it.

    Args:
        path: the file, by convention ``.safetensors``.
        model: from `create`. A model that `load` could not build from its settings (with your own encoder or layer, in
            float64, ...) is refused: save its ``state_dict`` with `torch.save`.
        about: notes to keep with the weights, in types that JSON has.
        half: whether float32 weights are kept as float16, in half the space; `load` converts them to float32.

    Returns:
        The path written.

    Raises:
        CheckpointError: the file cannot be written; nothing half-written stays.
        DTypeError: not a model of this library.
        OptionError: a model that `load` could not read; notes that JSON cannot hold; with `half`, a weight that
            overflows float16.

    Example:
        >>> import tempfile
        >>> from lsmgeo.models import create
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = write_weights(f"{folder}/model.safetensors", create("voxel-lsm", preset="tiny"))
        ...     load(path).name
        'voxel-lsm'
    """
    try:
        return write_atomic(path, encode_weights(model, about=about, half=half))
    except DataError as error:
        raise CheckpointError(path, error.reason) from error


def load(path: str | os.PathLike[str]) -> Model:
    """Build a model from its weights.

    Args:
        path: as for `read_weights`.

    Returns:
        The model, on the CPU, in evaluation mode; its `about` are the notes kept with the weights.

    Raises:
        CheckpointError: there is no such file, it is damaged, or its content does not match its settings.
    """
    weights = read_weights(path)
    model = _build(weights)
    _check_fit(model, weights)
    dtypes = {name: tensor.dtype for name, tensor in model.state_dict().items()}
    model.load_state_dict(
        {name: tensor.to(dtypes[name], copy=True) for name, tensor in weights.tensors.items()}, assign=True
    )
    model.about = weights.about
    return model.eval()


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """Read and verify weights without building the model.

    Args:
        path: a file of `write_weights`; a checkpoint; or a run folder, for its newest checkpoint whose weights verify.
            If that is not the newest one, a warning names both.

    Returns:
        Settings, notes and tensors.

    Raises:
        CheckpointError: there is no such file, or it is damaged.
    """
    path = Path(path)
    if not path.is_dir():
        return _read(path)
    if (path / WEIGHTS).is_file():
        return _read(path / WEIGHTS)
    weights = newest_checkpoint(path, lambda folder: _read(folder / WEIGHTS))
    if weights is None:
        raise CheckpointError(path, f"holds neither {WEIGHTS} nor a checkpoint")
    return weights


class NewerFormatError(CheckpointError):
    """The file is not damaged: falling back to an older one would discard a newer version's work."""


def newest_checkpoint(path: Path, read: Callable[[Path], Found], problems: Sequence[str] = ()) -> Found | None:
    """The newest readable checkpoint of a run; if that is not the newest one, a warning names both.

    Args:
        path: a run folder or its folder of checkpoints.
        read: reads and verifies the checkpoint in a folder.
        problems: problems that are already known.

    Returns:
        The result of `read`, or None where nothing was ever saved.

    Raises:
        CheckpointError: there are checkpoints, and none verifies; or the newest is of a newer format.
    """
    problems = list(problems)
    for folder in checkpoint_folders(path).values():
        try:
            found = read(folder)
        except NewerFormatError:
            raise
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(f"{'; '.join(problems)}. Going back to {folder}", stacklevel=3)
        return found
    if problems:
        raise CheckpointError(path, f"no checkpoint verifies: {'; '.join(problems)}")
    return None


def step_folder(step: int) -> str:
    """The name of a step's checkpoint, such as "step_00000100"."""
    return f"step_{step:08d}"


def checkpoint_folders(path: Path) -> dict[int, Path]:
    """The finished checkpoints in a run folder, or in its folder of checkpoints, by step, newest first; {} if none."""
    folder = path / CHECKPOINTS if (path / CHECKPOINTS).is_dir() else path
    found: dict[int, Path] = {}
    # The longer names first: a checkpoint takes precedence over the one that it replaces.
    for item in sorted(folder.glob("step_*"), key=lambda item: -len(item.name)):
        match = STEP.fullmatch(item.name)
        if match and item.is_dir():
            found[int(match[1])] = item
    return dict(sorted(found.items(), reverse=True))


def encode_weights(model: nn.Module, *, about: Mapping[str, Any] | None = None, half: bool = False) -> bytes:
    """The bytes of a file of weights; arguments and errors as in `write_weights`."""
    settings, tensors = settings_of(model), tensors_of(model)
    if check_flag("write_weights", "half", half):
        tensors = {name: tensor.half() if tensor.dtype == torch.float32 else tensor for name, tensor in tensors.items()}
        if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
            raise OptionError("write_weights: half must be False for weights that are not finite in float16")
    try:
        notes = json.dumps(dict(about or {}), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise OptionError(f"write_weights: about must consist of what JSON has; {error}") from error
    _check_readable(model, Weights(Path(), settings, {}, tensors))
    metadata = {"format": FORMAT, "settings": json.dumps(settings), "about": notes}
    metadata["sha256"] = checksum(metadata, tensors)
    content = safetensors.torch.save(tensors, metadata)
    if int.from_bytes(content[:8], "little") > MAX_HEADER_BYTES:
        raise OptionError(f"write_weights: about must be shorter than {MAX_HEADER_BYTES} bytes as JSON")
    return content


def _check_readable(model: nn.Module, weights: Weights) -> None:
    """Refuse a model that `load` could not build again from its settings."""
    who = "write_weights: model must be one that load can build from its settings"
    try:
        loaded = _build(weights)
        ours = dict(model.named_modules())
        for name, module in loaded.named_modules():
            if type(module) is not type(ours.get(name, module)):
                mine, kind = type(ours[name]).__name__, type(module).__name__
                raise OptionError(f"{who}; {name or 'it'} is of type {mine}, and load makes {kind}")
        _check_fit(loaded, weights)
    except CheckpointError as error:
        raise OptionError(f"{who}; the file {error.reason}") from error


def tensors_of(model: nn.Module) -> dict[str, Tensor]:
    """Contiguous copies of a model's parameters and buffers by name, on the CPU."""
    return {name: tensor.detach().cpu().contiguous().clone() for name, tensor in model.state_dict().items()}


def parse_weights(content: bytes, path: Path) -> Weights:
    """Parse the content of a file of weights; a CheckpointError with its path where it is damaged, or no such file."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > min(len(content) - 8, MAX_HEADER_BYTES):
        raise CheckpointError(path, "is not a whole file of weights (safetensors)")
    try:
        header = json.loads(content[8 : 8 + length])
        metadata = header.pop("__metadata__")
        if metadata["format"] != FORMAT:
            raise CheckpointError(path, f"is of format {metadata['format'][:64]!r}; this version reads {FORMAT!r}")
        if len(header) > MAX_TENSORS:
            raise CheckpointError(path, f"holds {len(header)} tensors, the limit is {MAX_TENSORS}")
        # It rejects tensors whose shapes do not fill the file exactly, one after another.
        tensors = safetensors.torch.load(content)
        settings, about = json.loads(metadata["settings"]), json.loads(metadata["about"])
        if metadata.pop("sha256") != checksum(metadata, tensors):
            raise CheckpointError(path, "is damaged: its SHA-256 does not match the saved one")
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(path, f"is damaged, or not a file of weights ({str(error)[:200]})") from error
    if not isinstance(settings, dict) or not isinstance(about, dict):
        raise CheckpointError(path, "holds invalid settings")
    return Weights(path, settings, about, tensors)


def read_file(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a plain file; a CheckpointError where it is missing, unreadable, or larger than `limit`."""
    try:
        return read_bytes(path, limit)
    except DataError as error:
        raise CheckpointError(path, error.reason) from error


def fill_model(model: nn.Module, weights: Weights) -> None:
    """Copy tensors into a model; a CheckpointError names one that is missing, unknown, or of another shape or dtype."""
    _check_fit(model, weights)
    model.load_state_dict(dict(weights.tensors))


def _read(path: Path) -> Weights:
    return parse_weights(read_file(path), path)


def _build(weights: Weights) -> Model:
    """The model of these weights; its parameters have no memory yet."""
    # Settings that do not match the file's content must not allocate memory.
    with _WithoutMemory(), torch.random.fork_rng(devices=[]):
        try:
            model = from_settings(dict(weights.settings))
        except (LsmGeoError, TypeError, ValueError, KeyError, RuntimeError) as error:
            raise CheckpointError(weights.path, f"holds settings of no model ({str(error)[:400]})") from error
    return model


class _WithoutMemory(TorchFunctionMode):
    """Parameters without memory; ``torch.device("meta")`` affects all tensors, and its arithmetic loads sympy."""

    def __torch_function__(
        self, func: Callable, types: Sequence[type], args: tuple = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        options = dict(kwargs or {})
        if func is torch.empty:
            options["device"] = "meta"
        elif re.fullmatch("[a-z]\\w*_", getattr(func, "__name__", "")):  # initialises a parameter
            target = args[0] if args else options["tensor"]
            if target.is_meta:
                return target
        return func(*args, **options)


def _check_fit(model: nn.Module, weights: Weights) -> None:
    expected = model.state_dict()
    for name in sorted(expected.keys() | weights.tensors.keys()):
        if name not in weights.tensors:
            raise CheckpointError(weights.path, f"lacks {name}, {_describe(expected[name])}")
        if name not in expected:
            raise CheckpointError(weights.path, f"holds {name}, which the model does not have")
        want, have = _describe(expected[name]), _describe(weights.tensors[name])
        is_half = expected[name].dtype == torch.float32 and have == _describe(expected[name], torch.float16)
        if have != want and not is_half:
            raise CheckpointError(weights.path, f"holds {name} as {have}; the model has {want}")


def _describe(tensor: Tensor, dtype: torch.dtype | None = None) -> str:
    return f"{tuple(tensor.shape)} {str(dtype or tensor.dtype).removeprefix('torch.')}"


def checksum(metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of metadata and of tensors, contiguous and on the CPU, with their names, dtypes and shapes."""
    digest = hashlib.sha256(json.dumps(dict(metadata), sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(json.dumps([name, DTYPES[tensor.dtype], list(tensor.shape)]).encode())
        # Reinterpreted as bytes: numpy has no bfloat16.
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
