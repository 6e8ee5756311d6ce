"""Where a run keeps its checkpoints: ``RUN/checkpoints/step_00000100/{model.safetensors, state.pt, meta.json}``."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["CHECKPOINTS", "WEIGHTS", "checkpoint_folders", "step_folder"]

CHECKPOINTS = "checkpoints"
WEIGHTS = "model.safetensors"

_STEP = re.compile(r"step_(\d{8,18})")


def step_folder(step: int) -> str:
    """The name of a step's checkpoint."""
    return f"step_{step:08d}"


def checkpoint_folders(path: Path) -> dict[int, Path]:
    """The finished checkpoints in a run folder, or in its folder of checkpoints, by step, the newest first.

    Args:
        path: either folder; it need not exist.
    """
    folder = path / CHECKPOINTS if (path / CHECKPOINTS).is_dir() else path
    if not folder.is_dir():
        return {}
    named = {item: _STEP.fullmatch(item.name) for item in folder.iterdir() if item.is_dir()}
    return dict(sorted(((int(match[1]), item) for item, match in named.items() if match), reverse=True))
