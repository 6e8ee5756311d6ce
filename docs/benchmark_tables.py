"""The directive ``benchmark``: a table made from a file in benchmarks/results, or a line that says there is none."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
sys.path.insert(0, str(ROOT))

from benchmarks import report  # noqa: E402

# The run whose curve of training is drawn.
CURVE = "experiments/vlsm_45"
# Figures of the plot directive, and the results that they draw.
PLOTS = {"benchmark_growth": "growth", "classical_density": "classical", "training_curve": CURVE}
# What the drawings and tables of the models are made from.
SOURCES = [
    *sorted((ROOT / "lsmgeo" / "models").glob("*.py")),
    ROOT / "lsmgeo" / "training" / "config.py",
    *(ROOT / "docs" / name for name in ("model_tables.py", "network_tracing.py")),
]


def load(name: str) -> dict[str, Any] | None:
    """The results of one benchmark, None if it never ran."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def list_table(rows: report.Rows) -> list[str]:
    """The rows as reStructuredText; the first is the header."""
    lines = [".. list-table::", "   :header-rows: 1", "   :class: benchmark", ""]
    for row in rows:
        lines += [f"   {'*' if column == 0 else ' '} - {cell}".rstrip() for column, cell in enumerate(row)]
    return [*lines, ""]


class Benchmark(SphinxDirective):
    """``.. benchmark:: operators_channels_last goals``; of "every" file, the cases of all."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        name = self.arguments[0]
        kind = directives.choice(self.arguments[1], (*report.TABLES, "machine"))
        files = sorted(RESULTS.glob("*.json")) if name == "every" else [RESULTS / f"{name}.json"]
        for file in files:
            self.env.note_dependency(str(file))
        every = [load(file.stem) for file in files]
        found = {"cases": [case for one in every if one for case in one["cases"]]} if name == "every" else every[0]
        if found is None:
            lines = [f"*Not measured yet: there is no* ``benchmarks/results/{name}.json``."]
        elif kind == "machine":
            lines = [report.machine_line(found["machine"])]
        else:
            rows = report.TABLES[kind](found["cases"])
            lines = list_table(rows) if len(rows) > 1 else ["None."]
        return self.parse_text_to_nodes(StringList(lines, source=f"{name}.json"))


def forget_plots(app: Sphinx) -> None:
    """Remove plots that are older than what they show: the plot directive looks only at the age of the script."""
    shown = {name: [RESULTS / f"{drawn}.json"] for name, drawn in PLOTS.items()} | {"networks": SOURCES}
    for name, files in shown.items():
        newest = max((file.stat().st_mtime for file in files if file.is_file()), default=0.0)
        for plot in (Path(app.doctreedir).parent / "plot_directive").rglob(f"{name}*"):
            if plot.stat().st_mtime < newest:
                plot.unlink()


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("benchmark", Benchmark)
    app.connect("builder-inited", forget_plots)
    return {"version": "1", "parallel_read_safe": True}
