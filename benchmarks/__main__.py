"""All benchmarks: ``python -m benchmarks``."""

from benchmarks import imports, operators

if __name__ == "__main__":
    operators.main([])
    imports.main([])
