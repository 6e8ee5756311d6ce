"""Which revision of the code made a checkpoint."""

from __future__ import annotations

import functools
from pathlib import Path

import lsmgeo

__all__ = ["code_revision"]


@functools.cache
def code_revision() -> str | None:
    """The commit of the checkout that the library is imported from, or None if it is installed without one.

    Read from git's files: a program started in the middle of a training run would copy the process.
    """
    git = Path(lsmgeo.__file__).parents[1] / ".git"
    try:
        if git.is_file():
            git = (git.parent / git.read_text().removeprefix("gitdir:").strip()).resolve()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref:"):
            return head[:64]
        name = head.removeprefix("ref:").strip()
        shared = git / "commondir"
        roots = [git, (git / shared.read_text().strip()).resolve()] if shared.is_file() else [git]
        for root in roots:
            if (root / name).is_file():
                return (root / name).read_text().strip()[:64]
        for line in (roots[-1] / "packed-refs").read_text().splitlines():
            if line.endswith(f" {name}"):
                return line.split()[0]
    except (OSError, UnicodeDecodeError):
        return None
    return None
