"""Cases as tables of text, for the terminal and, from the JSON, for the documentation; each table selects its cases."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import truediv
from typing import Any

Rows = list[list[str]]
Cases = Sequence[Mapping[str, Any]]


def milliseconds(timed: Mapping[str, Any] | None) -> str:
    """Median and half the distance of the quartiles."""
    if timed is None:
        return "—"
    low, high = timed["quartiles_ms"]
    middle = timed["median_ms"]
    digits = 0 if middle >= 100 else 1 if middle >= 10 else 2
    return f"{middle:.{digits}f} ± {(high - low) / 2:.{digits}f}"


def goal(what: str, ratio: float | None, target: float, at_least: bool, reason: str = "") -> dict[str, Any]:
    """One line of the table of goals."""
    met = None if ratio is None else ratio >= target if at_least else ratio <= target
    text = f"{'at least' if at_least else 'at most'} {target:g}"
    return {"goal": what, "ratio": ratio, "target": target, "target_text": text, "met": met, "reason": reason}


def ratio(case: Mapping[str, Any], top: str, bottom: str, target: float, at_least: bool = True) -> dict[str, Any]:
    """A line about the ratio of two medians; without one it says why."""
    for name in (top, bottom):
        if name not in case["times"]:
            reason = case["left_out"].get(name, f"{name} did not run")
            return goal(f"{top} : {bottom}", None, target, at_least, reason)
    medians = (case["times"][name]["median_ms"] for name in (top, bottom))
    return goal(f"{top} : {bottom}", truediv(*medians), target, at_least)


def said(met: bool | None, word: str = "met") -> str:
    return "" if met is None else word if met else "**missed**"


def goal_rows(cases: Cases) -> Rows:
    """Work, comparison, ratio, target, verdict."""
    rows = [["work", "compared", "ratio", "target", ""]]
    for case in cases:
        for found in case.get("goals", []):
            reached = "—" if found["ratio"] is None else f"{found['ratio']:.2f}"
            verdict = said(found["met"]) or f"not measured: {found['reason']}"
            rows.append([case["case"], found["goal"], reached, found["target_text"], verdict])
    return rows


def missed_rows(cases: Cases) -> Rows:
    """Of the table of goals, the lines of those missed."""
    header, *rows = goal_rows(cases)
    return [header[:-1], *(row[:-1] for row in rows if row[-1] == said(False))]


def time_rows(cases: Cases) -> Rows:
    """One row per case, one column per competitor that ran in any."""
    cases = [case for case in cases if case.get("times") and "peak" not in case]
    names = list(dict.fromkeys(name for case in cases for name in case["times"]))
    return [["work", *names], *([case["case"], *(milliseconds(case["times"].get(n)) for n in names)] for case in cases)]


def memory_rows(cases: Cases) -> Rows:
    """Megabytes above inputs, outputs and gradients, and as a multiple of the output."""
    rows = [["work", "who", "inputs, MB", "output and gradients, MB", "above these, MB", "of the output"]]
    for case in cases:
        for name, taken in case.get("memory", {}).items():
            if "left_out" in taken:
                rows.append([case["case"], name, "—", "—", "—", taken["left_out"]])
                continue
            kept = taken["output"] + taken["visible"] + taken["gradients"]
            sizes = [f"{count / 1e6:.1f}" for count in (taken["inputs"], kept, taken["above"])]
            rows.append([case["case"], name, *sizes, f"{taken['above'] / taken['output']:.2f}"])
    return rows


def left_out_rows(cases: Cases) -> Rows:
    """The competitors left out, and why."""
    rows = [["who", "work", "reason"]]
    for case in cases:
        rows += [[name, case["case"], reason] for name, reason in case.get("left_out", {}).items()]
    return rows


def first_call_rows(cases: Cases) -> Rows:
    """Seconds of the first calls of what is compiled, once per process and kind of call."""
    found = {
        (case["case"].rsplit(", ", 1)[0], name): f"{seconds:.1f}"
        for case in reversed(cases)  # the first of a kind of call counts
        for name, seconds in reversed(case.get("first_call_s", {}).items())
        if name.startswith("compiled")
    }
    rows = [[*work_and_name, seconds] for work_and_name, seconds in reversed(found.items())]
    return [["work", "who", "first call forward and backward, s"], *rows]


def rate_rows(cases: Cases) -> Rows:
    """Work, result, the goal if there is one, and whether it is met."""
    rows = [["work", "median", "slowest to fastest", "goal", ""]]
    for case in cases:
        if "rate" in case:
            spread = f"{case['slowest']:.0f} to {case['fastest']:.0f}" if "slowest" in case else "one run"
            target = case.get("target")
            met = said(None if target is None else case["rate"] >= target)
            aim = "—" if target is None else f"{target:.0f}"
            rows.append([case["case"], f"{case['rate']:.0f} {case['unit']}", spread, aim, met])
    return rows


def figure_rows(cases: Cases) -> Rows:
    """Set, figure, known value, measured value, and the verdict."""
    rows = [["set", "measured", "known", "here", "verdict"]]
    for case in cases:
        if "figure" in case:
            known = f"{'at least' if case['at_least'] else 'at most'} {case['known']:g} {case['unit']}"
            here = "—" if case["measured"] is None else f"{case['measured']:.3g} {case['unit']}"
            here += "" if case["reached"] else " **missed**"
            verdict = case["verdict"] if case["cause"] is None else f"{case['verdict']}: {case['cause']}"
            rows.append([case["set"], case["figure"], known, here, verdict])
    return rows


def mistake_rows(cases: Cases) -> Rows:
    """One row per set, one column per planted error: whether it is named, otherwise what is reported."""
    cases = [case for case in cases if "planted" in case]
    planted = list(dict.fromkeys(case["planted"] for case in cases))
    named = {
        (case["set"], case["planted"]): "named"
        if case["named"] == case["planted"]
        else case["named"] or case["verdict"]
        for case in cases
    }
    sets = dict.fromkeys(case["set"] for case in cases)
    return [["set", *planted], *([name, *(named.get((name, mistake), "—") for mistake in planted)] for name in sets)]


def reached_rows(cases: Cases) -> Rows:
    """Subject, figure, result, goal, and whether it is met."""
    rows = [["of", "figure", "measured", "goal", ""]]
    for case in cases:
        for row in case.get("rows", []):
            reached = said(row["reached"], "reached")
            rows.append([row["section"], row["what"], row["measured"], row["goal"] or "—", reached])
    return rows


def model_rows(cases: Cases) -> Rows:
    """A step of a model with the library's operators and with hand-written ones: times, peaks, and their ratios."""
    cases = [case for case in cases if "peak" in case]
    names = list(dict.fromkeys(name for case in cases for name in case["times"]))
    rows = [["step", *(f"{n}, ms" for n in names), "of times", *(f"{n}, peak MB" for n in names), "of peaks"]]
    for case in cases:
        times, peaks = [case["times"][name] for name in names], [case["peak"][name] for name in names]
        shown = [f"{peak / 1e6:.0f}" for peak in peaks] if all(peaks) else ["—"] * len(peaks)
        of_times = f"{times[0]['median_ms'] / times[1]['median_ms']:.2f}"
        of_peaks = f"{peaks[0] / peaks[1]:.2f}" if all(peaks) else "—"
        rows.append([case["case"], *map(milliseconds, times), of_times, *shown, of_peaks])
    return rows


