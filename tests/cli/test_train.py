"""``lsmgeo train``: what is printed, and how a wrong configuration is told."""

from __future__ import annotations

import json
import os
import re
import signal

import pytest

from lsmgeo import cli
from lsmgeo.models import load
from lsmgeo.training import loop
from lsmgeo.training.checkpoints import load_latest
from tests.training.runs import configure, write_shapes


@pytest.fixture(scope="module")
def configuration(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train")
    (folder / "shards").mkdir()
    config = configure(write_shapes(folder / "shards"), steps=2)
    (folder / "run.json").write_text(json.dumps(config.to_dict()))
    return folder / "run.json"


def test_a_model_is_trained_and_goes_on(configuration, tmp_path, capsys):
    out = tmp_path / "run"
    command = ["train", str(configuration), "--out", str(out), "--set", "run.steps=1"]
    assert cli.main([*command, "--set", "run.log_every=1"]) == 0
    printed = capsys.readouterr()
    assert "ended:       at step 1, since all steps are taken\n" in printed.out
    checkpoint = out / "checkpoints" / "step_00000001"
    assert f"checkpoint:  {checkpoint.resolve()}\n" in printed.out
    assert f"evaluate:    lsmgeo evaluate {checkpoint}\n" in printed.out
    assert re.search(r"IoU: +\d+\.\d, \d+\.\d % after 1 to 2 views", printed.out)
    assert re.search(r"step 1: loss \d\.\d{4}", printed.err)
    assert "6 shapes, 2 per step; evaluated on 2" in printed.err
    assert load(out).name == "voxel-lsm"
    assert cli.main(["train", str(configuration), "--out", str(out), "--quiet", "true"]) == 0
    printed = capsys.readouterr()
    assert "ended:       at step 2" in printed.out
    assert printed.err == ""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_is_told_by_the_exit_status(configuration, tmp_path, capsys, monkeypatch, number, status):
    find = loop.find_gradients

    def find_gradients(*arguments, **options):
        os.kill(os.getpid(), number)
        return find(*arguments, **options)

    monkeypatch.setattr(loop, "find_gradients", find_gradients)
    assert cli.main(["train", str(configuration), "--out", str(tmp_path)]) == status
    assert "resume:      the same command" in capsys.readouterr().out
    assert load_latest(tmp_path).step == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "run.stepz=3"], "there is no run.stepz; did you mean run.steps?"),
        (["--set", "data.source=/nowhere"], "/nowhere: cannot be read"),
        (["--set", "model.preset=huge"], "preset must be one of"),
        (["--set", "model.settings.grid_sise=8"], "there is no setting 'grid_sise'; did you mean grid_size?"),
        (["--set", "model.settings.upsample=1"], "no voxels at the model's resolution 8"),
        (["--set", "model.name=depth-lsm", "--set", "model.settings={}"], "source has no depth"),
    ],
)
def test_what_cannot_be_trained_gives_one_line_and_status_2(configuration, tmp_path, capsys, arguments, message):
    assert cli.main(["train", str(configuration), "--out", str(tmp_path / "run"), *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("lsmgeo: error: ")
    assert message in printed.err
    assert printed.err.count("\n") == 1


def test_a_missing_configuration(tmp_path, capsys):
    assert cli.main(["train", str(tmp_path / "none.toml")]) == 2
    assert "none.toml: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize("words", [["--quiet"], ["--quiet", "True"], ["--quiet=yes"], ["--no_quiet", "--quiet"]])
def test_booleans_are_flags(configuration, tmp_path, capsys, words, place):
    command = ["train", str(configuration), "--out", str(tmp_path), "--set", "run.steps=1"]
    assert cli.main([*command[:place], *words, *command[place:]]) == 0
    assert capsys.readouterr().err == ""
    for off in (["--quiet", "false"], ["--no_quiet"]):
        assert cli.main([*command[:place], *off, *command[place:]]) == 0
        assert "evaluated on" in capsys.readouterr().err


def test_a_flag_takes_no_other_value(configuration, capsys):
    assert cli.main(["train", str(configuration), "--quiet", "maybe"]) == 2
    assert "maybe" in capsys.readouterr().err
