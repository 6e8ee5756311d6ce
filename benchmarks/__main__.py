"""All benchmarks: ``python -m benchmarks``; with ``--quick``, whether they work."""

import sys
import time

from benchmarks import footprint, growth, imports, models, operators, systems

if __name__ == "__main__":
    started = time.perf_counter()
    for module in (operators, footprint, systems, growth, models):
        module.main(sys.argv[1:])
    if "--quick" not in sys.argv:
        imports.main([])
    print(f"{(time.perf_counter() - started) / 60:.1f} minutes")
