"""The results of finished runs: a JSON file each, and the weights that ship. The same run gives the same file."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lsmgeo.models
from benchmarks import measuring
from benchmarks.experiments.queue import ALL, SET, SHAPES, Experiment
from benchmarks.experiments.running import EVALUATION, RECIPE, WEIGHTS, Folder
from lsmgeo.data import write_atomic

__all__ = ["PRETRAINED", "RESULTS", "collect", "headline"]

RESULTS = measuring.RESULTS / "experiments"
PRETRAINED = Path(lsmgeo.models.__file__).parent / "pretrained"


def collect(folder: Folder) -> list[Path]:
    """Write the results of all finished runs, to be committed, and return the files' paths."""
    written = []
    for experiment in ALL:
        if folder.is_done(experiment):
            kept = keep(experiment, folder)
            path = RESULTS / f"{experiment.name}.json"
            written.append(write_atomic(path, (json.dumps(kept, indent=1) + "\n").encode()))
            weights = folder.run(experiment) / WEIGHTS
            if experiment.ships:
                name = f"{experiment.model}-{experiment.preset}.safetensors"
                written.append(write_atomic(PRETRAINED / name, weights.read_bytes()))
            if not RECIPE.is_file():
                recipe = {"source": "synthetic-13", "shapes": SHAPES, **SET._asdict(), "sha256": kept["set"]}
                written.append(write_atomic(RECIPE, (json.dumps(recipe, indent=1) + "\n").encode()))
    return written


def keep(experiment: Experiment, folder: Folder) -> dict[str, Any]:
    """The results of a finished run."""
    path = folder.run(experiment)
    config = json.loads((path / "config.json").read_text(encoding="utf-8"))
    config["data"]["source"] = "set"  # its path means nothing on another machine
    log, start = read_log(path / "log.jsonl")
    return {
        **{key: getattr(experiment, key) for key in ("what", "minutes", "ships", "is_tested")},
        **json.loads((path / EVALUATION).read_text(encoding="utf-8")),
        "configuration": config,
        "shapes": start["shapes"],
        "held_back": start["held_back"],
        "curve": log,
    }


def read_log(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The evaluations of a log, and the line of its start. A resumed run repeats steps: the last line counts."""
    events = []
    for line in path.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(json.JSONDecodeError):  # a loss of power leaves half a line
            events.append(json.loads(line))
    evaluations = {
        event["step"]: {key: number(event[key]) for key in ("step", "iou", "depth_error", "loss") if key in event}
        for event in events
        if event["event"] == "evaluation"
    }
    start = next(event for event in events if event["event"] == "start")
    return [evaluations[step] for step in sorted(evaluations)], start


def number(value: Any) -> Any:
    """A number of the log, or a mapping of numbers; None for those that are not finite, which the log has as text."""
    if isinstance(value, dict):
        return {key: number(item) for key, item in value.items()}
    return None if isinstance(value, str) else value


def headline(kept: dict[str, Any]) -> str:
    """The result of a run in a few words: its measure by the number of views."""
    found, last = kept["evaluation"], kept["curve"][-1]
    if "iou" in found:
        return "test IoU " + shown(next(iter(found["iou"].values())))
    if "depth_error" in found:
        errors = {views: one["mean"] for views, one in found["depth_error"].items()}
        return f"test depth error {shown(errors.values(), 4)} ({', '.join(errors)} views)"
    if "iou" in last:
        return "validation IoU " + shown(None if value is None else 100 * value for value in last["iou"].values())
    return "validation depth error " + shown(last["depth_error"].values(), 4)


def shown(values: Iterable[float | None], digits: int = 1) -> str:
    """Numbers with spaces between."""
    return " ".join("-" if value is None else f"{value:.{digits}f}" for value in values)
