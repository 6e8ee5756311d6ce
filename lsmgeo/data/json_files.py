"""Untrusted JSON files: limited size, no repeated keys, finite numbers."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo._checks import describe
from lsmgeo.data.read_files import read_text
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["read_array", "read_json", "read_number", "read_string", "sniff_json"]

MAX_JSON_BYTES = 1 << 24


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DataError: the file is missing, too large, not JSON, nested too deeply, not an object, or repeats a key.
    """
    values = _parse(path)
    if not isinstance(values, dict):
        raise DataError(path, f"must hold a JSON object; got {describe(values)}")
    return values


def sniff_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file, to detect its format; empty for JSON that is not an object."""
    values = _parse(path)
    return values if isinstance(values, dict) else {}


def _parse(path: Path) -> Any:
    text = read_text(path, MAX_JSON_BYTES)
    try:
        # Python itself refuses int() of a long text; deep nesting raises a RecursionError.
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is not JSON ({error})") from error


def read_number(values: Mapping[str, Any], key: str, path: Path, where: str, *, beyond: float = 1e12) -> float:
    """The number of a key, between -``beyond`` and ``beyond``; a DataError if there is none."""
    value: Any = values.get(key)
    # true is an int in Python, and converting a very long int would raise.
    if type(value) not in (float, int) or not -beyond <= value <= beyond:
        raise DataError(path, f"{where}: {key} must be a number of at most {beyond:g}; got {describe(value)}")
    return float(value)


def read_string(values: dict[str, Any], key: str, path: Path, where: str) -> str:
    """The string of a key; a DataError if there is none."""
    value = values.get(key)
    if not isinstance(value, str):
        raise DataError(path, f"{where}: {key} must be a string; got {describe(value)}")
    return value


def read_array(values: dict[str, Any], key: str, shape: tuple[int, ...], path: Path, where: str) -> np.ndarray:
    """The float64 array of a key, nested lists of exactly this shape; a DataError for all else, or beyond 1e12."""
    rows: list[Any] = [values.get(key)]
    for length in shape:
        # Lengths first: numpy accepts ragged lists as an array of objects, and converts strings to numbers.
        if any(not isinstance(row, list) or len(row) != length for row in rows):
            expected = " x ".join(map(str, shape))
            raise DataError(path, f"{where}: {key} must be {expected} numbers; got {describe(values.get(key))}")
        rows = [value for row in rows for value in row]
    if any(type(value) not in (float, int) or not -1e12 <= value <= 1e12 for value in rows):
        raise DataError(path, f"{where}: {key} must hold finite numbers of at most 1e12")
    return np.array(rows, np.float64).reshape(shape)


def _refuse_constant(name: str) -> float:
    raise ValueError(f"holds {name}")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        raise ValueError("uses a key twice")
    return values
