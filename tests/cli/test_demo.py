"""``lsmgeo demo`` and what the command line does before a command runs."""

import os
import re
import subprocess
import sys
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from lsmgeo import cli
from lsmgeo.cli.demo_scene import run_demo
from tests.training.faults import in_child


def test_the_demo_recovers_the_depth_and_draws_it(tmp_path, capsys):
    assert cli.main(["demo", "--out", str(tmp_path / "new")]) == 0
    printed = dict(line.split(":", 1) for line in capsys.readouterr().out.splitlines())
    assert 0 < float(printed["median relative depth error"].strip(" %")) <= 1.0
    assert float(printed["pixels within 1 %"].strip(" %")) >= 70
    path = tmp_path / "new" / "demo.png"
    assert printed["figure"].strip() == str(path.resolve())
    assert [file.name for file in path.parent.iterdir()] == ["demo.png"]
    with Image.open(path) as opened:
        picture = np.array(opened)
    assert min(picture.shape[:2]) > 500
    assert picture.std() > 20


def test_the_demo_s_depth_is_that_of_the_sphere_and_the_floor():
    """The truth of the demonstration, once more by another way: every depth puts its pixel on a surface."""
    result = run_demo(size=(30, 40), voxels=24, planes=16)
    K, E = (value[result.view].numpy() for value in result.cameras[:2])
    v, u = np.nonzero(result.true_depth.numpy())
    assert len(v) > 300
    camera = np.linalg.solve(K, np.stack([u, v, np.ones_like(u)]).astype(float)) * result.true_depth.numpy()[v, u]
    x, y, z = E[:3, :3].T @ (camera - E[:3, 3:])
    distance = np.minimum(np.abs(np.sqrt(x**2 + y**2 + z**2) - 0.4), np.abs(y + 0.4))
    np.testing.assert_allclose(distance, 0, atol=1e-9)
    assert bool((result.true_depth[result.error.isfinite()] > 0).all())


def test_an_unwritable_place_gives_one_line_and_status_2(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert cli.main(["demo", "--out", str(tmp_path / "file")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("lsmgeo: error: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["reconstruct", "--help"]])
def test_questions_about_the_command_end_well(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 0
    assert "lsmgeo" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], '"subcommand" to be one of {demo,info,reconstruct,convert,render, ...}'),
        (["dance"], "invalid choice: 'dance'"),
        (["--dance"], "unrecognized arguments: --dance"),
        (["demo", "--dance", "3"], "unrecognized arguments: --dance 3"),
        (["demo", "--out"], "--out: expected one argument"),
        (["demo", "--config", "nowhere.yaml"], "config: .*nowhere.yaml'"),
        (["reconstruct"], "required: .*scene"),
        (["reconstruct", ".", "more"], "unrecognized arguments: more"),
        (["reconstruct", ".", "--dens", "0.3"], "unrecognized arguments: --dens"),
        (
            ["reconstruct", ".", "--method", "guess"],
            "method must be one of 'sweep', 'hull', 'v-lsm', 'd-lsm'; got 'guess'",
        ),
        (["reconstruct", ".", "--score", "mse"], "score must be one of 'zncc', 'sad', 'census'; got 'mse'"),
        (["reconstruct", ".", "--size", "1.5"], "size must be a whole number; got '1.5'"),
        (["reconstruct", ".", "--planes", "many"], "planes must be a whole number; got 'many'"),
        (["reconstruct", ".", "--density", "x"], "density must be a finite number; got 'x'"),
        (["reconstruct", ".", "--near", "nan"], "near must be a finite number; got 'nan'"),
        (["reconstruct", ".", "--far", "two\nlines"], "far must be a finite number; got 'two"),
    ],
)
def test_a_wrong_command_gives_one_line_and_status_2(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert re.match(f"lsmgeo: error: .*({message}).*\n$", captured.err), captured.err
    assert len(captured.err) < 400
    assert list(tmp_path.iterdir()) == []


def test_a_configuration_that_is_none_is_not_printed_whole(tmp_path, capsys):
    (tmp_path / "notes").write_text("a line\n" * 1000)
    assert cli.main(["--config", str(tmp_path / "notes"), "demo"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert len(error) < 400


def test_the_installed_command_has_these_statuses_and_importing_it_is_light(tmp_path):
    code = (
        "import sys, lsmgeo; before = set(sys.modules); import lsmgeo.cli; "
        "print(*sorted({name.split('.')[0] for name in set(sys.modules) - before}), "
        "*sorted(name for name in set(sys.modules) - before if name.startswith('lsmgeo'))); "
        "sys.exit(lsmgeo.cli.main())"
    )
    command = [sys.executable, "-c", code, "reconstruct", "/nonexistent"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 2
    assert "lsmgeo.cli" in done.stdout.split()
    assert not {"torch", "jsonargparse", "lsmgeo.data"} & set(done.stdout.split())
    assert done.stderr == "lsmgeo: error: /nonexistent: no such file or folder\n"
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_demo_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lsmgeo.cli.demo_scene.run_demo", interrupt)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "lsmgeo: interrupted\n"
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_has_read_enough_ends_a_command_quietly(capfd):
    """As head does."""

    def ask_for_help():
        reading, writing = os.pipe()
        os.close(reading)
        os.dup2(writing, 1)
        sys.stdout = open(1, "w", closefd=False)
        raise SystemExit(cli.main(["--help"]))

    assert in_child(ask_for_help, quiet=False) == 141
    assert capfd.readouterr().err == ""


def test_another_broken_pipe_is_told(monkeypatch):
    monkeypatch.setattr(sys.modules["lsmgeo.cli.main"], "_run", mock.Mock(side_effect=BrokenPipeError("of a worker")))
    with pytest.raises(BrokenPipeError, match="of a worker"):
        cli.main([])


def interrupt(*_, **__):
    raise KeyboardInterrupt
