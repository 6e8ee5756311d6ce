"""Training sets made by many workers, interrupted, resumed: always the same bytes."""

from __future__ import annotations

import hashlib
import importlib.util
import multiprocessing
import os
import signal
import sys
import time
import warnings
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch
import trimesh

from lsmgeo import cli, scenes
from lsmgeo.data import Recipe, ShardSet, render_set
from lsmgeo.data.shards.shape_sources import split_by_name
from lsmgeo.errors import DataError, OptionError
from lsmgeo.scenes import synthetic13

progress_of = sys.modules["lsmgeo.data.shards.render_set"]
RECIPE = Recipe(seed=3, views=2, size=24, voxels=(8, 16))
SHAPES, PER_SHARD = 7, 2


def contents(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, hidden ones too."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def make(folder: Path, jobs: int = 1, **options: object) -> Path:
    render_set("synthetic-13", folder, RECIPE, shapes=SHAPES, per_shard=PER_SHARD, jobs=jobs, **options)
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The set made by this process."""
    return make(tmp_path_factory.mktemp("alone"))


def test_a_set_holds_what_the_scenes_are(alone):
    shards = ShardSet(alone)
    assert len(shards) == SHAPES
    for index in (0, 3, 6):
        shape = synthetic13.shape(RECIPE.seed, index)
        cameras = synthetic13.views(RECIPE.seed, index, RECIPE.views, RECIPE.size)
        batch = type(cameras)(*(torch.as_tensor(value)[None] for value in cameras))
        expected = scenes.render([shape.scene], batch, shape.lights)
        sample = shards.read(index, occupancy=16)
        assert (sample.name, sample.category) == (shape.name, shape.category)
        assert torch.equal(sample.mask, expected.mask[0])
        torch.testing.assert_close(sample.images, expected.images[0], rtol=0, atol=0.5 / 255 + 1e-6)
        torch.testing.assert_close(sample.depth, expected.depth[0], rtol=0, atol=2.6e-5)
        torch.testing.assert_close(sample.cameras.cam_from_world.double(), cameras.cam_from_world, rtol=0, atol=1e-6)
        assert torch.equal(sample.occupancy, scenes.voxels([shape.scene], 16)[0])
        assert torch.equal(shards.read(index, occupancy=8).occupancy, scenes.voxels([shape.scene], 8)[0])


@pytest.mark.parametrize("workers", [2, 4])
def test_any_number_of_workers_gives_the_same_bytes(alone, tmp_path, workers):
    # Forked processes: they need not import everything again. The program's own way is tested below.
    with joblib.parallel_config("multiprocessing"):
        make(tmp_path, jobs=workers)
    assert contents(tmp_path) == contents(alone)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.long)])  # each imports for seconds
def test_a_dask_cluster_gives_the_same_bytes(alone, tmp_path, workers):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        arguments = ["render", "--out", str(tmp_path), "--cluster", cluster.scheduler_address, "--voxels", "8,16"]
        arguments += ["--shapes", str(SHAPES), "--views", "2", "--size", "24", "--seed", "3", "--per_shard", "2"]
        assert cli.main(arguments) == 0
    assert contents(tmp_path) == contents(alone)


def test_the_command_resumes_after_a_kill(alone, tmp_path, capsys):
    """Killed once a shard is there; run again with other processes, it keeps what is whole and makes the rest."""
    command = ["render", "--out", str(tmp_path), "--voxels", "8,16", "--seed", "3", "--per_shard", "2"]
    command += ["--shapes", str(SHAPES), "--views", "2", "--size", "24"]
    # Forked, since a new interpreter imports for seconds.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, which the child has none of
        process = multiprocessing.get_context("fork").Process(target=cli.main, args=([*command, "--jobs", "1"],))
        process.start()
    for _ in range(60000):
        if (tmp_path / "synthetic-13-000000.json").exists() or not process.is_alive():
            break
        time.sleep(0.001)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL, "the set was done before it could be interrupted"
    assert not (tmp_path / "synthetic-13-000003.json").exists()
    first = tmp_path / "synthetic-13-000000.tar"
    before = first.stat().st_mtime_ns
    assert cli.main([*command, "--jobs", "2"]) == 0
    assert "4 in " in capsys.readouterr().out
    assert first.stat().st_mtime_ns == before
    assert contents(tmp_path) == contents(alone)


def test_whole_shards_are_kept_and_damaged_ones_made_again(alone, tmp_path):
    make(tmp_path)
    second = tmp_path / "synthetic-13-000001.tar"
    content = bytearray(second.read_bytes())
    content[5000] ^= 1
    second.write_bytes(content)
    (tmp_path / "synthetic-13-000002.json").unlink()
    for left in ("000001.tar", "000002.json"):  # by a run that was killed
        (tmp_path / f".synthetic-13-{left}.0a1b2c3d.tmp").write_bytes(b"half")
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.tar")}
    made = render_set("synthetic-13", tmp_path, RECIPE, shapes=SHAPES, per_shard=PER_SHARD, jobs=1, progress=True)
    assert (made.kept, made.shapes, len(made.shards)) == (2, SHAPES, 4)
    assert contents(tmp_path) == contents(alone)
    changed = {path.name for path in tmp_path.glob("*.tar") if path.stat().st_mtime_ns != times[path.name]}
    assert changed == {"synthetic-13-000001.tar", "synthetic-13-000002.tar"}
    # The progress that a killed run reported is discarded.
    (tmp_path / ".progress").mkdir()
    (tmp_path / ".progress" / "synthetic-13-000000").write_bytes(bytes(1000))
    made = render_set("synthetic-13", tmp_path, RECIPE, shapes=SHAPES, per_shard=PER_SHARD, jobs=1, progress=True)
    assert made.kept == 4
    assert not (tmp_path / ".progress").exists()
    # Another recipe is refused, unless it is said that the set may go.
    other = RECIPE._replace(seed=4)
    before = contents(tmp_path)
    with pytest.raises(DataError, match=r"000000\.tar: was made with other settings"):
        render_set("synthetic-13", tmp_path, other, shapes=SHAPES, per_shard=PER_SHARD, jobs=1)
    assert contents(tmp_path) == before
    options = {"shapes": SHAPES, "per_shard": PER_SHARD, "jobs": 1, "overwrite": True}
    assert render_set("synthetic-13", tmp_path, other, **options).kept == 0
    assert contents(tmp_path).keys() == before.keys()


def test_shards_of_a_larger_set_are_not_taken_for_part_of_it(tmp_path):
    make(tmp_path)
    before = contents(tmp_path)
    for options in ({"shapes": 2, "per_shard": 2}, {"shapes": SHAPES, "per_shard": 3}):
        with pytest.raises(DataError, match="larger set"):
            render_set("synthetic-13", tmp_path, RECIPE, jobs=1, **options)
    assert contents(tmp_path) == before


def test_a_longer_set_begins_with_the_shorter(alone, tmp_path):
    render_set("synthetic-13", tmp_path, RECIPE, shapes=SHAPES + 3, per_shard=PER_SHARD, jobs=1)
    longer = contents(tmp_path)
    whole = {name: digest for name, digest in contents(alone).items() if "000003" not in name}  # the last one grows
    assert whole.items() <= longer.items()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A ShapeNet-like tree: two meshes that can be used and one that cannot."""
    root = tmp_path / "tree"
    for synset, name, mesh in (
        ("03001627", "first", trimesh.creation.box((1.0, 2.0, 0.5))),
        ("lamps", "second", trimesh.creation.icosphere(2)),
    ):
        folder = root / synset / name / "models"
        folder.mkdir(parents=True)
        mesh.export(folder / "model_normalized.obj")
    (root / "03001627" / "broken").mkdir()
    (root / "03001627" / "broken" / "model.obj").write_text("v 0 0 nan\nf 1 1 1\n")
    return root


def test_a_tree_of_meshes_becomes_a_set(tree, tmp_path):
    made = render_set(tree, tmp_path / "set", RECIPE, jobs=1)
    assert made.shapes == 2
    ((path, reason),) = made.skipped
    assert path.endswith("broken/model.obj")
    assert reason
    shards = ShardSet(tmp_path / "set")
    first, second = (shards.read(index, occupancy=16) for index in range(2))
    assert [first.category, second.category] == ["chair", "lamps"]
    assert first.mesh == "03001627/first/models/model_normalized.obj"
    # The box has the diagonal 1, so 1 : 2 : 0.5 becomes 2 : 4 : 1 parts of sqrt(21).
    expected = np.prod(np.array([2, 4, 1]) / np.sqrt(21))
    np.testing.assert_allclose(float(first.occupancy.double().mean()), expected, rtol=0.2)
    assert (first.depth[first.mask] > 1.4).all()
    assert (first.depth[~first.mask] == 0).all()
    again = render_set(tree, tmp_path / "again", RECIPE, jobs=1)
    assert again.shapes == 2
    assert contents(tmp_path / "set") == contents(tmp_path / "again")
    with joblib.parallel_config("multiprocessing"):
        render_set(tree, tmp_path / "many", RECIPE, per_shard=1, jobs=2)
    shared = ShardSet(tmp_path / "many")
    torch.testing.assert_close(shared.read(0, occupancy=16)[:5], first[:5], rtol=0, atol=0)
    with pytest.raises(DataError, match=r"model\.obj"):
        render_set(tree, tmp_path / "raise", RECIPE, jobs=1, on_error="raise")
    # Existing shards are kept, and shapes that were left out are reported again, or refused.
    kept = render_set(tree, tmp_path / "set", RECIPE, jobs=1)
    assert (kept.kept, [Path(path).name for path, _ in kept.skipped]) == (1, ["model.obj"])
    with pytest.raises(DataError, match=r"model\.obj"):
        render_set(tree, tmp_path / "set", RECIPE, jobs=1, on_error="raise")


def test_a_changed_mesh_is_rendered_again(tree, tmp_path):
    render_set(tree, tmp_path / "set", RECIPE, per_shard=1, jobs=1)
    path = tree / "lamps" / "second" / "models" / "model_normalized.obj"
    text = path.read_text()
    path.write_text(text.replace("0.5", "0.6", 1))
    assert path.stat().st_size == len(text)
    assert render_set(tree, tmp_path / "set", RECIPE, per_shard=1, jobs=1).kept == 1
    path.with_name("colours.mtl").write_text("newmtl red\nKd 1 0 0\n")
    assert render_set(tree, tmp_path / "set", RECIPE, per_shard=1, jobs=1).kept == 1
    assert render_set(tree, tmp_path / "set", RECIPE, per_shard=1, jobs=1).kept == 2
    # One that can no longer be used leaves no shard behind.
    path.write_text("f 1 2 3\n")
    assert render_set(tree, tmp_path / "set", RECIPE, per_shard=1, jobs=1).shapes == 1
    assert len(ShardSet(tmp_path / "set")) == 1


def test_one_model_in_two_formats_is_two_shapes(tmp_path):
    (tmp_path / "tree").mkdir()
    for ending in ("obj", "off"):
        trimesh.creation.box((1.0, 2.0, 0.5)).export(tmp_path / "tree" / f"model.{ending}")
    assert render_set(tmp_path / "tree", tmp_path / "set", RECIPE, jobs=1).shapes == 2
    assert ShardSet(tmp_path / "set").names == ["model.obj", "model.off"]


def test_a_tree_without_a_usable_mesh_is_an_error(tmp_path, capsys):
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "model.obj").write_text("nothing")
    with pytest.raises(DataError, match=r"no shape that can be used.*model\.obj"):
        render_set(tmp_path / "tree", tmp_path / "set", RECIPE, jobs=1)
    assert list((tmp_path / "set").iterdir()) == []
    (tmp_path / "tree" / "new\nline.obj").write_text("nothing")
    with pytest.raises(DataError, match="not printable"):
        render_set(tmp_path / "tree", tmp_path / "set", RECIPE, jobs=1)
    assert cli.main(["render", "--source", str(tmp_path / "tree"), "--out", str(tmp_path / "set")]) == 2
    assert "not printable" in capsys.readouterr().err


