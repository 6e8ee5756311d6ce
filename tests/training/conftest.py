"""Runs that tests share: made once per module, copied where a test resumes them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lsmgeo.training import TrainingConfig
from tests.training.runs import configure, run, write_shapes


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    return write_shapes(tmp_path_factory.mktemp("shards"))


@pytest.fixture(scope="module")
def config(shards) -> TrainingConfig:
    return configure(shards)


@pytest.fixture(scope="module")
def whole(config, tmp_path_factory) -> Path:
    """A run of 6 steps, two epochs, that nothing happens to; it saves at 2, 4 and 6."""
    folder = tmp_path_factory.mktemp("whole")
    assert run(config, folder).ended == "steps"
    return folder


@pytest.fixture(scope="module")
def half(shards, tmp_path_factory) -> Path:
    """The first 2 steps of it."""
    folder = tmp_path_factory.mktemp("half")
    run(configure(shards, steps=2), folder)
    return folder


@pytest.fixture
def begun(half, tmp_path) -> Path:
    return shutil.copytree(half, tmp_path / "run")


@pytest.fixture(scope="module")
def plain(shards, tmp_path_factory) -> Path:
    """Three steps of four shapes with one or two views."""
    folder = tmp_path_factory.mktemp("plain")
    run(configure(shards, steps=3, batch=4), folder)
    return folder
