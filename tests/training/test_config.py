"""Configurations: what is read, and how invalid ones are reported."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lsmgeo.errors import DataError, OptionError
from lsmgeo.models import create
from lsmgeo.training import RunConfig, TrainingConfig, make_config, read_config

TEXT = """
[model]
name = "r2n2"
preset = "tiny"
settings = { recurrence = "lstm" }

[data]
source = "shards"
views = [1, 4]
background = [0.5, 0.5, 1]

[run]
steps = 50
minutes = 2
"""
EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "configs").glob("*.toml"))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(TEXT)
    return path


def test_a_file_is_read(path):
    config = read_config(path)
    assert (config.model.name, config.model.preset, config.model.settings) == ("r2n2", "tiny", {"recurrence": "lstm"})
    assert (config.data.views, config.data.view_range, config.data.background) == ((1, 4), (1, 4), (0.5, 0.5, 1.0))
    assert (config.run.steps, config.run.minutes) == (50, 2.0)
    assert config.optimiser.learning_rate == 1e-3


def test_overrides_come_first(path):
    overrides = [
        "run.steps=none",
        "data.views=3",
        "run.precision=bf16",
        "optimiser.clip_norm=1",
        "data.categories=first",
    ]
    config = read_config(path, [*overrides, "model.settings.recurrence=gru", "data.source=/a b/c"])
    assert (config.run.steps, config.run.precision, config.data.view_range) == (None, "bf16", (3, 3))
    assert (config.optimiser.clip_norm, config.data.categories, config.data.source) == (1.0, "first", "/a b/c")
    assert config.model.settings == {"recurrence": "gru"}


def test_what_is_written_beside_a_run_is_the_same_configuration(path, tmp_path):
    config = read_config(path, ["data.categories=[chair, lamp]", 'data.categories=["chair", "lamp"]'])
    (tmp_path / "config.json").write_text(json.dumps(config.to_dict()))
    assert read_config(tmp_path / "config.json") == config


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("run.stepz=3", "there is no run.stepz; did you mean run.steps?"),
        ("data.batch=3", "there is no data.batch; did you mean run.batch?"),
        ("runs.steps=3", "there is no group 'runs'; did you mean run?"),
        ("optimizer.learning_rate=3", "there is no group 'optimizer'; did you mean optimiser?"),
        ("run.steps=many", "run: steps must be int | None, at least 1; got str 'many'"),
        ("run.steps=2.5", "run: steps must be int | None, at least 1; got float 2.5"),
        ("run.steps=true", "run: steps must be int | None, at least 1; got bool True"),
        ("run.steps=0", "run: steps must be int | None, at least 1; got int 0"),
        ("run.tensorboard=1", "run: tensorboard must be bool; got int 1"),
        ("run.precision=tf32", "run: precision must be Literal['auto', 'no', 'bf16', 'fp16']; got str 'tf32'"),
        ("run.evaluate_views=0", "run: evaluate_views must be int | None, at least 1; got int 0"),
        ("run.minutes=-1", "run: minutes must be float | None, above 0; got int -1"),
        ("run.cpu_minutes=0", "run: cpu_minutes must be float | None, above 0; got int 0"),
        ("run.loss=iou", "run: loss must be Literal['bce', 'bce+iou']; got str 'iou'"),
        ("run.channels_last=maybe", "run: channels_last must be bool | None; got str 'maybe'"),
        ("data.views=[4,1]", "data: views must be a number or [low, high], low <= high; got (4, 1)"),
        ("data.views=[1,2,3]", "data: views must be int | tuple[int, int], from 1 to"),
        ("data.source=synthetic-13 ", None),
        ("data.pose_noise=270", "data: pose_noise must be float, from 0 to 180; got int 270"),
        ("optimiser.betas=[0.9,1.0]", "optimiser: betas must be two numbers in [0, 1)"),
        ("optimiser.schedule=linear", "optimiser: schedule must be Literal['constant', 'cosine']"),
        ("steps=3", "an override must be group.key=value, such as run.steps=100; got 'steps=3'"),
        ("run=3", "an override must be group.key=value"),
    ],
)
def test_a_wrong_override_is_reported(path, override, message):
    if message is None:
        assert read_config(path, [override]).data.source == "synthetic-13"
        return
    with pytest.raises(OptionError) as caught:
        read_config(path, [override])
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[run", "Expected ']'"),
        ("run = 3", "run must be a table of settings; got int 3"),
        ("[model]\nname = 'r2n2'", "steps, minutes or cpu_minutes must say when the run ends"),
        ("[run]\nsteps = 3\n[data]\nwokers = 1", "there is no data.wokers; did you mean data.workers?"),
        (
            "[run]\nminutes = 3\n[optimiser]\nschedule = 'cosine'",
            "steps or cpu_minutes must be given with optimiser.schedule = 'cosine'",
        ),
        ("[run]\nsteps = 3\n[data]\nviews = 30", "views must be at most data.pool = 20; got 30"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read_config(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_config(tmp_path / "none.toml")


def test_what_may_change_between_resumes():
    config = TrainingConfig(run=RunConfig(steps=10))
    assert {"run.steps", "data.workers", "run.evaluate_every"} <= set(config.free())
    assert not {"run.batch", "run.seed", "model.preset", "data.views", "optimiser.learning_rate"} & set(config.free())
    cosine = make_config({"run": {"steps": 10}, "optimiser": {"schedule": "cosine"}})
    assert "run.steps" not in cosine.free()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_are_configurations_of_models(path):
    config = read_config(path)
    if config.model.preset != "paper":
        create(config.model.name, preset=config.model.preset, variant=config.model.variant, **config.model.settings)


def test_there_are_examples():
    assert len(EXAMPLES) >= 6
