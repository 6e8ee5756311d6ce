"""Parsers of other people that a damaged file can crash, run where that does no harm: in a process of their own."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
from typing import IO, TYPE_CHECKING

from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["run_guarded"]

# Runs before the worker has seen a byte. In the child rather than between fork and exec, where a thread of the parent
# may hold a lock for ever. Libraries are compiled beforehand or not at all: no file may be written.
LIMITS = """
import contextlib, runpy, sys
memory, seconds, worker = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
try:
    import resource
except ImportError:
    resource = None
if resource is not None:
    for name, most in (("AS", memory), ("CPU", seconds), ("FSIZE", 0), ("CORE", 0)):
        kind = getattr(resource, "RLIMIT_" + name)
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (most, most))
try:
    runpy.run_path(worker, run_name="__main__")
    sys.stdout.flush()
except MemoryError:
    sys.exit(%d)
"""
OUT_OF_MEMORY = 86
PIECE = 1 << 16


def run_guarded(
    worker: Path, content: bytes, *, memory: int, seconds: float, path: Path, answer: int = 1 << 26
) -> bytes:
    """Run a worker script on bytes that may crash it, and return what it answers.

    The script runs in an isolated interpreter of its own (``python -I``), reads ``content`` from standard input and
    writes its answer to standard output. It gets so much memory and time, writes no file and leaves no core dump;
    systems without POSIX limits keep the time alone. Its answer comes from a process that hostile bytes may have taken
    over: the caller checks it as it would check a file, and takes no pickle.

    Args:
        worker: a script; it should import little, since every call starts it anew.
        content: what it gets.
        memory: address space in bytes, libraries included.
        seconds: what it may take, on the clock and on the processor.
        path: the file that the bytes come from, for errors.
        answer: the most bytes that it may answer.

    Returns:
        The answer.

    Raises:
        DataError: the worker crashed, failed, took too long, needed more memory or answered too much.
    """
    limits = LIMITS % OUT_OF_MEMORY
    command = [sys.executable, "-I", "-B", "-c", limits, str(memory), str(math.ceil(seconds)), str(worker)]
    # Threads of linear algebra reserve address space for nothing.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        )
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read: no process could be started for it ({error})") from error
    received = bytearray()
    streams = (
        threading.Thread(target=_feed, args=(process.stdin, content), daemon=True),
        threading.Thread(target=_listen, args=(process, received, answer), daemon=True),
    )
    try:
        for stream in streams:
            stream.start()
        code = process.wait(seconds)
    except subprocess.TimeoutExpired as error:
        raise DataError(path, f"took its parser more than {seconds:g} seconds") from error
    finally:
        process.kill()
        process.wait()
        for stream in streams:
            stream.join(1.0)
    if len(received) > answer:
        raise DataError(path, f"holds more than the {answer} bytes that are taken from it")
    if code != 0:
        raise DataError(path, _reason(code, memory, seconds))
    return bytes(received)


def _feed(pipe: IO[bytes] | None, content: bytes) -> None:
    if pipe is not None:
        with contextlib.suppress(OSError, ValueError), pipe:  # a worker that ended does not listen
            pipe.write(content)


def _listen(process: subprocess.Popen[bytes], received: bytearray, most: int) -> None:
    """Take what the worker says, and end it when it does not stop."""
    if process.stdout is None:
        return
    with contextlib.suppress(OSError, ValueError), process.stdout as pipe:
        while piece := os.read(pipe.fileno(), PIECE):
            received += piece
            if len(received) > most:
                process.kill()
                return


def _reason(code: int, memory: int, seconds: float) -> str:
    if code == OUT_OF_MEMORY:
        return f"needs more than {memory} bytes of memory to be read"
    if code > 0:
        return "made its parser fail"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    if name in ("SIGXCPU", "SIGKILL"):
        return f"took its parser more than {seconds:g} seconds, or the system ended it ({name})"
    return f"crashed its parser ({name})"
