"""JSON that nobody vouches for: bounded, without repeated keys, and numbers that are numbers."""

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
        DataError: the file is missing, too large, no JSON, nested without end, not an object, or says a key twice.
    """
    values = _parse(path)
    if not isinstance(values, dict):
        raise DataError(path, f"must hold a JSON object; got {describe(values)}")
    return values


def sniff_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file for telling whose it is, empty where it holds some other JSON.

    Raises:
        DataError: as `read_json`, but for what is no object.
    """
    values = _parse(path)
    return values if isinstance(values, dict) else {}


def _parse(path: Path) -> Any:
    text = read_text(path, MAX_JSON_BYTES)
    try:
        # int() of a long text is refused by Python itself; deep nesting ends in a RecursionError.
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is not JSON that can be used ({error})") from error


def read_number(values: Mapping[str, Any], key: str, path: Path, where: str, *, beyond: float = 1e12) -> float:
    """The number under a key, between -``beyond`` and ``beyond``.

    Raises:
        DataError: there is none, or it is no such number.
    """
    value: Any = values.get(key)
    # true is an int in Python, and an int of any length passes as a number until it is converted.
    if type(value) not in (float, int) or not -beyond <= value <= beyond:
        raise DataError(path, f"{where}: {key} must be a number of at most {beyond:g}; got {describe(value)}")
    return float(value)


def read_string(values: dict[str, Any], key: str, path: Path, where: str) -> str:
    """The text under a key.

    Raises:
        DataError: there is none.
    """
    value = values.get(key)
    if not isinstance(value, str):
        raise DataError(path, f"{where}: {key} must be a text; got {describe(value)}")
    return value


def read_array(values: dict[str, Any], key: str, shape: tuple[int, ...], path: Path, where: str) -> np.ndarray:
    """The array of finite numbers under a key, float64, nested lists of exactly this shape.

    Raises:
        DataError: there is none, or it has another shape, or holds what is no number below 1e12.
    """
    rows: list[Any] = [values.get(key)]
    for length in shape:
        # Lengths first: numpy would make an array of objects of ragged lists, and numbers of strings.
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
        raise ValueError("says a key twice")
    return values
