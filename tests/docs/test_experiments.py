"""The queue of experiments, on a set and networks that take seconds."""

from __future__ import annotations

import json
import os

import pytest
import torch

from benchmarks.experiments import __main__ as command
from benchmarks.experiments import collecting, queue, running
from benchmarks.experiments.queue import Experiment
from lsmgeo.data import Recipe
from lsmgeo.models import load
from tests.training.runs import end_of, stop_in

SET, SHAPES = Recipe(seed=0, views=2, size=32, voxels=(16,), depth=True), 65
SMALL = {
    "run.cpu_minutes": None, "run.steps": 4, "run.evaluate_every": 2, "run.evaluate_shapes": 4,
    "run.checkpoint_every": 2, "run.pictures": 0, "data.views": 2,
}  # fmt: skip
RUNS = (
    Experiment("first", "a V-LSM that ships", 1, "voxel-lsm", SMALL, "tiny", reports=("backgrounds",), ships=True),
    Experiment("second", "a D-LSM", 1, "depth-lsm", SMALL, "tiny"),
    Experiment("third", "a trial", 1, "r2n2-pose", SMALL, "tiny", is_tested=False),
)


@pytest.fixture
def asked():
    return []


@pytest.fixture
def folder(tmp_path, monkeypatch, asked):
    for module in (queue, running, collecting, command):
        for name, value in {"QUEUE": RUNS[:2], "TRIALS": RUNS[2:], "ALL": RUNS, "SET": SET, "SHAPES": SHAPES}.items():
            if hasattr(module, name):
                monkeypatch.setattr(module, name, value)
    for name, value in {"RESULTS": tmp_path / "results", "PRETRAINED": tmp_path / "pretrained"}.items():
        monkeypatch.setattr(collecting, name, value)
    for module in (running, collecting):
        monkeypatch.setattr(module, "RECIPE", tmp_path / "set.json")
    monkeypatch.setattr(os, "nice", lambda more: asked.append(("nice", more)))
    monkeypatch.setattr(torch, "set_num_threads", lambda number: asked.append(("threads", number)))
    return tmp_path / "experiments"


def files(path):
    return {one.name: one.read_bytes() for one in path.iterdir()}


def test_runs_follow_each_other_and_are_kept(folder, tmp_path, monkeypatch, capsys, asked):
    def run(*words):
        status = command.main([*words, "--folder", str(folder)])
        return status, capsys.readouterr().out

    def states():
        lines = [line for line in run("list")[1].splitlines() if line.startswith("  ")]
        return {line.split()[0]: line.split("min  ")[1].split("  ")[0] for line in lines}

    assert states() == {"first": "next", "second": "not begun", "third": "not begun"}
    with monkeypatch.context() as patch:
        stop_in(patch, 3)
        assert run("next")[0] == 143
    assert asked[:2] == [("nice", 19), ("threads", 1)]
    with (folder / "runs" / "first" / "log.jsonl").open("a") as log:
        log.write('{"event": "step", "st')  # a loss of power
    assert states() == {"first": "at step 3, next", "second": "not begun", "third": "not begun"}
    assert run("next")[0] == 0
    # A run that was stopped is the one that never was.
    whole = running.Folder(tmp_path / "other")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "set").symlink_to(folder / "set")
    assert running.run_experiment(RUNS[0], whole) == 0
    (step, weights, moments), (step_there, weights_there, moments_there) = map(
        end_of, (folder / "runs" / "first", whole.run(RUNS[0]))
    )
    assert step == step_there == 4
    torch.testing.assert_close((weights, moments), (weights_there, moments_there), rtol=0, atol=0)
    capsys.readouterr()

    assert states() == {"first": "done", "second": "next", "third": "not begun"}
    assert run("next")[0] == 0
    assert run("next", "third")[0] == 0
    assert "all experiments are done" in run("next")[1]

    assert run("collect")[0] == 0
    kept = [files(collecting.RESULTS), files(collecting.PRETRAINED), (tmp_path / "set.json").read_bytes()]
    assert run("collect")[0] == 0
    assert kept == [files(collecting.RESULTS), files(collecting.PRETRAINED), (tmp_path / "set.json").read_bytes()]
    assert sorted(kept[0]) == ["first.json", "second.json", "third.json"]
    first, second, third = (json.loads(content) for _, content in sorted(kept[0].items()))
    assert str(tmp_path) not in kept[0]["first.json"].decode()
    assert [line["step"] for line in first["curve"]] == [2, 4]
    assert len(first["evaluation"]["iou"]["voxel-lsm"]) == 2
    assert set(first["evaluation"]["iou"]) == {"voxel-lsm", "visual hull", "visual hull, strict"}
    assert second["evaluation"]["depth_error"]["2"]["mean"] > 0
    assert third["evaluation"] == {}
    assert set(third["validation"]["iou by threshold"]) == {"0.2", "0.3", "0.4", "0.5"}
    assert first["validation"]["by precision"]["float16"] == pytest.approx(
        first["validation"]["by precision"]["float32"], rel=0.01
    )
    (backgrounds,) = first["evaluation"]["reports"]["backgrounds"].values()
    assert set(backgrounds) == {"voxel-lsm, white behind", "voxel-lsm, random behind"}
    assert first["set"] == json.loads(kept[2])["sha256"]
    assert "test IoU" in run("list")[1]

    assert list(kept[1]) == ["voxel-lsm-tiny.safetensors"]
    assert str(tmp_path).encode() not in kept[1]["voxel-lsm-tiny.safetensors"]
    shipped, trained = (
        load(path) for path in (collecting.PRETRAINED / "voxel-lsm-tiny.safetensors", folder / "runs" / "first")
    )
    for name, tensor in shipped.state_dict().items():
        torch.testing.assert_close(tensor, trained.state_dict()[name], rtol=1e-3, atol=1e-6)
    # Results that are in the repository are done wherever the run was made.
    assert command.main(["next", "--folder", str(tmp_path / "nowhere")]) == 0
    with pytest.raises(SystemExit, match="there is no experiment 'fourth'; there are first, second, third"):
        command.main(["next", "fourth", "--folder", str(folder)])