def test_splits_by_name_have_their_shares():
    parts = [split_by_name(f"{index:05d}") for index in range(20000)]
    shares = [parts.count(part) / len(parts) for part in ("train", "val", "test")]
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=0.012)  # four standard deviations


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"source": "synthetic-13"}, OptionError, "shapes must be given"),
        ({"source": "synthetic-13", "shapes": 0}, OptionError, "shapes must be a whole number"),
        ({"source": "synthetic-13", "shapes": 1.5}, OptionError, "shapes must be a whole number"),
        ({"source": "synthetic-13", "shapes": 3, "jobs": 0}, OptionError, "jobs must be at least 1"),
        ({"source": "nowhere", "shapes": 3}, DataError, "neither a folder of meshes"),
        ({"source": ".", "shapes": 3}, DataError, "holds no mesh"),
        ({"source": "synthetic-13", "shapes": 3, "recipe": Recipe(views=0)}, OptionError, "views must be"),
        ({"source": "synthetic-13", "shapes": 3, "recipe": Recipe(size=5000)}, OptionError, "size must be"),
        ({"source": "synthetic-13", "shapes": 3, "recipe": Recipe(voxels=(8, 8))}, OptionError, "voxels must be"),
        ({"source": "synthetic-13", "shapes": 3, "per_shard": 0}, OptionError, "per_shard must be"),
        ({"source": "synthetic-13", "shapes": 3, "on_error": "ignore"}, OptionError, "on_error must be"),
    ],
)
def test_bad_options_are_named(tmp_path, monkeypatch, options, error, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=words):
        render_set(out=tmp_path / "set", **{"jobs": 1, **options})
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "set").write_text("a file in the way")
    with pytest.raises(DataError, match="is a file"):
        make(tmp_path / "set")


