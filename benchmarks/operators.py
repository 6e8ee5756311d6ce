"""The operators against hand-written and compiled PyTorch, and the floor: ``python -m benchmarks.operators``.

All contenders of a case run in turn in one process; the tables show medians, half the distance of the quartiles, and
the ratios that the library promises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks import contenders as who
from benchmarks import report
from benchmarks.measure import timings
from benchmarks.problems import Problem
from benchmarks.settings import Settings, parse

UNPROJECT = Problem("unproject")
SWEEP = Problem("sweep", size=56)

# label, problem, rounds' seconds, (forward: hand-written, floor, kernel), (both: hand-written, kernel)
WORK = (
    ("Unproject", UNPROJECT, 6.0, (3.0, 1.6, 5.0), (6.0, 10.0)),
    ("Unproject, mean", UNPROJECT.but(statistic="mean"), 8.0, None, (7.0, 12.0)),
    ("Unproject, variance", UNPROJECT.but(statistic="variance"), 8.0, None, (7.0, 12.0)),
    ("Sweep, trilinear", SWEEP, 20.0, (10.0, 1.6, 20.0), (10.0, 16.0)),
    ("Sweep, nearest", SWEEP.but(mode="nearest"), 20.0, (10.0, 1.6, 20.0), (10.0, 16.0)),
    ("Sweep, trilinear, flattened", SWEEP.but(flatten=True), 20.0, (10.0, 1.6, 20.0), (10.0, 16.0)),
    ("Sweep, nearest, flattened", SWEEP.but(mode="nearest", flatten=True), 20.0, (10.0, 1.6, 20.0), (10.0, 16.0)),
)
COPIED = ("Unproject", "Unproject, variance", "Sweep, trilinear")  # also from sources in contiguous memory
REFERENCE_TARGETS = {"forward": 1.25, "forward+backward": 1.15}


def ratio(case: dict[str, Any], top: str, bottom: str) -> tuple[float | None, str]:
    """Of two medians; or why there is none."""
    above, below = report.median(case, top), report.median(case, bottom)
    if above is not None and below is not None:
        return above / below, ""
    missing = top if above is None else bottom
    return None, case["left_out"].get(missing, f"{missing} did not run")


def goals(case: dict[str, Any], forward: tuple[float, ...] | None, both: tuple[float, ...]) -> list[dict[str, Any]]:
    """What the library promises of a case."""
    promised = [(who.COMPILED, who.OURS, 1.0, True)]
    if case["kind"] == "forward":
        if forward is not None:
            promised += [
                (who.HAND, who.OURS, forward[0], True),
                (who.OURS, who.COLD, forward[1], False),
                (who.HAND, who.KERNEL, forward[2], True),
            ]
    else:
        promised += [(who.HAND, who.OURS, both[0], True), (who.HAND, who.KERNEL, both[1], True)]
    if who.REFERENCE in case["times"]:
        promised.append((who.REFERENCE, who.HAND, REFERENCE_TARGETS[case["kind"]], False))
    found = []
    for top, bottom, target, at_least in promised:
        value, reason = ratio(case, top, bottom)
        found.append(report.goal(f"{top} : {bottom}", value, target, at_least, reason))
    return found


def table(settings: Settings, layout: str) -> list[dict[str, Any]]:
    """All work with sources in one memory layout."""
    cases = []
    for label, problem, seconds, forward, both in WORK:
        if layout == "contiguous" and label not in COPIED:
            continue
        names = [who.OURS, who.HAND, who.COMPILED]
        if label == "Unproject":
            names += [who.REFERENCE]
            names += [who.AUTOMATIC] if layout == "channels_last" else []
        made = timings(
            label,
            settings.sized(problem.but(layout=layout)),
            settings.names(*names),
            floors=True,
            kernels=True,
            repeats=settings.repeats,
            budget=seconds,
        )
        for case in made:
            if layout == "channels_last":
                case["goals"] = goals(case, forward, both)
        cases += made
    return cases


def main(argv: Sequence[str] | None = None) -> None:
    settings = parse(__doc__, argv)
    for layout in ("channels_last", "contiguous"):
        cases = table(settings, layout)
        print(f"\nSources in {layout.replace('_', '-')} memory; milliseconds")
        report.show(report.time_rows(cases))
        report.show(report.goal_rows(cases))
        report.show(report.left_out_rows(cases), "left out")
        settings.save(f"operators_{layout}", cases)


if __name__ == "__main__":
    main()
