"""Being asked to stop: a signal sets a flag, and training ends where nothing is lost."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import TypeVar

__all__ = ["StopRequest", "catch_stop", "ignore_stop"]

Item = TypeVar("Item")


class StopRequest:
    """Whether somebody asked this process to stop; made by `catch_stop`."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._waiting = False

    def __bool__(self) -> bool:
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """What the process should end with: 128 plus the signal's number, 143 for SIGTERM; 0 if none came."""
        return 0 if self.signal is None else 128 + self.signal

    def next_item(self, items: Iterator[Item]) -> Item | None:
        """The next of ``items``, or None as soon as a stop is asked for, however long the item would take.

        The iterator may be broken after None: leave it alone.

        Args:
            items: for example a loader's iterator.

        Raises:
            StopIteration: as ``next``.
        """
        try:
            try:
                # Set first, so that a signal that comes between the two lines is seen by one of them.
                self._waiting = True
                return None if self else next(items)
            finally:
                self._waiting = False
        except _Asked:
            return None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal == number:
            # Whoever asks twice does not want to wait; a checkpoint cut off here is as after a loss of power.
            os._exit(128 + number)
        if self:  # Ctrl-C reaches torchrun too, which then sends its processes SIGTERM
            return
        self.signal = number
        if self._waiting:
            self._waiting = False
            raise _Asked


class _Asked(BaseException):
    """Leaves a wait for data; no handler of ordinary errors on the way may swallow it."""


@contextlib.contextmanager
def catch_stop() -> Iterator[StopRequest]:
    """Inside this context the first SIGTERM or SIGINT only sets a flag; the same again ends the process at once.

    The flag is to be looked at wherever training spends time: between steps, between the batches of an evaluation,
    after a checkpoint, and while waiting for data (`StopRequest.next_item`). The handlers from before come back at the
    end. Outside the main thread, where Python allows no handlers, the flag stays unset.

    Yields:
        The flag; it is true once a signal has come.

    Example:
        >>> with catch_stop() as stop:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        ...     bool(stop), stop.exit_code
        (True, 143)
    """
    request = StopRequest()
    before = {}
    try:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                before[number] = signal.signal(number, request._handle)
        yield request
    finally:
        for number, handler in before.items():
            # None: a handler that was not set from Python cannot be set back from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def ignore_stop(worker: int = 0) -> None:
    """Make a loader's worker deaf to SIGTERM and SIGINT: it ends with its parent, which has work to save first.

    Args:
        worker: the worker's number, unused; so that this is a ``worker_init_fn``.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
