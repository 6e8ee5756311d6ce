"""Ratios against goals, as text: for the terminal and, from the JSON, for the documentation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Rows = list[list[str]]


def median(case: Mapping[str, Any], name: str) -> float | None:
    """Milliseconds of a contender, or None if it did not run."""
    timed = case["times"].get(name)
    return None if timed is None else timed["median_ms"]


def milliseconds(timed: Mapping[str, Any] | None) -> str:
    """Median and half the distance of the quartiles."""
    if timed is None:
        return "—"
    low, high = timed["quartiles_ms"]
    middle = timed["median_ms"]
    digits = 0 if middle >= 100 else 1 if middle >= 10 else 2
    return f"{middle:.{digits}f} ± {(high - low) / 2:.{digits}f}"


def verdict(goal: Mapping[str, Any]) -> list[str]:
    """Ratio, target, and whether it is met."""
    if goal["ratio"] is None:
        return ["—", goal["target_text"], f"not measured: {goal['reason']}"]
    return [f"{goal['ratio']:.2f}", goal["target_text"], "met" if goal["met"] else "**missed**"]


def goal(what: str, ratio: float | None, target: float, at_least: bool, reason: str = "") -> dict[str, Any]:
    """One line of the table of goals."""
    met = None if ratio is None else ratio >= target if at_least else ratio <= target
    return {
        "goal": what,
        "ratio": ratio,
        "target": target,
        "target_text": f"{'at least' if at_least else 'at most'} {target:g}",
        "met": met,
        "reason": reason,
    }


def goal_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Work, comparison, ratio, target, verdict."""
    rows = [["work", "compared", "ratio", "target", ""]]
    for case in cases:
        rows += [[case["case"], found["goal"], *verdict(found)] for found in case.get("goals", [])]
    return rows


def time_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """One row a case, one column a contender that ran in any."""
    names = list(dict.fromkeys(name for case in cases for name in case["times"]))
    return [["work", *names], *([case["case"], *(milliseconds(case["times"].get(n)) for n in names)] for case in cases)]


def memory_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Megabytes above inputs, outputs and gradients, and as a multiple of the output."""
    rows = [["work", "who", "inputs, MB", "output and gradients, MB", "above these, MB", "of the output"]]
    for case in cases:
        for name, taken in case["memory"].items():
            if "left_out" in taken:
                rows.append([case["case"], name, "—", "—", "—", taken["left_out"]])
                continue
            kept = taken["output"] + taken["visible"] + taken["gradients"]
            sizes = [f"{count / 1e6:.1f}" for count in (taken["inputs"], kept, taken["above"])]
            rows.append([case["case"], name, *sizes, f"{taken['above'] / taken['output']:.2f}"])
    return rows


def left_out_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Who did not take part, and why."""
    rows = [["who", "work", "reason"]]
    for case in cases:
        rows += [[name, case["case"], reason] for name, reason in case.get("left_out", {}).items()]
    return rows


def first_call_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Seconds of the first calls of what is compiled, once a process and kind of call."""
    rows = [["work", "who", "first call forward and backward, s"]]
    seen = set()
    for case in cases:
        for name, seconds in case.get("first_call_s", {}).items():
            work = case["case"].rsplit(", ", 1)[0]
            if name.startswith("compiled") and (work, name) not in seen:
                seen.add((work, name))
                rows.append([work, name, f"{seconds:.1f}"])
    return rows


def machine_line(machine: Mapping[str, Any]) -> str:
    """Where and when, in a sentence."""
    return (
        f"{machine['device']}, {machine['cores']} cores, {machine['threads']} threads, {machine['system']}, huge pages "
        f"on {machine['huge_pages']}; lsmgeo {machine['lsmgeo']}, PyTorch {machine['torch']}, kornia "
        f"{machine['kornia']}, Python {machine['python']}; {machine['date']}; load before: {machine['load_before']:.1f}"
    )


def show(rows: Rows, title: str = "") -> None:
    """Print rows as columns."""
    if len(rows) < 2:
        return
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    if title:
        print(f"\n{title}")
    for row in rows:
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip(), flush=True)


def rate_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Work, what was reached, the goal where there is one, and whether it is met."""
    rows = [["work", "median", "slowest to fastest", "goal", ""]]
    for case in cases:
        spread = f"{case['slowest']:.0f} to {case['fastest']:.0f}" if "slowest" in case else "one run"
        target = case.get("target")
        met = "" if target is None else "met" if case["rate"] >= target else "**missed**"
        rows.append(
            [case["case"], f"{case['rate']:.0f} {case['unit']}", spread, f"{target:.0f}" if target else "—", met]
        )
    return rows


def figure_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """Set, figure, what is known of it, what was measured, and the verdict."""
    rows = [["set", "measured", "known", "here", "verdict"]]
    for case in cases:
        known = f"{'at least' if case['at_least'] else 'at most'} {case['known']:g} {case['unit']}"
        here = "—" if case["measured"] is None else f"{case['measured']:.3g} {case['unit']}"
        verdict = case["verdict"] if case["cause"] is None else f"{case['verdict']}: {case['cause']}"
        rows.append([case["set"], case["figure"], known, here if case["reached"] else f"{here} **missed**", verdict])
    return rows


def mistake_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """One row a set, one column a planted mistake: whether it is named, else what is said."""
    planted = list(dict.fromkeys(case["planted"] for case in cases))
    said = {}
    for case in cases:
        named = case["named"] == case["planted"]
        said[case["set"], case["planted"]] = "named" if named else case["named"] or case["verdict"]
    sets = dict.fromkeys(case["set"] for case in cases)
    return [["set", *planted], *([name, *(said.get((name, mistake), "—") for mistake in planted)] for name in sets)]


def reached_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """What of, the figure, what was measured, what it was to reach, and whether it does."""
    said = {True: "reached", False: "**missed**", None: ""}
    rows = [["of", "figure", "measured", "goal", ""]]
    for case in cases:
        for row in case["rows"]:
            rows.append([row["section"], row["what"], row["measured"], row["goal"] or "—", said[row["reached"]]])
    return rows


def model_rows(cases: Sequence[Mapping[str, Any]]) -> Rows:
    """A step of a model with the library's operators and with hand-written ones: times, peaks, and their ratios."""
    timed = [case for case in cases if "times" in case]
    names = list(dict.fromkeys(name for case in timed for name in case["times"]))
    rows = [["step", *(f"{n}, ms" for n in names), "of times", *(f"{n}, peak MB" for n in names), "of peaks"]]
    for case in timed:
        times = [case["times"][name]["median_ms"] for name in names]
        peaks = [case["peak"][name] for name in names]
        known = all(peaks)
        rows.append(
            [
                case["case"],
                *(milliseconds(case["times"][name]) for name in names),
                f"{times[0] / times[1]:.2f}",
                *(f"{peak / 1e6:.0f}" if known else "—" for peak in peaks),
                f"{peaks[0] / peaks[1]:.2f}" if known else "—",
            ]
        )
    return rows
