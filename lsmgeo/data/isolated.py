"""Parsers that a damaged file can crash run in an isolated process with limited memory and time."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

# This file is also the script of the process, and importing the package takes seconds: so it imports none of it.
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from lsmgeo.errors import DataError

__all__ = ["parse_isolated"]

Arrays = dict[str, np.ndarray]

MAX_ANSWER_BYTES = 1 << 30
MAX_REQUEST_BYTES = 1 << 26
MAX_LINE_BYTES = 1 << 20


def parse_isolated(
    function: Callable[..., Mapping[str, np.ndarray]],
    paths: Sequence[Path],
    *arguments: object,
    limit: int,
    memory: int,
    seconds: float,
) -> list[Arrays | DataError]:
    """Call ``function(content, *arguments)`` on files that may crash it, in another process, and return its arrays.

    One process parses all files, since starting it takes longer than parsing hundreds; if a file ends it, another one
    parses the rest. The process is an isolated interpreter (``python -I``) that runs only the function's source file.
    It has limited memory and time, and writes no core dump; without POSIX limits only time is limited. Its answers are
    checked like a file, since a hostile file may control it: they contain plain arrays, no pickle.

    Args:
        function: at the top level of a file that imports nothing of this package, and little else, as each start
            imports it. An exception that it raises refuses the file, and is the reason.
        paths: the files.
        arguments: further arguments, as JSON can represent them.
        limit: the largest file, in bytes.
        memory: address space in bytes, libraries included.
        seconds: the time limit of a file; that of all files is this and one second for each.

    Returns:
        For each file its arrays (bool, numbers or text), or the error of a file that cannot be used.
    """
    from lsmgeo.data.read_files import read_bytes
    from lsmgeo.errors import DataError

    answers: dict[int, Arrays | DataError] = {}
    waiting = list(enumerate(paths))
    while waiting:
        # The files of one process are held in memory at once: up to 64 MiB together.
        files, held = [], 0
        for number, path in waiting:
            if held > MAX_REQUEST_BYTES:
                break
            try:
                content = read_bytes(path, limit)
            except DataError as error:
                answers[number] = error
                continue
            files.append((number, path, content))
            held += len(content)
        found = _run_process(function, [file[1:] for file in files], arguments, memory, seconds) if files else []
        answers |= {file[0]: answer for file, answer in zip(files, found, strict=False)}
        waiting = [one for one in waiting if one[0] not in answers]
    return [answers[number] for number in range(len(paths))]


def _run_process(
    function: Callable[..., object], files: Sequence[tuple[Path, bytes]], arguments: object, memory: int, seconds: float
) -> list[Arrays | DataError]:
    """The answers up to the first file that ends the process, at least one."""
    from lsmgeo.errors import DataError

    order = json.dumps([memory, seconds, inspect.getsourcefile(function), function.__name__, arguments])
    parts = (order.encode(), *(content for _, content in files))
    content = b"".join(len(part).to_bytes(8, "little") + part for part in parts)
    # Threads of linear algebra libraries would reserve address space.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with tempfile.TemporaryFile() as output:
        try:
            code = subprocess.run(
                [sys.executable, "-I", "-B", __file__],
                input=content,
                stdout=output,
                stderr=subprocess.DEVNULL,
                env=environment,
                timeout=seconds + len(files),
                check=False,
            ).returncode
            reason = _reason(code, seconds)
        except subprocess.TimeoutExpired:
            reason = f"took its parser more than {seconds:g} seconds"
        except OSError as error:
            return [
                DataError(path, f"cannot be read: no process could be started for it ({error})") for path, _ in files
            ]
        output.seek(0)
        answers: list[Arrays | DataError] = []
        for path, _ in files:
            try:
                found = _read_answer(output, reason)
            # The process is as untrusted as the file, and NumPy raises many kinds of errors on damaged arrays.
            except Exception:
                return [*answers, DataError(path, "made its parser return an invalid answer")]
            if isinstance(found, str):
                answers.append(DataError(path, "".join(c if c.isprintable() else "?" for c in found[:300])))
                if found == reason:
                    break
            else:
                answers.append(found)
    return answers


def _read_answer(stream: BinaryIO, reason: str) -> Arrays | str:
    """The next answer: arrays, or the reason why there are none, which is ``reason`` if the process ended."""
    line = stream.readline(MAX_LINE_BYTES)
    if not line.endswith(b"\n"):
        return reason
    answer = json.loads(line)
    if isinstance(answer, str):
        return answer
    arrays = {}
    for name in answer["names"]:
        arrays[name] = array = np.lib.format.read_array(stream, allow_pickle=False)
        if not isinstance(name, str) or array.dtype.kind not in "biufU":
            raise ValueError("not a plain array")
    return arrays


def _reason(code: int, seconds: float) -> str:
    if code >= 0:
        return "made its parser fail" if code else "made its parser return an invalid answer"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"took its parser more than {seconds:g} seconds" if name == "SIGALRM" else f"crashed its parser ({name})"


def _next_part() -> bytes | None:
    """The next part of standard input, None at its end."""
    header = sys.stdin.buffer.read(8)
    return sys.stdin.buffer.read(int.from_bytes(header, "little")) if header else None


def _serve() -> None:
    """The process: read the request from standard input, then answer for each file."""
    memory, seconds, source, name, arguments = json.loads(_next_part() or b"")
    with contextlib.suppress(ImportError):
        import resource

        for limit, most in (("AS", memory), ("FSIZE", MAX_ANSWER_BYTES), ("CORE", 0)):
            kind = getattr(resource, f"RLIMIT_{limit}")
            hard = resource.getrlimit(kind)[1]
            most = most if hard == resource.RLIM_INFINITY else min(most, hard)
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(kind, (most, most))
    output, sys.stdout = sys.stdout.buffer, sys.stderr  # text that a library prints is not an answer
    function = runpy.run_path(source)[name]
    alarm = getattr(signal, "setitimer", None)
    while (content := _next_part()) is not None:
        if alarm is not None:  # SIGALRM ends the process
            alarm(signal.ITIMER_REAL, seconds)
        answer = io.BytesIO()
        try:
            arrays = function(content, *arguments)
            answer.write(json.dumps({"names": list(arrays)}).encode() + b"\n")
            for array in arrays.values():
                np.lib.format.write_array(answer, np.asarray(array), allow_pickle=False)
        except ImportError:
            raise
        except MemoryError:
            answer = io.BytesIO(json.dumps(f"needs more than {memory} bytes of memory to be read").encode() + b"\n")
        except Exception as error:
            answer = io.BytesIO(json.dumps(str(error)[:300] or type(error).__name__).encode() + b"\n")
        if alarm is not None:
            alarm(signal.ITIMER_REAL, 0)
        output.write(answer.getbuffer())
        output.flush()


if __name__ == "__main__":
    _serve()
