"""The pages of the models are made from the models, and the guides name what exists."""

import ast
import doctest
import inspect
import re
import sys
from dataclasses import fields
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from lsmgeo.cli.convert_command import convert
from lsmgeo.cli.evaluate_command import evaluate
from lsmgeo.cli.reconstruct_command import reconstruct
from lsmgeo.cli.render_command import render
from lsmgeo.cli.train_command import train
from lsmgeo.evaluation import REPORTS
from lsmgeo.models import create
from lsmgeo.training.config import GROUPS, read_config

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
GUIDES = {name: (DOCS / f"{name}.rst").read_text(encoding="utf-8") for name in ("training", "evaluation")}
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((DOCS / "models").glob("*.rst"))}
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = {
    "train": train, "evaluate": evaluate, "reconstruct": reconstruct, "render": render,
    "convert": convert,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def docs_on_path():
    before = list(sys.path)
    sys.path[:0] = [str(DOCS), str(DOCS / "figures")]
    yield
    sys.path[:] = before


@pytest.mark.parametrize("name", ["voxel-lsm", "depth-lsm", "r2n2", "r2n2-pose"])
def test_a_table_holds_every_parameter_and_a_drawing_every_stage(name):
    import model_tables
    import networks

    _, *rows, (total_name, *_, total) = model_tables.layer_rows(name, "tiny", "paper")
    parameters = [int(row[-1].replace(",", "")) for row in rows if row[-1]]
    expected = sum(weights.numel() for weights in create(name, preset="tiny").parameters())
    assert total_name == "**all**"
    assert int(total.replace(",", "")) == sum(parameters) == expected
    plt.switch_backend("Agg")
    axes = networks.draw(name, "tiny")
    drawn = {text.get_text() for text in axes.texts}
    plt.close("all")
    assert {f"{number:,}" for number in parameters if number > 100} <= drawn


def test_skip_connections_are_found():
    from network_tracing import traced

    stages = {stage.name: stage for stage in traced("depth-lsm", "tiny")}
    assert stages["image_encoder.out"].sources == ["image_encoder.up.0", "image_encoder.down.0"]
    assert stages["grid_network.down.0"].sources == ["fusion"]
    assert stages["rise.0"].sources == ["image_encoder.down.1", "rays.2"]
    assert stages["images"].shape == (3, 32, 32)
    assert stages["unproject"].shape == (8 + 1 + 3, 8, 8, 8)
    pose = {stage.name: stage for stage in traced("r2n2-pose", "tiny")}
    assert pose["recurrence"].sources == ["vector", "rotation.2"]
    last = traced("voxel-lsm", "tiny")
    assert last[-2].sources == ["grid_network.up.1", "fusion"]
    assert (last[-1].name, last[-1].shape) == ("occupancy", (1, 16, 16, 16))


def test_every_key_of_a_configuration_is_described():
    import model_tables

    for group, form in GROUPS.items():
        told = model_tables.attributes_of(form)
        assert list(told) == [item.name for item in fields(form)]
        assert all(len(text) > 5 for text in told.values())
        assert f".. training-config:: {group}\n" in GUIDES["training"]


@pytest.mark.parametrize("page", ["training", "evaluation", "readme"])
def test_commands_and_their_options_exist(page):
    text = README if page == "readme" else GUIDES[page]
    found = re.findall(r"lsmgeo(?:\.cli)? (train|evaluate|reconstruct|render|convert) ([^`\n]*)", text)
    assert found
    for command, arguments in found:
        options = set(re.findall(r"--([a-z][a-z_]*)", arguments.partition("  #")[0]))
        assert options <= set(inspect.signature(COMMANDS[command]).parameters), command
    for path in re.findall(r"examples/[\w/]+\.(?:toml|py)", text):
        assert (ROOT / path).is_file(), path
    for key in re.findall(r"--set ([a-z]+\.[a-z_]+)=", text):
        group, name = key.split(".")
        assert name in {item.name for item in fields(GROUPS[group])}, key


def test_settings_named_in_the_guides_exist():
    known = {f"{group}.{item.name}" for group, form in GROUPS.items() for item in fields(form)}
    for text in GUIDES.values():
        named = set(re.findall(r"``((?:run|data|optimiser)\.[a-z_]+)", text))
        assert named
        assert named <= known


def test_every_report_has_its_command():
    named = set(re.findall(r"--report ([a-z-]+)", GUIDES["evaluation"]))
    assert named == set(REPORTS)


def test_every_event_of_the_log_is_explained():
    folder = ROOT / "lsmgeo" / "training"
    source = "".join((folder / name).read_text(encoding="utf-8") for name in ("loop.py", "run_state.py", "logs.py"))
    events = set(re.findall(r'\.event\(\s*"(\w+)"', source)) | set(re.findall(r'"(start|resume)"', source))
    assert len(events) > 6
    assert events <= set(re.findall(r"``(\w+)``", GUIDES["training"]))


def test_every_fault_is_a_test_that_exists():
    named = re.findall(r":fault:`(\w+\.py)::(\w+)`", GUIDES["training"])
    assert len(named) > 8
    for file, name in named:
        tree = ast.parse((ROOT / "tests" / "training" / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, name


@pytest.mark.parametrize("page", PAGES)
def test_pages_of_models_name_what_exists(page):
    text = PAGES[page]
    examples = doctest.testfile(str(DOCS / "models" / f"{page}.rst"), module_relative=False)
    assert (examples.attempted > 0, examples.failed) == (page == "index", 0)
    for block in re.findall(r"\.\. code-block:: python\n\n((?:   .*\n|\n)+)", text):
        ast.parse(re.sub(r"(?m)^   ", "", block))
    for name, preset, *variant in re.findall(r"\.\. model-layers:: ([\w-]+) (\w+)(?: (\w+))?", text):
        assert create(name, preset=preset, variant=variant[0] or "paper").name == name
    drawn = ast.parse((DOCS / "figures" / "networks.py").read_text(encoding="utf-8"))
    functions = {node.name for node in drawn.body if isinstance(node, ast.FunctionDef)}
    assert set(re.findall(r"figures/networks\.py (\w+)", text)) <= functions


def test_the_front_page_of_models_runs_and_examples_are_configurations():
    block = re.search(r"\.\. code-block:: python\n\n((?:   .*\n|\n)+)", PAGES["index"])
    names: dict = {}
    exec(re.sub(r"(?m)^   ", "", block[1]), names)
    assert names["found"].occupancy.shape == (1, 16, 16, 16)
    assert names["found"].by_view.shape == (1, 3, 16, 16, 16)
    for name in re.findall(r"lsmgeo train (examples/\S+\.toml)", GUIDES["training"]):
        read_config(ROOT / name)
