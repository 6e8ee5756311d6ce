"""Constructs that must not stand in the library's code: unsafe loading, and arithmetic that is wrong near its limits.

Comments and strings are taken out first, so that the prose may name what the code avoids.
"""

import io
import re
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# (what must not match, in which files, why)
GATES = [
    (r"\bweights_only\s*=\s*False", "**/*.py", "runs code from a checkpoint"),
    (r"\bpickle\.loads?\b", "**/*.py", "runs code from a file"),
    (r"\ballow_pickle\s*=\s*True", "**/*.py", "runs code from a file"),
    (r"\byaml\.(unsafe_)?load\s*\(", "**/*.py", "runs code from a file"),
    (r"\.extractall\s*\((?![^)]*\bfilter\s*=)", "**/*.py", "writes outside the folder: name a filter"),
    (r"\bloadmat\s*\(", "**/*.py", "crashes the process on a damaged file"),
    (r"(?<![.\w])(eval|exec)\s*\(", "**/*.py", "runs text as code"),
    (r"\balign_corners\s*=\s*True", "**/*.py", "moves every sample by up to half a pixel"),
    (
        r"/\s*\([^()]*\+\s*(1e-\d+|eps)\s*\)",
        "**/*.py",
        "a biased division: select a safe divisor first",
    ),
    (r"\bgrid_sample\s*\(", "**/*.py", "only lsmgeo/kernels may know grid_sample"),
    (
        r"\btorch\.(einsum|bmm)\b|\btorch\.linalg\.inv\b",
        "{cameras,kernels}/**/*.py",
        "loses pixels under autocast and TF32",
    ),
    (r"\b(isinstance|issubclass)\s*\(.*,\s*[\w.]+\s*\|", "**/*.py", "not compiled before PyTorch 2.15: use a tuple"),
    (r"\btorch\.broadcast_shapes\b", "**/*.py", "imports sympy: use lsmgeo._checks.check_broadcast"),
]
# Where a construct is at home.
AT_HOME = {
    r"\bgrid_sample\s*\(": ("lsmgeo/kernels/",),
    # Runs in an isolated process, which it may crash.
    r"\bloadmat\s*\(": ("lsmgeo/data/formats/mat_files.py",),
}


def code_only(source: str) -> list[str]:
    """The lines of ``source`` with comments and string contents blanked."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (tokenize.COMMENT, tokenize.STRING):
            continue
        (first, left), (last, right) = token.start, token.end
        for row in range(first, last + 1):
            line = lines[row - 1]
            begin = left if row == first else 0
            end = right if row == last else len(line)
            lines[row - 1] = line[:begin] + " " * (end - begin) + line[end:]
    return lines


def applies(path: str, pattern: str, where: str) -> bool:
    """Whether the gate is for the file ``path``, given relative to the repository with forward slashes."""
    if path.startswith(AT_HOME.get(pattern, ("\0",))):
        return False
    if where.startswith("{"):
        folders = where[1 : where.index("}")].split(",")
        return path.startswith(tuple(f"lsmgeo/{folder}/" for folder in folders))
    return True


def violations(path: str, source: str) -> list[str]:
    """One line of text for each banned construct in ``source``."""
    return [
        f"{path}:{number}: {why}: {line.strip()}"
        for number, line in enumerate(code_only(source), start=1)
        for pattern, where, why in GATES
        if applies(path, pattern, where) and re.search(pattern, line)
    ]


def main() -> int:
    """Check every module of the library; print what is found."""
    files = sorted((ROOT / "lsmgeo").rglob("*.py"))
    if not files:
        print("no library files found", file=sys.stderr)
        return 1
    found = [
        text
        for file in files
        for text in violations(file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8"))
    ]
    print("\n".join(found) or f"static gates: {len(files)} files clean")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
