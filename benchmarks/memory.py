"""Peak memory of a call, above what was there before it: ``python -m benchmarks.memory``.

On a CPU each measurement has a process of its own, forked from one that has everything imported. Linux keeps the
high-water mark of a process's resident memory (VmHWM) and sets it back on request; what a call adds to it is the peak.
Allocators are emptied first, so that no freed block of the warm-up is used unseen. On a GPU PyTorch counts.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks import contenders, gate, timing
from benchmarks.problems import LeftOut, Problem, Scene

STATUS, REFERENCES = Path("/proc/self/status"), Path("/proc/self/clear_refs")
KINDS = ("forward", "forward+backward")


def can_measure(device: str = "cpu") -> bool:
    """Whether this system tells the peak of a process."""
    return device == "cuda" or (STATUS.is_file() and os.access(REFERENCES, os.W_OK))


def _status(key: str) -> int:
    line = next(line for line in STATUS.read_text(encoding="ascii").splitlines() if line.startswith(key + ":"))
    return int(line.split()[1]) * 1024


def _give_back() -> None:
    """Return freed memory to the system, so that resident is what is in use."""
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError):
        pass  # not glibc: the peak may come out too small by what the warm-up left


def peak(run: Callable[[], Any], device: str = "cpu") -> int:
    """Bytes that a call takes at its peak above those in use before it."""
    run()  # pools, caches and code of the first call are not counted
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        result = run()
        torch.cuda.synchronize()
        del result
        return torch.cuda.max_memory_allocated() - before
    _give_back()
    before = _status("VmRSS")
    REFERENCES.write_text("5", encoding="ascii")
    result = run()
    highest = _status("VmHWM")
    del result
    return highest - before


def _measure(problem: Problem, name: str, kind: str, threads: int) -> dict[str, Any]:
    """In a process of its own: the peak of one contender, and the bytes of what it returns."""
    torch.set_num_threads(threads)
    scene = Scene(problem)
    try:
        run = contenders.CONTENDERS[name](scene)
    except LeftOut as reason:
        return {"left_out": str(reason)}
    inputs = gate.leaves(scene)
    with torch.no_grad():
        output, visible = run(inputs[0])
    cotangent = scene.cotangent(output) if kind == "forward+backward" else None
    kept = {"output": output.nbytes, "visible": 0 if visible is None else visible.nbytes, "gradients": 0}
    del output, visible

    def forward() -> Any:
        with torch.no_grad():
            return run(inputs[0])

    def both() -> Any:
        output, visible = run(inputs[0])
        return output, visible, torch.autograd.grad(output, inputs, cotangent)

    if kind == "forward+backward":
        kept["gradients"] = sum(leaf.nbytes for leaf in inputs)
    measured = peak(both if kind == "forward+backward" else forward, problem.device)
    needed = sum(kept.values())
    return {**kept, "inputs": sum(leaf.nbytes for leaf in inputs), "peak": measured, "above": measured - needed}


def _measured(*arguments: Any) -> dict[str, Any]:
    try:
        return _measure(*arguments)
    except MemoryError:
        return {"left_out": "no memory"}


def _answer(connection: Any, function: Callable[..., Any], *arguments: Any) -> None:
    connection.send(function(*arguments))


def alone(function: Callable[..., Any], *arguments: Any, limit: float = 300.0) -> Any:
    """What a function of a module answers in a process of its own.

    Raises:
        TimeoutError: not within `limit` seconds.
        EOFError: it ended without an answer.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.memory"])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, function, *arguments), daemon=True)
    process.start()
    sender.close()
    try:
        if not receiver.poll(limit):
            raise TimeoutError(f"took more than {limit:.0f} s")
        return receiver.recv()
    finally:
        process.join(10)
        if process.is_alive():
            process.terminate()
            process.join()
        receiver.close()


def measure(problem: Problem, name: str, kind: str, threads: int = 2, limit: float = 300.0) -> dict[str, Any]:
    """Peak memory of one contender.

    Returns:
        Bytes: "peak" above the inputs, and "above" that less output, visibility and gradients; or "left_out".
    """
    if problem.device == "cuda":
        return _measure(problem, name, kind, threads)
    if not can_measure():
        return {"left_out": "this system tells no peak"}
    try:
        return alone(_measured, problem, name, kind, threads, limit=limit)
    except TimeoutError as error:
        return {"left_out": str(error)}
    except EOFError:
        return {"left_out": "ended early, most likely out of memory"}


def known(count: int) -> int:
    """The measured peak of a call that allocates so many bytes, for a check of the method."""
    return peak(lambda: torch.empty(count // 4, dtype=torch.float32).fill_(1.0))


def main() -> None:
    timing.table(
        [{"allocated": f"{mega} MB", "measured": known(mega * 10**6) / 1e6} for mega in (5, 50, 500)],
        {"allocated": "", "measured": ".2f"},
    )


if __name__ == "__main__":
    main()
