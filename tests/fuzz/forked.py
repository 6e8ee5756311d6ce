"""Cases in child processes: one that kills its process, or never ends, is an outcome like any other.

Children are forked from the running interpreter, because importing torch takes seconds; each runs a batch and reports
case by case, so that the case that killed it is known. The rest of its batch goes to the next child.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import select
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

Case = TypeVar("Case")
MEMORY = 2 << 30  # bytes that a child may take beyond its parent's


def outcomes(cases: Sequence[Case], judge: Callable[[Case], str], timeout: float = 20.0, batch: int = 500) -> list[str]:
    """What `judge` says of each case, one line of text; "killed by signal N" or "hangs" where it did not come to it."""
    results: list[str] = []
    while len(results) < len(cases):
        results += _batch(cases[len(results) : len(results) + batch], judge, timeout)
    return results


def _batch(cases: Sequence[Case], judge: Callable[[Case], str], timeout: float) -> list[str]:
    """Outcomes of the first cases, at least one: up to the one at which the child died."""
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, which the child has none of
        child = os.fork()
    if child == 0:
        _run(cases, judge, reader, writer)
    os.close(writer)
    text, deadline, hangs = "", time.monotonic() + timeout, False
    while True:
        ready, _, _ = select.select([reader], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            hangs = True
            os.kill(child, signal.SIGKILL)
            break
        received = os.read(reader, 1 << 16)
        if not received:
            break
        text += received.decode()
        if "\n" in text[-len(received) :]:
            deadline = time.monotonic() + timeout
    os.close(reader)
    _, status = os.waitpid(child, 0)
    finished = text.split("\n")[:-1]
    if len(finished) < len(cases):
        finished.append("hangs" if hangs else f"killed by signal {os.WTERMSIG(status)}, exit {os.WEXITSTATUS(status)}")
    return finished


def _run(cases: Sequence[Case], judge: Callable[[Case], str], reader: int, writer: int) -> None:
    """The child's life; does not return."""
    try:
        os.close(reader)
        faulthandler.disable()  # the outcome says it
        with open("/proc/self/statm") as file:
            used = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for case in cases:
            line = judge(case).replace("\n", " ") + "\n"
            os.write(writer, line.encode())
    finally:
        os._exit(0)
