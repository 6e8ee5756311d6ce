"""Reads MATLAB files for `mat_files`, as a script in a process that they may crash; imports nothing of this package.

Standard input holds the files, each after its length in four bytes. Standard output gets one line of JSON a file:
``{"arrays": {name: {"shape": ..., "values": [...]} or {"shape": ..., "bits": ...}}}`` or ``{"error": ...}``.
"""

from __future__ import annotations

import base64
import io
import json
import os
import signal
import struct
import sys
from typing import Any

NAMES = ("K", "extrinsic", "Volume")
# Up to so many numbers an array goes as numbers; beyond, it must be zeros and ones, and goes as bits.
MOST_NUMBERS = 64
MOST_BITS = 1 << 21


def _described(array: Any, numpy: Any) -> dict[str, Any]:
    if not isinstance(array, numpy.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("is no array of numbers")
    shape = list(array.shape)
    if array.size <= MOST_NUMBERS:
        return {"shape": shape, "values": [float(value) for value in array.ravel()]}
    if array.size > MOST_BITS or not ((array == 0) | (array == 1)).all():
        raise ValueError("is no array of zeros and ones, or too large")
    bits = numpy.packbits(array.astype(bool).ravel())
    return {"shape": shape, "bits": base64.b64encode(bits.tobytes()).decode()}


def _read(content: bytes) -> dict[str, Any]:
    import numpy
    import scipy.io

    arrays = scipy.io.loadmat(io.BytesIO(content), variable_names=NAMES)
    found = {}
    for name in NAMES:
        if name in arrays:
            try:
                found[name] = _described(arrays[name], numpy)
            except ValueError as error:
                raise ValueError(f"{name} {error}") from error
    return found


def _answer(content: bytes) -> bytes:
    try:
        answer: dict[str, Any] = {"arrays": _read(content)}
    except ImportError:
        raise
    except MemoryError:
        answer = {"error": "needs too much memory to be read"}
    # Damaged files make the parser raise nearly everything.
    except Exception as error:
        answer = {"error": f"is no MATLAB file that can be used ({error})"}
    return json.dumps(answer).encode() + b"\n"


def _answer_in_child(files: list[bytes]) -> list[bytes]:
    """The answers for the first files, at least one: up to the one that kills the child."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reader)
            with open(writer, "wb") as stream:
                for content in files:
                    stream.write(_answer(content))
                    stream.flush()
        finally:
            os._exit(0)
    os.close(writer)
    with open(reader, "rb") as stream:
        answers = stream.read().splitlines(keepends=True)
    _, status = os.waitpid(child, 0)
    whole = [answer for answer in answers if answer.endswith(b"\n")]
    if len(whole) < len(files):
        number = os.WTERMSIG(status)
        name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
        whole.append(json.dumps({"error": f"crashed its parser ({name})"}).encode() + b"\n")
    return whole


def main() -> None:
    """Answer for every file on standard input."""
    import scipy.io  # noqa: F401  # before any child, so that each need not

    files = []
    while header := sys.stdin.buffer.read(4):
        files.append(sys.stdin.buffer.read(*struct.unpack("<I", header)))
    while files:
        # A child costs milliseconds where this process has cost most of a second.
        answers = _answer_in_child(files) if hasattr(os, "fork") else [_answer(content) for content in files]
        sys.stdout.buffer.writelines(answers)
        files = files[len(answers) :]
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