TABLES: dict[str, Callable[[Cases], Rows]] = {
    "times": time_rows,
    "memory": memory_rows,
    "models": model_rows,
    "rates": rate_rows,
    "compiling": first_call_rows,
    "goals": goal_rows,
    "missed": missed_rows,
    "left-out": left_out_rows,
    "figures": figure_rows,
    "mistakes": mistake_rows,
    "reached": reached_rows,
}


def machine_line(machine: Mapping[str, Any]) -> str:
    """Machine and date in a sentence, and what other processes used while it was measured."""
    used = machine.get("others")
    others = "" if used is None else f"; other processes used at most {100 * used:.0f} % of the processors"
    return (
        f"{machine['device']}, {machine['cores']} cores, {machine['threads']} threads, {machine['system']}, huge pages "
        f"on {machine['huge_pages']}; lsmgeo {machine['lsmgeo']}, PyTorch {machine['torch']}, kornia "
        f"{machine['kornia']}, Python {machine['python']}; {machine['date']}; load before: {machine['load_before']:.1f}"
        + others
    )


def show(cases: Cases) -> None:
    """Print all tables that have rows for the cases."""
    for title, table in TABLES.items():
        if title == "missed":  # they are among the goals
            continue
        header, *rows = table(cases)
        if rows:
            widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
            print(f"\n{title}")
            for row in (header, *rows):
                cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
                print("  " + "  ".join(cells).rstrip(), flush=True)
