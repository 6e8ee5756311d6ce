"""MATLAB files of nobody's vouching: SciPy reads them in a process of their own, where they may crash it."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from importlib.util import find_spec
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo.data.files import read_bytes
from lsmgeo.data.guarded import run_guarded
from lsmgeo.errors import DataError, OptionError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Arrays", "read_mats"]

Arrays = dict[str, np.ndarray]

WORKER = Path(__file__).with_name("mat_worker.py")
# 128^3 bytes uncompressed fit.
MAX_MAT_BYTES = 1 << 22
# Of address space; the libraries take 200 MiB of it.
MEMORY = 1 << 29
SECONDS = 60.0
SECONDS_OF_A_FILE = 0.1
# What goes to one process: some thousand objects of the LSM release.
MOST_BYTES = 1 << 26
MAX_SIDE = 128


def read_mats(paths: Sequence[Path]) -> list[Arrays | DataError]:
    """Read K, extrinsic and Volume from MATLAB files, as far as each holds them.

    All files go to one process, as starting it takes longer than reading a thousand; its children do the reading, and
    die of a file that is made for it. Where the process itself dies, the files are halved until the one that killed it
    is found.

    Args:
        paths: MATLAB files up to version 7.2.

    Returns:
        For each file its arrays, float64 or, beyond 64 elements, bool; or the error of one that cannot be used.

    Raises:
        OptionError: SciPy is missing.
    """
    if find_spec("scipy") is None:
        raise OptionError("read_mats: MATLAB files need SciPy; install lsmgeo[data]")
    results: dict[Path, Arrays | DataError] = {}
    batch: list[tuple[Path, bytes]] = []
    held = 0
    for path in paths:
        try:
            content = read_bytes(path, MAX_MAT_BYTES)
        except DataError as error:
            results[path] = error
            continue
        if held + len(content) > MOST_BYTES:
            results |= _ask(batch)
            batch, held = [], 0
        batch.append((path, content))
        held += len(content)
    results |= _ask(batch)
    return [results[path] for path in paths]


def _ask(files: list[tuple[Path, bytes]]) -> dict[Path, Arrays | DataError]:
    if not files:
        return {}
    content = b"".join(struct.pack("<I", len(content)) + content for _, content in files)
    try:
        seconds = SECONDS + SECONDS_OF_A_FILE * len(files)
        text = run_guarded(WORKER, content, memory=MEMORY, seconds=seconds, path=files[0][0])
        lines = text.split(b"\n")
        if len(lines) != len(files) + 1:
            raise DataError(files[0][0], "made its parser answer nonsense")
    except DataError as error:
        if len(files) == 1:
            return {files[0][0]: error}
        half = len(files) // 2
        return _ask(files[:half]) | _ask(files[half:])
    return {path: _taken(line, path) for (path, _), line in zip(files, lines[:-1], strict=True)}


def _taken(line: bytes, path: Path) -> Arrays | DataError:
    """Arrays from a line of the worker, which is believed no more than the file."""
    try:
        answer = json.loads(line)
        if "error" in answer:
            reason = "".join(c if c.isprintable() else "?" for c in str(answer["error"])[:300])
            return DataError(path, reason)
        arrays = {str(name): _array(value) for name, value in answer["arrays"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError, binascii.Error) as error:
        return DataError(path, f"made its parser answer nonsense ({error})")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            return DataError(path, f"{name} must hold finite numbers")
    return arrays


def _array(value: dict[str, Any]) -> np.ndarray:
    shape = value["shape"]
    if (
        not isinstance(shape, list)
        or len(shape) > 3
        or any(type(n) is not int or not 1 <= n <= MAX_SIDE for n in shape)
    ):
        raise ValueError("an array of another shape than expected")
    count = prod(shape)
    if "values" in value:
        return np.array([float(number) for number in value["values"]], np.float64).reshape(shape)
    bits = np.frombuffer(base64.b64decode(value["bits"], validate=True), np.uint8)
    if len(bits) != (count + 7) // 8:
        raise ValueError("an array shorter or longer than its shape")
    return np.unpackbits(bits, count=count).view(np.bool_).reshape(shape)
