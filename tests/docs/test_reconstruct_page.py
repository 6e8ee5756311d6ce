"""What the guide to reconstruction names is there, and its defaults are those of the code."""

import inspect
import re
import textwrap
from pathlib import Path

from lsmgeo import classical
from lsmgeo.cli.reconstruct_command import reconstruct
from lsmgeo.metrics import depth_errors

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "docs" / "reconstruct.rst").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
OPTIONS = inspect.signature(reconstruct).parameters


def default(function, name: str):
    return inspect.signature(function).parameters[name].default


def test_options_exist():
    for text in (GUIDE, re.search(r"lsmgeo reconstruct SCENE.*?guide", README, re.DOTALL)[0]):
        named = set(re.findall(r"--([a-z][a-z_]*)", text))
        assert named
        assert named <= set(OPTIONS)


def test_defaults_are_as_said():
    assert re.search(r"300\s+planes", GUIDE)
    assert OPTIONS["planes"].default == default(classical.reconstruct_scene, "planes") == 300
    assert OPTIONS["size"].default == 640
    assert (default(classical.reconstruct_view, "density"), default(classical.reconstruct_scene, "density")) == (
        0.4,
        0.8,
    )
    assert "40 % of one view, 80 % of several" in GUIDE
    assert 2 * default(classical.guided_filter, "radius") + 1 == 13
    assert "13 x 13" in GUIDE
    assert default(classical.consistent_views, "pixels") == 1.0
    assert default(classical.consistent_views, "relative") == 0.01
    assert OPTIONS["rule"].default == "all"


def test_each_step_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    block = re.search(r":name: each-step\n\n((?:   .*\n|\n)+)", GUIDE)[1]
    monkeypatch.chdir(tmp_path)
    found = {}
    exec(compile(textwrap.dedent(block), "each-step", "exec"), found)
    assert capsys.readouterr().out.startswith("depth: DepthErrors(")
    assert float(depth_errors(found["found"].depth, found["truth"][0], found["best"]).abs_rel) < 1e-3
    assert (tmp_path / "model.glb").stat().st_size > 10_000


def test_functions_that_are_named_exist():
    for name in re.findall(r"classical\.([a-z_]+)", GUIDE):
        assert name in classical.__all__, name
    for line in re.findall(r"from lsmgeo\.classical import (.*)", GUIDE):
        assert {name.strip() for name in line.split(",")} <= set(classical.__all__)
