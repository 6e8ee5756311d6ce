"""Writing shards: in little memory, and wholly or not at all, whatever stops it."""

import io
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from lsmgeo.data import ShardSet, atomic_files, encode_sample, verify_shard, write_shard
from lsmgeo.data.shards import shard_index, write_shards
from lsmgeo.errors import DataError, OptionError
from tests.data.shapes import SETTINGS, assert_equal, make_shape

SAMPLE = make_shape(0).sample()
pytestmark = pytest.mark.timeout(120)


def test_shapes_are_written_one_at_a_time(tmp_path):
    """When the next shape is asked for, the one before is on its way to the disk, and nothing else is kept."""
    members = [encode_sample(SAMPLE._replace(name=str(key)), key) for key in range(40)]
    sizes = []

    def items():
        for key, content in enumerate(members):
            (temporary,) = tmp_path.glob(".a.tar.*.tmp")
            sizes.append(temporary.stat().st_size)
            yield key, content

    write_shard(tmp_path / "a.tar", items(), SETTINGS)
    each = sum(map(len, members[0].values()))
    written = np.diff(sizes)
    assert sizes[-1] > 35 * each
    assert written.max() < 3 * each + io.DEFAULT_BUFFER_SIZE


def test_errors_of_the_shapes_pass_unchanged(tmp_path):
    def items():
        yield 0, encode_sample(SAMPLE, 0)
        raise FileNotFoundError("mesh.obj")

    with pytest.raises(FileNotFoundError, match="mesh"):
        write_shard(tmp_path / "a.tar", items(), SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_reported(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_files.os, "fsync", full)
    with pytest.raises(DataError, match=r"a.tar: cannot be written .*No space left"):
        write_shard(tmp_path / "a.tar", [(0, encode_sample(SAMPLE, 0))], SETTINGS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("limit", "there", "match"),
    [
        ("MAX_SHAPES", 3, "more than 2 shapes"),
        ("MAX_MEMBERS", 27, "more than 26 members"),
        ("MAX_MEMBER_BYTES", None, "bytes, .* are the limit"),
    ],
)
def test_what_its_reader_would_refuse_is_not_written(tmp_path, monkeypatch, limit, there, match):
    items = [(key, make_shape(key).members(key)) for key in range(3)]
    path = write_shard(tmp_path / "a.tar", items, SETTINGS)
    sidecar = path.with_suffix(".json")
    content = path.read_bytes(), sidecar.read_bytes()
    if limit == "MAX_MEMBER_BYTES":
        there = max(len(member) for _, members in items for member in members.values())

    def limit_to(value):
        for module in (shard_index, write_shards):
            monkeypatch.setattr(module, limit, value)

    limit_to(there)
    write_shard(path, items, SETTINGS)
    assert len(ShardSet(tmp_path)) == 3
    limit_to(there - 1)
    with pytest.raises(DataError):
        ShardSet(tmp_path)
    with pytest.raises(OptionError, match=match):
        write_shard(path, items, SETTINGS)
    # What was there before is still there, and nothing else.
    assert (path.read_bytes(), sidecar.read_bytes()) == content
    assert sorted(os.listdir(tmp_path)) == ["a.json", "a.tar"]


class Stops:
    """Counts the steps at which a writer touches the disk, and kills its process at one of them."""

    def __init__(self, monkeypatch, at=None):
        self.count, self.at = 0, at
        for owner, name in ((atomic_files.AtomicFile, "write"), (atomic_files.os, "fsync"), (Path, "replace"),
                            (Path, "unlink")):  # fmt: skip
            monkeypatch.setattr(owner, name, self.wrapped(getattr(owner, name)))

    def wrapped(self, function):
        def run(*arguments, **options):
            self.step()
            result = function(*arguments, **options)
            self.step()
            return result

        return run

    def step(self):
        if self.count == self.at:
            os.kill(os.getpid(), signal.SIGKILL)
        self.count += 1


@pytest.mark.parametrize("before", ["nothing", "other"])
def test_a_killed_writer_leaves_no_half_shard(tmp_path, monkeypatch, before):
    shape, other = make_shape(0, views=1), make_shape(1, views=1)
    items = [(0, shape.members(0))]
    expected = tmp_path / "expected"
    expected.mkdir()
    with monkeypatch.context() as patch:
        stops = Stops(patch)
        write_shard(expected / "a.tar", items, SETTINGS)
    assert stops.count > 30
    for at in range(stops.count):
        folder = tmp_path / str(at)
        path = folder / "a.tar"
        folder.mkdir()
        if before == "other":
            write_shard(path, [(0, other.members(0))], "other settings")
        child = os.fork()
        if child == 0:
            try:
                Stops(monkeypatch, at)
                write_shard(path, items, SETTINGS)
            finally:
                os._exit(0)
        assert os.waitpid(child, 0)[1] == signal.SIGKILL
        # What is there is whole: the old shard, the new one, or none.
        done = verify_shard(path, SETTINGS)
        if path.exists():
            read = ShardSet(folder).read(0, occupancy=8)
            assert_equal(read, shape if read.name == shape.name else other, range(1))
            assert read.name == shape.name or not done
        else:
            assert before == "nothing"
            assert not done
        write_shard(path, items, SETTINGS)
        assert verify_shard(path, SETTINGS)
        assert {name for name in os.listdir(folder) if not name.endswith(".tmp")} == {"a.json", "a.tar"}
        for name in ("a.json", "a.tar"):
            assert (folder / name).read_bytes() == (expected / name).read_bytes()
