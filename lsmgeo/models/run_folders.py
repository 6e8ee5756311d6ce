"""Where a run keeps its checkpoints: ``RUN/checkpoints/step_00000100/{model.safetensors, state.pt, meta.json}``."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["CHECKPOINTS", "WEIGHTS", "checkpoint_folders", "step_folder"]

CHECKPOINTS = "checkpoints"
WEIGHTS = "model.safetensors"

# ".old": a checkpoint that was about to be replaced when the process was killed.
_STEP = re.compile(r"step_(\d{8,18})(\.old-\d+)?")


def step_folder(step: int) -> str:
    """The name of a step's checkpoint.

    Args:
        step: its number.

    Example:
        >>> step_folder(100)
        'step_00000100'
    """
    return f"step_{step:08d}"


def checkpoint_folders(path: Path) -> dict[int, Path]:
    """The finished checkpoints in a run folder, or in its folder of checkpoints, by step, the newest first.

    Args:
        path: either folder; it need not exist.
    """
    folder = path / CHECKPOINTS if (path / CHECKPOINTS).is_dir() else path
    if not folder.is_dir():
        return {}
    found: dict[int, Path] = {}
    # The longer names first: a checkpoint wins over the one that it replaces.
    for item in sorted(folder.iterdir(), key=lambda item: -len(item.name)):
        match = _STEP.fullmatch(item.name)
        if match and item.is_dir():
            found[int(match[1])] = item
    return dict(sorted(found.items(), reverse=True))
