"""Checkpoints come back as they were saved, or not at all: whatever was killed, full, damaged or newer."""

from __future__ import annotations

import hashlib
import json
import os
import random
import resource
import shutil
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from lsmgeo.errors import CheckpointError, OptionError
from lsmgeo.models import create, load
from lsmgeo.models.weights import fill_model
from lsmgeo.training import checkpoints
from lsmgeo.training.checkpoints import check_config, load_latest, save_checkpoint
from tests.training.faults import Points, fill, in_child, kill, leftovers

CONFIG = {"model": {"name": "voxel-lsm", "sizes": [1, 2]}, "run": {"batch": 4, "steps": 10}, "processes": 1}
FILES = ("model.safetensors", "state.pt", "meta.json")


class Training:
    """A model, its optimiser, a generator, and steps that only a good resume repeats."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.model = create("voxel-lsm", preset="tiny", encoder_channels=(4, 4), grid_channels=(4,), hidden_channels=4)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=0.01)
        self.generator = torch.Generator().manual_seed(0)
        self.step = 0

    def advance(self) -> float:
        self.step += 1
        factors = (torch.rand(weights.shape, generator=self.generator) for weights in self.model.parameters())
        loss = sum((weights * by).sum() for weights, by in zip(self.model.parameters(), factors, strict=True))
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()

    def save(self, folder: Path, **options) -> Path:
        state = {"optimiser": self.optimiser.state_dict(), "generator": self.generator.get_state(), "best": None}
        return save_checkpoint(folder, self.step, model=self.model, state=state, config=CONFIG, **options)

    def resume(self, path: Path) -> None:
        checkpoint = load_latest(path)
        fill_model(self.model, checkpoint.weights)
        checkpoint.restore("optimiser", self.optimiser)
        self.generator.set_state(checkpoint.part("generator"))
        self.step = checkpoint.step


@pytest.fixture(scope="module")
def expected() -> list[float]:
    """The losses of steps 1 to 6 of a run that nothing happens to."""
    training = Training()
    return [training.advance() for _ in range(6)]


@pytest.fixture(scope="module")
def original(tmp_path_factory, expected) -> Path:
    """A run folder with the checkpoints of steps 1 and 2."""
    run = tmp_path_factory.mktemp("run")
    training = Training()
    for _ in range(2):
        training.advance()
        training.save(run / "checkpoints")
    return run


@pytest.fixture
def run(original, tmp_path) -> Path:
    return shutil.copytree(original, tmp_path / "run")


def losses_from(path: Path) -> tuple[int, list[float]]:
    """Where a run resumes, and the losses of its steps up to 4."""
    training = Training()
    training.resume(path)
    begin = training.step
    return begin, [training.advance() for _ in range(begin, 4)]


def assert_same(found: checkpoints.Checkpoint, expected: checkpoints.Checkpoint) -> None:
    torch.testing.assert_close(found.weights.tensors, expected.weights.tensors, rtol=0, atol=0)
    torch.testing.assert_close(found.part("optimiser"), expected.part("optimiser"), rtol=0, atol=0)
    torch.testing.assert_close(found.part("generator"), expected.part("generator"), rtol=0, atol=0)


def damage(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def test_a_resumed_run_takes_the_same_steps(run, expected):
    begin, losses = losses_from(run)
    assert begin == 2
    assert losses == expected[2:4]
    assert load_latest(run / "checkpoints").step == load_latest(run / "checkpoints" / "step_00000002").step == 2


@pytest.mark.parametrize("part", ["optimiser", "generator"])
def test_each_part_of_the_state_matters(run, expected, part):
    """The comparison above can fail: what is not restored shows within two steps."""
    training, checkpoint = Training(), load_latest(run)
    fill_model(training.model, checkpoint.weights)
    if part != "optimiser":
        checkpoint.restore("optimiser", training.optimiser)
    if part != "generator":
        training.generator.set_state(checkpoint.part("generator"))
    assert [training.advance(), training.advance()] != expected[2:4]


def test_the_last_ones_and_the_best_are_kept(tmp_path):
    training = Training()
    for step in range(1, 7):
        training.advance()
        training.save(tmp_path, keep=2, best=2 if step > 1 else None)
        assert (tmp_path / "LATEST").read_text() == f"step_{step:08d}\n"
    assert sorted(os.listdir(tmp_path)) == ["LATEST", "step_00000002", "step_00000005", "step_00000006"]
    assert load_latest(tmp_path).best == 2
    training.advance()
    training.save(tmp_path, keep=2, best=7)
    assert sorted(os.listdir(tmp_path)) == ["LATEST", "step_00000006", "step_00000007"]


def test_meta_describes_the_files(run):
    folder = run / "checkpoints" / "step_00000002"
    meta = json.loads((folder / "meta.json").read_text())
    for name in FILES[:2]:
        content = (folder / name).read_bytes()
        assert meta["files"][name] == {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert (meta["step"], meta["config"], meta["format"]) == (2, CONFIG, 1)
    assert meta["versions"]["torch"] == torch.__version__
    assert set(os.listdir(folder)) == set(FILES)


def test_nothing_saved_is_no_error_and_everything_lost_is_one(run, tmp_path):
    assert load_latest(tmp_path / "never") is None
    for step in (1, 2):
        shutil.rmtree(run / "checkpoints" / f"step_{step:08d}")
    with pytest.raises(CheckpointError, match=r"step_00000002: is missing, and LATEST names it"):
        load_latest(run)


def test_a_missing_newest_one_is_reported(run):
    shutil.rmtree(run / "checkpoints" / "step_00000002")
    with pytest.warns(UserWarning, match=r"step_00000002: is missing.* Going back to .*step_00000001"):
        assert load_latest(run).step == 1


# Kills and full disks (F1, F2)


@pytest.fixture
def third(run) -> Training:
    """A run that has come to step 3 and not saved it."""
    training = Training()
    training.resume(run)
    training.advance()
    return training


def count_points(training: Training, run: Path, tmp_path: Path) -> list[str]:
    copy, points = shutil.copytree(run, tmp_path / "counted"), Points()
    with points.counted():
        training.save(copy / "checkpoints", keep=2)
    return points.calls


def test_a_kill_at_any_moment_of_a_save_leaves_the_old_or_the_new_one(run, third, tmp_path, expected):
    calls = count_points(third, run, tmp_path)
    assert len(calls) >= 30
    assert {"mkdir", "write", "fsync", "replace", "unlink"} <= set(calls)
    whole = {2: load_latest(run), 3: load_latest(tmp_path / "counted")}
    begins = []
    for at in range(len(calls)):
        copy = shutil.copytree(run, tmp_path / str(at))

        def save(copy=copy, at=at) -> None:
            with Points(kill, at).counted():
                third.save(copy / "checkpoints", keep=2)

        assert in_child(save) == -signal.SIGKILL
        found = load_latest(copy)  # no warning: nothing is damaged
        assert_same(found, whole[found.step])
        begins.append(found.step)
        # The next save clears up.
        third.save(copy / "checkpoints", keep=2)
        assert sorted(os.listdir(copy / "checkpoints")) == ["LATEST", "step_00000002", "step_00000003"]
    # From one moment on it is the new one, for good.
    assert begins == sorted(begins)
    assert set(begins) == {2, 3}
    for at in (begins.index(3) - 1, begins.index(3)):
        begin, losses = losses_from(tmp_path / str(at))
        assert losses == expected[begin:4]


def test_a_kill_while_a_checkpoint_is_replaced_loses_none(run, tmp_path):
    shutil.rmtree(run / "checkpoints" / "step_00000001")  # the only one
    training = Training()
    training.resume(run)

    def replace(folder: Path, points: Points) -> None:
        with points.counted():
            training.save(folder / "checkpoints")

    points = Points()
    replace(shutil.copytree(run, tmp_path / "counted"), points)
    assert points.calls.count("replace") == 6  # three files, the old folder, the new one, LATEST
    for at in [at for at, name in enumerate(points.calls) if name in ("replace", "rmdir", "unlink")]:
        copy = shutil.copytree(run, tmp_path / str(at))
        assert in_child(lambda copy=copy, at=at: replace(copy, Points(kill, at))) == -signal.SIGKILL
        assert load_latest(copy).step == 2
        assert load(copy).name == "voxel-lsm"
        replace(copy, Points())
        assert leftovers(copy / "checkpoints") == []
        assert load_latest(copy).step == 2


def test_what_a_killed_run_of_an_earlier_version_left_is_cleared(run, third):
    (run / "checkpoints" / "step_00000003.tmp-17").mkdir()
    (run / "checkpoints" / "LATEST.tmp-17").write_bytes(b"step")
    (run / "checkpoints" / "step_00000002").rename(run / "checkpoints" / "step_00000002.old-17")
    third.save(run / "checkpoints")
    assert sorted(os.listdir(run / "checkpoints")) == ["LATEST", *(f"step_0000000{step}" for step in (1, 2, 3))]


def test_a_disk_that_is_full_at_any_moment_of_a_save_is_reported_and_harms_nothing(run, third, tmp_path):
    calls = count_points(third, run, tmp_path)
    told = []
    for at, name in enumerate(calls):
        if name in ("close", "unlink", "rmdir"):
            continue  # need no room
        copy = shutil.copytree(run, tmp_path / str(at))
        with warnings.catch_warnings(record=True) as caught, Points(fill, at).counted():
            warnings.simplefilter("always")
            try:
                third.save(copy / "checkpoints", keep=2)
                told.append(str(caught[0].message))
            except CheckpointError as error:
                told.append(str(error))
        is_saved = "is saved" in told[-1]
        assert is_saved or "step_00000003: cannot be written" in told[-1]
        assert "[Errno 28] No space left on device" in told[-1]
        assert is_saved or leftovers(copy / "checkpoints") == []
        with warnings.catch_warnings(record=True):
            assert load_latest(copy).step in ((3,) if is_saved else (2, 3))
        # Once there is room again, all is as if nothing had been.
        third.save(copy / "checkpoints", keep=2)
        assert sorted(os.listdir(copy / "checkpoints")) == ["LATEST", "step_00000002", "step_00000003"]
    assert "is saved" in told[-1]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_limit_on_the_size_of_files_is_reported_and_harms_nothing(run, third, share):
    largest = max((run / "checkpoints" / "step_00000002" / name).stat().st_size for name in FILES)

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * largest), resource.RLIM_INFINITY))
        with pytest.raises(CheckpointError, match=r"cannot be written \(.*File too large"):
            third.save(run / "checkpoints")
        assert leftovers(run / "checkpoints") == []
        assert load_latest(run).step == 2
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        third.save(run / "checkpoints")

    assert in_child(work) == 0
    assert load_latest(run).step == 3


# Read-only and vanished folders (F8)


def test_a_read_only_folder_is_reported(run, third, monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(30, os.strerror(30))

    monkeypatch.setattr(os, "mkdir", refuse)
    with pytest.raises(CheckpointError, match="Read-only file system"):
        third.save(run / "checkpoints")
    assert load_latest(run).step == 2


def test_a_file_in_the_way_is_reported(tmp_path):
    (tmp_path / "checkpoints").write_text("")
    with pytest.raises(CheckpointError, match="cannot be written"):
        Training().save(tmp_path / "checkpoints")


def test_a_vanished_folder_is_made_again(run, expected):
    training = Training()
    training.resume(run)
    shutil.rmtree(run)
    assert training.advance() == expected[2]
    training.save(run / "checkpoints")
    assert losses_from(run) == (3, expected[3:4])


# Damage (F3, F4)


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_never_read(run, expected, name):
    path = run / "checkpoints" / "step_00000002" / name
    content = path.read_bytes()
    for number, length in enumerate(np.linspace(0, len(content) - 1, 64).astype(int)):
        damage(path, content[:length])
        with pytest.raises(CheckpointError, match=name):
            load_latest(path.parent)
        if number % 21:
            continue
        with pytest.warns(UserWarning, match=rf"step_00000002.{name}.* Going back to .*step_00000001"):
            assert load_latest(run).step == 1
    damage(path, content + b"\0")
    with pytest.raises(CheckpointError, match=name):
        load_latest(path.parent)
    damage(path, content)
    assert losses_from(run) == (2, expected[2:4])


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [67, pytest.param(1000, marks=pytest.mark.long)])
def test_a_flipped_bit_is_never_read(run, name, count):
    path = run / "checkpoints" / "step_00000002" / name
    content = path.read_bytes()
    bits = random.Random(count).sample(range(8 * len(content)), count)
    before = json.loads((path.parent / "meta.json").read_text())
    for bit in bits:
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        damage(path, bytes(flipped))
        with pytest.raises(CheckpointError):
            load_latest(path.parent)
    damage(path, content)
    assert load_latest(path.parent).config == before["config"]


def test_two_damaged_ones_are_both_named(run, third):
    third.save(run / "checkpoints")
    for step in (2, 3):
        damage(run / "checkpoints" / f"step_{step:08d}" / "state.pt", b"")
    with pytest.warns(UserWarning, match=r"step_00000003.*step_00000002.* Going back to .*step_00000001"):
        assert load_latest(run).step == 1
    damage(run / "checkpoints" / "step_00000001" / "state.pt", b"")
    with pytest.raises(CheckpointError, match=r"no checkpoint verifies: .*step_00000003.*step_00000002.*step_00000001"):
        load_latest(run)


@pytest.mark.parametrize("content", [b"", b"step_00000001", b"step_99", b"\xff" * 10, b"../elsewhere", b"x" * 1000])
def test_a_damaged_pointer_harms_nothing(run, content):
    (run / "checkpoints" / "LATEST").write_bytes(content)
    assert load_latest(run).step == 2


def test_a_damaged_one_is_replaced_when_the_run_comes_back_to_its_step(run, expected):
    damage(run / "checkpoints" / "step_00000002" / "state.pt", b"")
    training = Training()
    with pytest.warns(UserWarning, match="Going back"):
        training.resume(run)
    assert training.advance() == expected[1]
    training.save(run / "checkpoints")
    assert losses_from(run) == (2, expected[2:4])


def test_a_checkpoint_under_another_name_is_refused(run):
    (run / "checkpoints" / "step_00000001").rename(run / "checkpoints" / "step_00000009")
    with pytest.warns(UserWarning, match=r"step_00000009: is the checkpoint of step 1"):
        assert load_latest(run).step == 2


# Other runs, other versions (F9)


def rewrite(folder: Path, change) -> None:
    """Change meta.json, with a checksum that is right."""
    meta = json.loads((folder / "meta.json").read_text())
    del meta["sha256"]
    change(meta)
    canonical = json.dumps(meta, sort_keys=True, separators=(",", ":"))
    meta["sha256"] = hashlib.sha256(canonical.encode()).hexdigest()
    (folder / "meta.json").write_text(json.dumps(meta))


def test_a_newer_format_is_refused_not_passed_over(run):
    rewrite(run / "checkpoints" / "step_00000002", lambda meta: meta.update(format=2))
    with pytest.raises(CheckpointError, match="is of format 2, made by a newer lsmgeo; this one reads up to 1"):
        load_latest(run)


@pytest.mark.parametrize("key", ["step", "best", "files", "config"])
def test_a_checkpoint_that_lacks_something_is_refused(run, key):
    folder = run / "checkpoints" / "step_00000002"
    rewrite(folder, lambda meta: meta.pop(key))
    with pytest.raises(CheckpointError, match=f"lacks what a checkpoint needs .*{key}"):
        load_latest(folder)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"run": {"batch": 8, "steps": 10}}, r"run.batch was 4 and is 8 now"),
        ({"processes": 2}, r"processes was 1 and is 2 now"),
        ({"model": {"name": "r2n2", "sizes": [1, 2]}}, r"model.name was 'voxel-lsm' and is 'r2n2' now"),
        ({"model": {"name": "voxel-lsm", "sizes": (1, 3)}}, r"model.sizes was \[1, 2\] and is \[1, 3\] now"),
        ({"run": {"steps": 10}}, r"run.batch was 4 and is 'missing' now"),
        ({"extra": 1}, r"extra was 'missing' and is 1 now"),
    ],
)
def test_another_run_is_refused_by_the_name_of_what_differs(run, change, match):
    with pytest.raises(CheckpointError, match=match):
        check_config(load_latest(run), {**CONFIG, **change}, free=("run.steps",))


def test_what_is_free_may_differ(run):
    checkpoint = load_latest(run)
    check_config(checkpoint, {**CONFIG, "model": {"name": "voxel-lsm", "sizes": (1, 2)}})
    check_config(checkpoint, {**CONFIG, "run": {"batch": 4, "steps": 20}}, free=("run.steps",))


def test_a_state_that_does_not_fit_is_refused_by_name(run):
    checkpoint = load_latest(run)
    with pytest.raises(CheckpointError, match=r"state.pt has no 'scaler'; it has best, generator, optimiser"):
        checkpoint.part("scaler")
    other = create("voxel-lsm", preset="tiny")
    with pytest.raises(CheckpointError, match=r"holds \S+ as \(4,\) float32; the model has \(8,\) float32"):
        fill_model(other, checkpoint.weights)
    training = Training()
    parameters = [torch.nn.Parameter(torch.zeros(3, *weights.shape)) for weights in training.model.parameters()]
    with pytest.raises(CheckpointError, match=r"optimiser does not fit this run: exp_avg of parameter 0 is"):
        checkpoint.restore("optimiser", torch.optim.Adam(parameters))
    with pytest.raises(CheckpointError, match="optimiser does not fit this run"):
        checkpoint.restore("optimiser", torch.optim.Adam(parameters[:2]))
    with pytest.raises(CheckpointError, match="generator does not fit this run"):
        checkpoint.restore("generator", training.optimiser)


def test_what_cannot_be_read_back_is_not_saved(tmp_path):
    model = Training().model
    with pytest.raises(OptionError, match="state must consist of numbers, text and tensors"):
        save_checkpoint(tmp_path, 1, model=model, state={"folder": np.random.default_rng()}, config={})
    with pytest.raises(OptionError, match="config must consist of what JSON has"):
        save_checkpoint(tmp_path, 1, model=model, state={}, config={"x": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_code_in_a_state_is_not_run(run, tmp_path):
    """With a checksum that is right: who can write the file can write the checksum."""

    class Payload:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    folder = run / "checkpoints" / "step_00000002"
    torch.save({"optimiser": Payload()}, folder / "state.pt")
    content = (folder / "state.pt").read_bytes()
    entry = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    rewrite(folder, lambda meta: meta["files"].update({"state.pt": entry}))
    with pytest.raises(CheckpointError, match=r"state.pt: cannot be read"):
        load_latest(folder)
    assert not (tmp_path / "ran").exists()
