"""Files of OpenCV's FileStorage (YAML, XML, JSON) as plain names and values, parsed where a crash does no harm."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lsmgeo.data.files import read_text
from lsmgeo.data.guarded import run_guarded
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Entries", "is_storage", "read_storages"]

WORKER = Path(__file__).with_name("storage_worker.py")
# A calibration with the corners of a hundred boards in it has one tenth of this.
MAX_STORAGE_BYTES = 1 << 22
# Of address space; OpenCV and NumPy take most of it.
MEMORY = 1 << 30
SECONDS = 30.0
SUFFIXES = (".yml", ".yaml", ".xml", ".json")
MATRIX = re.compile(rb"opencv-(nd-)?matrix")
PICTURE = re.compile(rb"\.(png|jpe?g)\b", re.IGNORECASE)
BEYOND = 1e12


class Entries(NamedTuple):
    """What one file states, by name."""

    numbers: dict[str, float]
    texts: dict[str, tuple[str, ...]]
    matrices: dict[str, np.ndarray]


def is_storage(path: Path) -> bool:
    """Whether a file looks like one that FileStorage wrote: it holds its matrices, or, but for JSON, names pictures."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    with path.open("rb") as stream:
        start = stream.read(1 << 16).lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() == ".xml":
        return b"<opencv_storage>" in start
    if path.suffix.lower() == ".json":
        return start.startswith(b"{") and MATRIX.search(start) is not None
    return start.startswith(b"%YAML") and (MATRIX.search(start) or PICTURE.search(start)) is not None


def read_storages(paths: Sequence[Path]) -> list[Entries | DataError]:
    """Read numbers, texts, lists of texts and matrices from the top of FileStorage files.

    All files go to one process, as starting it takes a third of a second; where it dies, each gets one of its own.
    Each is handed over as text, so that the parser opens no file, neither this nor another or a compressed one.

    Returns:
        For each file what it states, or the error of one that cannot be used. Matrices are float64.
    """
    results: dict[int, Entries | DataError] = {}
    contents: dict[int, bytes] = {}
    for index, path in enumerate(paths):
        try:
            contents[index] = read_text(path, MAX_STORAGE_BYTES).encode()
        except DataError as error:
            results[index] = error
    groups = [list(contents)] if contents else []
    while groups:
        group = groups.pop()
        try:
            lines = _ask([contents[index] for index in group], paths[group[0]])
        except DataError as error:
            if len(group) == 1:
                results[group[0]] = error
            else:
                middle = len(group) // 2
                groups += [group[:middle], group[middle:]]
            continue
        results |= {index: _taken(line, paths[index]) for index, line in zip(group, lines, strict=True)}
    return [results[index] for index in range(len(paths))]


def _ask(contents: Sequence[bytes], path: Path) -> list[bytes]:
    packed = b"".join(struct.pack("<I", len(content)) + content for content in contents)
    lines = run_guarded(WORKER, packed, memory=MEMORY, seconds=SECONDS, path=path).split(b"\n")
    if len(lines) != len(contents) + 1:
        raise DataError(path, "made its parser answer nonsense")
    return lines[:-1]


def _taken(line: bytes, path: Path) -> Entries | DataError:
    """What the worker says of one file; it is believed no more than the file."""
    try:
        answer = json.loads(line)
        if "error" in answer:
            reason = "".join(c if c.isprintable() else "?" for c in str(answer["error"])[:200])
            return DataError(path, f"is no file of OpenCV's FileStorage ({reason})")
        entries = Entries({}, {}, {})
        for name, value in answer["entries"]:
            if not isinstance(name, str):
                raise ValueError("a name that is no text")
            _sort(entries, name, value, path)
    except DataError as error:
        return error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        return DataError(path, f"made its parser answer nonsense ({error})")
    return entries


def _sort(entries: Entries, name: str, value: Any, path: Path) -> None:
    if isinstance(value, dict):
        rows, columns, values = value["rows"], value["columns"], value["values"]
        # Of several channels, as corners in pictures have, nothing is used.
        if type(rows) is int and type(columns) is int and rows > 0 and columns > 0 and len(values) == rows * columns:
            entries.matrices[name] = np.array([_finite(x, name, path) for x in values]).reshape(rows, columns)
    elif isinstance(value, str):
        entries.texts[name] = (value,)
    elif isinstance(value, list):
        entries.texts[name] = tuple(str(text) for text in value)
    else:
        entries.numbers[name] = _finite(value, name, path)


def _finite(value: Any, name: str, path: Path) -> float:
    if type(value) not in (int, float) or not -BEYOND <= value <= BEYOND:
        raise DataError(path, f"{name} must hold finite numbers of at most {BEYOND:g}")
    return float(value)
