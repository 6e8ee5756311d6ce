"""Directives of the model pages: layers, presets, and every key of a training configuration."""

from __future__ import annotations

import inspect
import re
from dataclasses import MISSING, fields
from typing import Any

from benchmark_tables import CURVE, RESULTS, SOURCES, list_table, load
from docutils import nodes
from docutils.statemachine import StringList
from network_tracing import Stage, traced
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from benchmarks.experiments import collecting, queue
from lsmgeo.models import create
from lsmgeo.models.creating import PRESETS, RELEASES
from lsmgeo.training import config as configuration

GROUPS = configuration.GROUPS


def layer_rows(name: str, preset: str, variant: str) -> list[list[str]]:
    """Every stage of a model: operation, inputs, output, parameters."""
    stages = traced(name, preset, variant)
    rows = [["stage", "what it does", "reads, if not the one before", "gives", "parameters"]]
    for before, stage in zip((None, *stages), stages, strict=False):
        reads = [f"``{source}``" for source in stage.sources]
        if before is not None and stage.sources == [before.name]:
            reads = []
        rows.append([f"``{stage.name}``", stage.what, ", ".join(reads), shape_text(stage), number(stage.parameters)])
    total = sum(stage.parameters for stage in stages)
    return [*rows, ["**all**", "", "", "", number(total)]]


def shape_text(stage: Stage) -> str:
    channels, *size = stage.shape
    if len(set(size)) == 1 and len(size) > 1:
        return f"{channels} x {size[0]}\\ :sup:`{len(size)}`"
    return " x ".join(map(str, stage.shape))


def number(value: int) -> str:
    return f"{value:,}" if value else ""


def preset_rows() -> list[list[str]]:
    """Every preset of every model, built and counted."""
    rows = [["model", "preset", "image", "grid of the fusion", "result", "parameters"]]
    for name, presets in PRESETS.items():
        chosen = [(preset, "paper") for preset in presets] + ([("paper", "release")] if name in RELEASES else [])
        for preset, variant in chosen:
            model = create(name, preset=preset, variant=variant)
            fused = getattr(model.settings, "grid_size", None) or model.settings.coarse
            side = model.image_size
            result = f"{model.resolution}\\ :sup:`3` voxels" if model.output == "voxels" else f"depth, {side} x {side}"
            parameters = number(sum(weights.numel() for weights in model.parameters()))
            title = f'``{preset}``, ``variant="{variant}"``' if variant != "paper" else f"``{preset}``"
            rows.append([f"``{name}``", title, f"{side} x {side}", f"{fused}\\ :sup:`3`", result, parameters])
    return rows


def config_rows(group: str) -> list[list[str]]:
    """Every key of a group of the training configuration, with its default and the docstring of its class."""
    form = GROUPS[group]
    descriptions = attributes_of(form)
    rows = [["key", "default", "what it is"]]
    for item in fields(form):
        default = item.default if item.default is not MISSING else item.default_factory()  # type: ignore[misc]
        rows.append([f"``{group}.{item.name}``", f"``{default!r}``", as_rst(descriptions[item.name])])
    return rows


def attributes_of(form: type) -> dict[str, str]:
    """The attributes in a class's docstring."""
    text = inspect.getdoc(form) or ""
    section = text.partition("Attributes:\n")[2]
    return {
        name: " ".join(words.split()) for name, words in re.findall(r"(?ms)^    (\w+): (.*?)(?=^    \w+: |\Z)", section)
    }


def as_rst(text: str) -> str:
    """Names in single backquotes, as code where they would link to nothing."""
    return re.sub(r"(?<!`)`([^`.]+)`(?!`)", r"``\1``", text)


def curve_rows(found: dict[str, Any]) -> list[list[str]]:
    """IoU of the last evaluation and on the test shapes, of the model and of visual hulls."""
    measured, last = found["evaluation"]["iou"], found["curve"][-1]["iou"]
    views = range(1, 1 + len(next(iter(measured.values()))))
    rows = [["IoU, %", *(f"{view} view{'s' * (view > 1)}" for view in views)]]
    rows += [[name, *(f"{value:.1f}" for value in values)] for name, values in measured.items()]
    held_back = [f"{100 * last[str(view)]:.1f}" if str(view) in last else "" for view in views]
    return [*rows, ["in training, held back", *held_back]]


