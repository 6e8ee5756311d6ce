"""The log of a run: lines of JSON, TensorBoard, images of predictions, a progress bar."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lsmgeo.data.atomic_files import write_atomic
from lsmgeo.data.images import encode_png
from lsmgeo.drawing import Pixels
from lsmgeo.errors import DataError
from lsmgeo.training.config import RunConfig
from lsmgeo.training.example_figures import draw_examples
from lsmgeo.training.validation import Evaluation

__all__ = ["RunLog"]

LOG = "log.jsonl"
SECONDS_BETWEEN_LINES = 30.0


class RunLog:
    """The log of a run, written by its first process only.

    A full disk does not end the run: the first line that cannot be written gives a warning, and later lines are tried.

    Args:
        folder: the run's folder.
        run: has the number of steps, and whether to write for TensorBoard.
        step: where the run begins or is resumed; TensorBoard's curves of later steps are replaced.
        is_writer: whether this process writes.
        quiet: whether to show no progress.
    """

    def __init__(self, folder: Path, run: RunConfig, *, step: int, is_writer: bool = True, quiet: bool = False) -> None:
        self.folder, self.is_writer = folder, is_writer
        self._warned: set[str] = set()
        self._shown = time.monotonic()
        self._board = self._open_board(step) if is_writer and run.tensorboard else None
        self._bar: Any = None
        self._prints = is_writer and not quiet
        if self._prints and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=run.steps, initial=step, unit="step", dynamic_ncols=True, smoothing=0.05)

    def close(self) -> None:
        """Close the progress bar and TensorBoard's files."""
        if self._bar is not None:
            self._bar.close()
        if self._board is not None:
            with contextlib.suppress(OSError):
                self._board.close()

    def event(self, name: str, **values: Any) -> None:
        """Append a line of JSON; numbers that are not finite become text."""
        if not self.is_writer:
            return
        line = json.dumps({"event": name, **_plain(values), "time": round(time.time(), 3)}, allow_nan=False)
        try:
            _append_line(self.folder / LOG, line.encode())
        except OSError as error:
            self._warn(LOG, f"{self.folder / LOG}: cannot be written ({error}); the run continues")

    def step(self, step: int, *, waited: float, **values: float) -> None:
        """Log a step and its curves: seconds `waited` for data, loss, learning rate, ..."""
        self.event("step", step=step, **values, waited=_short(waited))
        self.scalars(step, {f"train/{name}": value for name, value in values.items()})

    def evaluation(self, step: int, found: Evaluation, *, seconds: float, best: int | None) -> None:
        """Log an evaluation, its curves and image; `best` is the step of the best so far."""
        self.event("evaluation", step=step, **found.fields(), evaluation_seconds=_short(seconds), best=best)
        by_view = {f"{found.measure}/{view}_views": value for view, value in found.by_view.items()}
        by_category = {f"{found.measure}_by_category/{name}": value for name, value in found.categories.items()}
        self.scalars(step, {"loss/held_back": found.loss, **by_view, **by_category})
        self.say(f"step {step}: {found.title} {found.words}")
        if found.examples and self.is_writer:
            self.image(step, draw_examples(found.examples))

    def plan(self, steps: int) -> None:
        """Log the planned number of steps."""
        self.event("plan", steps=steps)
        self.say(f"{steps} steps fill the CPU minutes")
        if self._bar is not None:
            self._bar.total = steps

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Curves for TensorBoard."""
        if self._board is not None:
            with self._warn_of_errors():
                for name, value in values.items():
                    self._board.add_scalar(name, value, step)

    def image(self, step: int, image: Pixels) -> None:
        """Predictions (h, w, 3): for TensorBoard, and as ``pictures/predicted_STEP.png``."""
        try:
            write_atomic(self.folder / "pictures" / f"predicted_{step:08d}.png", encode_png(image))
        except DataError as error:
            self._warn("pictures", f"{error}; the run continues")
        if self._board is not None:
            with self._warn_of_errors():
                self._board.add_image("predicted", image, step, dataformats="HWC")

    def progress(self, step: int, text: str) -> None:
        """Show the progress: in the bar of a terminal, elsewhere a line every half minute."""
        if self._bar is not None:
            self._bar.update(step - self._bar.n)
            self._bar.set_postfix_str(text, refresh=False)
        elif self._prints and time.monotonic() - self._shown >= SECONDS_BETWEEN_LINES:
            self._shown = time.monotonic()
            print(f"step {step}: {text}", file=sys.stderr, flush=True)

    def say(self, text: str) -> None:
        """Print a line."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        elif self._prints:
            print(text, file=sys.stderr, flush=True)

    def _open_board(self, step: int) -> Any:
        try:
            from torch.utils.tensorboard import SummaryWriter

            return SummaryWriter(str(self.folder / "tensorboard"), purge_step=step or None)
        except ImportError:
            warnings.warn("tensorboard is not installed: only log.jsonl and pictures are written", stacklevel=3)
        except OSError as error:
            self._warn("tensorboard", f"TensorBoard's files cannot be written ({error}); the run continues")
        return None

    @contextlib.contextmanager
    def _warn_of_errors(self) -> Any:
        try:
            yield
        # Its writer is a thread, whose errors are raised by a later call.
        except (OSError, RuntimeError) as error:
            self._board = None
            self._warn("tensorboard", f"TensorBoard's files cannot be written ({error}); the run continues without")

    def _warn(self, what: str, message: str) -> None:
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(message, stacklevel=3)


def _append_line(path: Path, line: bytes) -> None:
    """Append a whole line, or raise and leave the file unchanged."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        size = os.fstat(descriptor).st_size
        # A loss of power may have left half a line.
        begin = b"\n" if size and os.pread(descriptor, 1, size - 1) != b"\n" else b""
        content = begin + line + b"\n"
        if os.write(descriptor, content) < len(content):  # the disk is full
            os.ftruncate(descriptor, size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(descriptor)


def _short(value: float) -> float:
    """A time rounded to six digits."""
    return float(f"{value:.6g}")


def _plain(value: Any) -> Any:
    """A value in JSON types."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)
