"""Ways to go wrong on purpose: processes that are killed, disks that fill, files that are damaged."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

# What the protocol of a save asks of the system.
CALLS = ("mkdir", "open", "write", "fsync", "close", "replace", "unlink", "rmdir")


def in_child(work: Callable[[], object], *, timeout: float = 120.0, quiet: bool = True) -> int:
    """Run ``work`` in a forked process, since importing torch takes seconds.

    Returns its exit code: minus the signal's number if one killed it, 1 if ``work`` raised.
    """
    child = start(work, quiet=quiet)
    return wait(child, timeout=timeout)


def start(work: Callable[[], object], *, quiet: bool = True) -> int:
    """The number of a forked process that runs ``work``."""
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, which the child has none of
        child = os.fork()
    if child:
        return child
    code = 1
    try:
        if quiet:
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
        work()
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def wait(child: int, *, timeout: float = 120.0) -> int:
    """The exit code of a process that `start` started; one that never ends is killed."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise TimeoutError(f"the process hung for {timeout} s")


def in_processes(work: Callable[[int], object], count: int = 2) -> list[int]:
    """The exit codes of processes as `torchrun` starts them, each of which does the work."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def begin(rank: int) -> None:
        names = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count}
        os.environ |= {name: str(value) for name, value in names.items()}
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"}
        work(rank)

    children = [start(lambda rank=rank: begin(rank)) for rank in range(count)]
    return [wait(child) for child in children]


class Points:
    """The moments before each call to the system within `counted`, at one of which something happens.

    Args:
        act: what happens, given the call's name; it may raise, or not come back.
        at: at which call, from 0; None only counts.
    """

    def __init__(self, act: Callable[[str], None] | None = None, at: int | None = None) -> None:
        self.act, self.at, self.calls = act, at, []

    @contextlib.contextmanager
    def counted(self) -> Iterator[Points]:
        before = {name: getattr(os, name) for name in CALLS}
        for name, function in before.items():
            setattr(os, name, self._wrapped(name, function))
        try:
            yield self
        finally:
            for name, function in before.items():
                setattr(os, name, function)

    def _wrapped(self, name: str, function: Callable) -> Callable:
        def run(*arguments, **options):
            self.calls.append(name)
            if len(self.calls) - 1 == self.at:
                if name == "write":  # a torn write
                    function(arguments[0], arguments[1][: len(arguments[1]) // 2])
                self.act(name)
            return function(*arguments, **options)

        return run


def kill(_: str) -> None:
    """As by a loss of power, or by whoever needs the memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def fill(_: str) -> None:
    """As by a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def leftovers(folder: Path) -> list[str]:
    """What does not belong into a run's folder of checkpoints."""
    return sorted(item.name for item in folder.iterdir() if ".tmp" in item.name or ".old-" in item.name)