def test_long_work_tells_a_log_how_far_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress_of, "SECONDS_BETWEEN_UPDATES", 0.01)
    monkeypatch.setattr(progress_of, "SECONDS_BETWEEN_LINES", 0.02)
    render_set("synthetic-13", tmp_path, RECIPE, shapes=30, per_shard=30, jobs=1, progress=True)
    told = [int(line.split(" of 60 views")[0]) for line in capsys.readouterr().err.splitlines() if " of 60" in line]
    assert told == sorted(told)
    assert (told[0], told[-1]) == (0, 60)
    assert len(told) > 3


@pytest.mark.parametrize("voxels", ["", "8,", "many", "8;16", "[8]"])
def test_resolutions_are_numbers_with_commas(tmp_path, capsys, voxels):
    arguments = ["render", "--shapes", "1", "--out", str(tmp_path / "set"), f"--voxels={voxels}"]
    assert cli.main(arguments) == 2
    assert "such as 32,64" in capsys.readouterr().err


def test_without_joblib_one_process_works(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "joblib", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    arguments = ["render", "--shapes", "1", "--views", "1", "--size", "16", "--voxels", "8"]
    assert cli.main([*arguments, "--out", str(tmp_path / "set")]) == 0
    assert "using one process" in capsys.readouterr().err


def test_a_cluster_that_does_not_answer_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lsmgeo.cli.render_command.CLUSTER_SECONDS", 0.5)
    arguments = ["render", "--shapes", "3", "--out", str(tmp_path / "set"), "--cluster", "tcp://127.0.0.1:9"]
    assert cli.main(arguments) == 2
    assert "127.0.0.1:9" in capsys.readouterr().err