def curve_text(found: dict[str, Any]) -> str:
    """The run of the curve."""
    settings, last = found["configuration"], found["curve"][-1]
    return (
        f"{found['parameters']:,} parameters, {found['shapes']:,} shapes; {last['step']:,} steps of "
        f"{settings['run']['batch']} shapes in {found['cpu_minutes']['training']:.0f} CPU minutes, evaluations "
        f"included, on {found['machine']['device']} ({found['machine']['vector_instructions']}); the curve is of "
        f"{found['held_back']} shapes held back, the table of {found['evaluation']['data']}."
    )


def experiment_rows(group: str) -> list[list[str]]:
    """Every run of the queue, or of the trials, with its results."""
    rows = [["run", "what", "CPU minutes", "training took", "steps", "IoU, or median depth error"]]
    for experiment in {"queue": queue.QUEUE, "trials": queue.TRIALS}[group]:
        found = load(f"experiments/{experiment.name}")
        cells = ["", "", "*not run*"]
        if found is not None:
            took = f"{found['cpu_minutes']['training']:.1f}"
            cells = [took, f"{found['curve'][-1]['step']:,}", collecting.headline(found)]
        rows.append([f"``{experiment.name}``", experiment.what, f"{experiment.minutes:g}", *cells])
    return rows


class Rows(SphinxDirective):
    """A directive that is a table."""

    optional_arguments = 3

    def rows(self) -> list[list[str]]:
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        for source in SOURCES:
            self.env.note_dependency(str(source))
        lines = [line.replace("   :class: benchmark", "   :class: layers") for line in list_table(self.rows())]
        return self.parse_text_to_nodes(StringList(lines, source=str(self.name)))


class Layers(Rows):
    """``.. model-layers:: voxel-lsm paper release``."""

    def rows(self) -> list[list[str]]:
        name, preset, variant = (*self.arguments, *("paper", "paper")[len(self.arguments) - 1 :])
        return layer_rows(name, preset, variant)


class Presets(Rows):
    """``.. model-presets::``."""

    def rows(self) -> list[list[str]]:
        return preset_rows()


class Config(Rows):
    """``.. training-config:: run``."""

    def rows(self) -> list[list[str]]:
        return config_rows(self.arguments[0])


class Experiments(Rows):
    """``.. experiments:: queue``, or ``trials``."""

    def rows(self) -> list[list[str]]:
        for experiment in queue.ALL:
            self.env.note_dependency(str(RESULTS / "experiments" / f"{experiment.name}.json"))
        return experiment_rows(self.arguments[0])


class Curve(SphinxDirective):
    """``.. training-curve::``: the measures of the run whose curve is drawn."""

    def run(self) -> list[nodes.Node]:
        found = load(CURVE)
        self.env.note_dependency(str(RESULTS / f"{CURVE}.json"))
        if found is None:
            lines = [f"*Not measured yet: there is no* ``benchmarks/results/{CURVE}.json``."]
        else:
            lines = [curve_text(found), "", *list_table(curve_rows(found))]
        return self.parse_text_to_nodes(StringList(lines, source=str(self.name)))


def name_fault(
    role: str, raw: str, text: str, line: int, inliner: Any, options: Any = None, content: Any = None
) -> tuple[list[nodes.Node], list[nodes.Node]]:
    """A test of tests/training by the words of its name."""
    words = text.rpartition("::")[2].removeprefix("test_").replace("_", " ")
    return [nodes.emphasis(raw, words)], []


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("training-curve", Curve)
    app.add_directive("experiments", Experiments)
    app.add_role("fault", name_fault)
    app.add_directive("model-layers", Layers)
    app.add_directive("model-presets", Presets)
    app.add_directive("training-config", Config)
    return {"version": "1", "parallel_read_safe": True}
