"""Files that earlier versions wrote load, and hold what they held."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from lsmgeo.data import verify_shard
from lsmgeo.models import load
from lsmgeo.models.weights import write_weights
from tests.compatibility.write_files import MODELS, output_of, shapes_of, what_they_hold
from tests.data.shapes import SETTINGS
from tests.training.runs import configure, losses, run

FOLDERS = sorted(path for path in Path(__file__).parent.glob("version_*") if path.is_dir())


@pytest.fixture(params=FOLDERS, ids=lambda path: path.name)
def files(request, tmp_path, monkeypatch) -> Path:
    """A copy of such a folder, which is the current one."""
    folder = shutil.copytree(request.param, tmp_path / "files")
    monkeypatch.chdir(folder)
    return folder


def assert_holds(found: object, expected: object, where: str = "") -> None:
    """Numbers are equal but for what another CPU rounds; all else is equal."""
    if isinstance(expected, dict):
        assert isinstance(found, dict), where
        assert found.keys() == expected.keys(), where
        for key in expected:
            assert_holds(found[key], expected[key], f"{where}/{key}")
    elif isinstance(expected, list):
        assert isinstance(found, list), where
        assert len(found) == len(expected), where
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_holds(one, other, f"{where}/{index}")
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-5), where
    else:
        assert found == expected, where


def test_everything_loads_and_holds_what_it_held(files):
    assert_holds(what_they_hold(), json.loads((files / "holds.json").read_text()))


def test_shards_open_without_their_sidecar(files):
    expected = {name: shapes_of(name) for name in ("shards", "depth")}
    for name in expected:
        (files / name / "set-000000.json").unlink()
        assert shapes_of(name) == expected[name]


def test_a_shard_is_verified_by_its_sidecar(files):
    shard = files / "depth" / "set-000000.tar"
    assert verify_shard(shard, SETTINGS)
    content = bytearray(shard.read_bytes())
    content[700] ^= 1
    shard.write_bytes(content)
    assert not verify_shard(shard, SETTINGS)


def test_a_run_goes_on_from_where_it_was(files):
    """All its losses are those of the same run now, never stopped; the last tells of Adam's state too."""
    configs = [configure(Path("shards"), keep=keep, steps=6, checkpoint_every=4) for keep in (1, 2)]
    trained = run(configs[0], files / "run")
    run(configs[1], files / "whole")
    assert (trained.step, trained.ended) == (6, "steps")
    assert_holds(losses(files / "run"), losses(files / "whole"))


@pytest.mark.parametrize("name", MODELS)
def test_weights_written_again_are_the_same(files, name):
    expected = output_of(name)
    write_weights(f"{name}.safetensors", load(f"{name}.safetensors"))
    assert output_of(name) == expected
