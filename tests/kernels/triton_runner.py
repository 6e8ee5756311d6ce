"""Run cases in Triton's interpreter: ``TRITON_INTERPRET=1 python -m tests.kernels.triton_runner [names]``.

One line of JSON for each case: its name, what was wrong (empty if nothing), and the seconds it took. A process of its
own, because Triton looks at the variable when it is imported.
"""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch

from lsmgeo.kernels import Options
from lsmgeo.kernels.triton import operators


class Outcome(NamedTuple):
    wrong: str
    seconds: float


def patch_once() -> None:
    """Keep the interpreter from putting its functions into Triton again at each call of a device function.

    It does so for every launch and every call inside; here the process interprets and does nothing else.
    """
    import triton.language as tl
    from triton.runtime import interpreter

    patch, known = interpreter._patch_lang, set()

    def once(function):
        modules = frozenset(
            id(value) for value in function.__globals__.values() if inspect.ismodule(value) and value in (tl, tl.core)
        )
        if modules not in known:
            known.add(modules)
            patch(function)
        return interpreter._LangPatchScope()

    interpreter._patch_lang = once


def run(cases: Mapping[str, Callable[[], None]], names: Iterable[str]) -> None:
    for name in names:
        start = time.perf_counter()
        try:
            cases[name]()
            wrong = ""
        except Exception:
            wrong = traceback.format_exc()
        print(json.dumps([name, wrong, time.perf_counter() - start]), flush=True)


def outcomes(table: str, *names: str, timeout: float = 280.0) -> dict[str, Outcome]:
    """Outcomes of the cases, or faults, of a table in another process."""
    root = Path(__file__).resolve().parents[2]
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "tests.kernels.triton_runner", table, *names],
        cwd=root,
        env={**os.environ, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    lines = [json.loads(line) for line in process.stdout.splitlines() if line.startswith("[")]
    found = {name: Outcome(wrong, seconds) for name, wrong, seconds in lines}
    assert process.returncode == 0, process.stderr[-4000:]
    return found


def main() -> None:
    torch.set_num_threads(1)
    table, *names = sys.argv[1:] or ["cases"]
    if table == "cases":
        from tests.kernels.triton_cases import CASES as chosen
    else:
        from tests.kernels.triton_faults import FAULTS as chosen
    assert operators.why_not("unproject", torch.zeros(1, 1, 1, 2, 2), Options("bilinear")) is None
    assert "triton" not in sys.modules, "Triton is imported before the first launch"
    patch_once()
    run(chosen, names or chosen)


if __name__ == "__main__":
    main()