def test_the_queue_trains_for_its_minutes_and_tells_what_differs():
    for experiment in queue.ALL:
        config = experiment.config("set")
        if experiment.name != "vlsm_bf16_5":
            assert config.run.cpu_minutes == experiment.minutes - experiment.evaluation_minutes > 0
        assert (experiment.evaluation_minutes >= 6) == experiment.is_tested
        assert experiment.minutes <= 90
        assert config.data.workers == 0
    names = [experiment.name for experiment in queue.ALL]
    assert len(set(names)) == len(names)
    assert [one.name for one in queue.QUEUE if one.ships] == ["vlsm_90", "dlsm_90"]
    assert all(one.minutes == int(one.name.rpartition("_")[2]) for one in queue.ALL)
    noise, background = queue.find("vlsm_noise_45").config("set").data, queue.find("vlsm_bg_45").config("set").data
    assert (noise.pose_noise, background.background) == (10.0, "random")
    rules = queue.find("vlsm_release_rules_45").config("set").model
    assert rules.settings == {"pixel_rules": "release"}


def kept(**changes):
    values = {
        "curve": [{"step": 500, "iou": {"1": 0.3, "2": None}}, {"step": 1000, "iou": {"1": 0.31, "2": 0.42}}],
        "evaluation": {"data": "1,040 shapes", "iou": {"voxel-lsm": [30.0, 41.06], "visual hull": [14.0, None]}},
        "parameters": 1234, "shapes": 100, "held_back": 26, "cpu_minutes": {"training": 30.2, "evaluation": 5.0},
        "machine": {"device": "a CPU", "vector_instructions": "AVX2"}, "configuration": {"run": {"batch": 4}},
    }  # fmt: skip
    return values | changes


def test_results_become_tables_of_the_docs(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(running.RECIPE.parents[2] / "docs"))
    import model_tables

    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "vlsm_45.json").write_text(json.dumps(kept()))
    monkeypatch.setattr(model_tables, "load", lambda name: kept() if name == "experiments/vlsm_45" else None)
    header, first, *others = model_tables.experiment_rows("queue")
    assert len(header) == len(first) == 6
    assert first == ["``vlsm_45``", "V-LSM", "45", "30.2", "1,000", "test IoU 30.0 41.1"]
    assert {row[-1] for row in others} == {"*not run*"}
    assert len(model_tables.experiment_rows("trials")) == 1 + len(queue.TRIALS)
    rows = model_tables.curve_rows(kept(evaluation={"data": "", "iou": {"voxel-lsm": [30.0, 41.06]}}))
    assert rows[1:] == [["voxel-lsm", "30.0", "41.1"], ["in training, held back", "31.0", "42.0"]]
    assert "1,000 steps of 4 shapes in 30 CPU minutes" in model_tables.curve_text(kept())
