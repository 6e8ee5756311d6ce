"""The curve of a training run, for the docs: ``python -m benchmarks.training_curve RUN REPORT``.

RUN is a folder of ``lsmgeo train``, REPORT the ``iou.json`` that ``lsmgeo evaluate RUN --report iou --out ...`` wrote.
What is kept of both goes to ``benchmarks/results/vlsm_compact.json``: "settings" (the configuration), "machine", "log"
(of every evaluation the step, the seconds of training, IoU by the number of views) and "evaluation" (of the model and
of visual hulls, on the test shapes).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import timing

NAME = "vlsm_compact"


def read_log(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The evaluations of a log, each with the seconds of training before it, and the line of its start.

    A run that was resumed repeats steps: the last line of a step counts. Seconds are those of the steps between
    lines, evaluations and checkpoints included: the time on the clock less the time while nothing ran.
    """
    events = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    seconds, before = 0.0, None
    evaluations: dict[int, dict[str, Any]] = {}
    for event in events:
        if event["event"] in ("start", "resume"):
            before = event["time"]
        seconds += event["time"] - before
        before = event["time"]
        if event["event"] == "evaluation":
            measured = {"step": event["step"], "seconds": round(seconds, 1), "iou": event["iou"], "loss": event["loss"]}
            evaluations[event["step"]] = measured
    start = next(event for event in events if event["event"] == "start")
    return [evaluations[step] for step in sorted(evaluations)], start


def keep(run: Path, report: Path) -> dict[str, Any]:
    """What the docs show of a run and of its evaluation."""
    log, start = read_log(run / "log.jsonl")
    found = json.loads(report.read_text(encoding="utf-8"))
    table = next(table for table in found["tables"] if table["key"] == "views")
    rows = {row["name"]: row["values"] for row in table["rows"] if not row["other_data"]}
    errors = {row["name"]: row["standard_errors"] for row in table["rows"] if not row["other_data"]}
    settings = json.loads((run / "config.json").read_text(encoding="utf-8"))
    source = settings["data"]["source"]
    settings["data"]["source"] = Path(source).name  # where it lies says nothing elsewhere
    return {
        "settings": settings,
        "machine": timing.machine("cpu"),
        "parameters": start["parameters"],
        "shapes": start["shapes"],
        "held_back": start["held_back"],
        "log": log,
        "evaluation": {
            "data": found["facts"]["data"].replace(source, Path(source).name),
            "views": [int(view) for view in table["columns"]],
            "iou": rows,
            "standard_errors": errors,
        },
    }


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("report", type=Path)
    parser.add_argument("--out", type=Path, default=timing.RESULTS / f"{NAME}.json")
    options = parser.parse_args(argv)
    kept = keep(options.run, options.report)
    options.out.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    last = kept["log"][-1]
    views = ", ".join(f"{100 * value:.1f} %" for value in last["iou"].values())
    print(f"{options.out}: {len(kept['log'])} evaluations in {last['seconds'] / 60:.0f} minutes; last {views}")


if __name__ == "__main__":
    main()
