"""Print which laws notice which fault; fail if one goes unnoticed or a law fails without any."""

from __future__ import annotations

import functools
import sys
import time

import torch

from tests.mutants.faults import FAULTS
from tests.mutants.laws import LAWS, Law
from tests.mutants.patching import reference_alone


def broken_by(law: Law) -> bool:
    """Whether the law fails just now, by its own assertion or by an error."""
    try:
        with reference_alone():
            law.check()
    except Exception:
        return True
    return False


@functools.cache
def sound_laws() -> tuple[Law, ...]:
    """The laws that hold without a fault: one that fails anyway notices nothing."""
    return tuple(law for law in LAWS if not broken_by(law))


def notices(name: str, every: bool = False) -> list[str]:
    """The laws that notice a fault: all of them, or the first."""
    found = []
    laws = sound_laws()
    with FAULTS[name]():
        for law in laws:
            if broken_by(law):
                found.append(law.name)
                if not every:
                    break
    return found


def main() -> int:
    torch.set_num_threads(1)
    every = "--all" in sys.argv[1:]
    start = time.perf_counter()
    false_alarms = [law.name for law in LAWS if law not in sound_laws()]
    unnoticed = []
    width = max(map(len, FAULTS))
    for name in FAULTS:
        found = notices(name, every)
        text = f"{len(found)} of {len(LAWS)} laws: {'; '.join(found)}" if every else (found or ["NOT NOTICED"])[0]
        print(f"{name:<{width}}  {text}", flush=True)
        if not found:
            unnoticed.append(name)
    print(f"\n{len(FAULTS) - len(unnoticed)} of {len(FAULTS)} faults noticed, in {time.perf_counter() - start:.0f} s")
    print(f"laws that fail without a fault: {'; '.join(false_alarms) or 'none'}")
    return int(bool(unnoticed or false_alarms))


if __name__ == "__main__":
    sys.exit(main())
