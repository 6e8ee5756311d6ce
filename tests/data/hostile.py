"""Damaging shards and scenes, and saying what became of reading them."""

import io
import os
import struct
import tarfile
import zlib

import numpy as np
import pytest

from lsmgeo import data
from lsmgeo.data import ShardSet
from lsmgeo.errors import DataError

TAR, SIDECAR = "set-000000.tar", "set-000000.json"
# How many mutations of a file are tried: more in `make test-long`.
TRIALS = 2000 if os.environ.get("HYPOTHESIS_PROFILE") == "long" else 100


def chunk(kind, content, crc=None):
    """Of a PNG."""
    crc = zlib.crc32(kind + content) if crc is None else crc
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)


def read_all(folder):
    shards = ShardSet(folder)
    samples = [shards.read(index, occupancy=8) for index in range(len(shards))]
    for sample in samples:
        assert all(tensor.isfinite().all() for tensor in (sample.images, sample.depth, *sample.cameras[:2]))
    return samples


def refused(folder, match, file):
    with pytest.raises(DataError, match=match) as caught:
        read_all(folder)
    assert str(caught.value.path) == str(folder / file)
    assert str(folder / file) in str(caught.value)


def rewritten(folder, change):
    """The shard without its sidecar, members changed by ``change(members)``."""
    (folder / SIDECAR).unlink()
    with tarfile.open(folder / TAR) as tar:
        members = {info.name: tar.extractfile(info).read() for info in tar.getmembers()}
    change(members)
    with tarfile.open(folder / TAR, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))


def mutated(rng, content, fewest=1, most=4):
    content = bytearray(content)
    for _ in range(int(rng.integers(fewest, most + 1))):
        kind, at = rng.integers(10), int(rng.integers(len(content)))
        if kind == 0:
            del content[at : at + int(rng.integers(1, 64))]
        elif kind == 1:
            content[at:at] = rng.integers(0, 256, int(rng.integers(1, 64)), np.uint8).tobytes()
        elif kind == 2:
            content[at] = rng.choice(np.frombuffer(b'\x00\xff0{}[],:"-', np.uint8))
        else:
            content[at] = int(rng.integers(256))
        if not content:
            break
    return bytes(content)


def judged(run):
    try:
        run()
    except DataError:
        return "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:300]
    return "read"


def read_scene(folder):
    """A scene of which everything has been read, and is finite."""
    scene = data.open(folder)
    assert all(part.isfinite().all() for part in scene.cameras[:2])
    for view in range(len(scene)):
        scene.load(view)
        depth = scene.load_depth(view)
        assert depth is None or bool((depth.isfinite() & (depth >= 0)).all())
    for observed in scene.points.observations if scene.points else ():
        assert np.isfinite(observed.pixels).all()
    return scene


def scene_refused(folder, match=None, file=None):
    """A scene is refused, by the name of a file of it and briefly."""
    with pytest.raises(DataError, match=match) as caught:
        read_scene(folder)
    path = str(caught.value.path)
    assert path.startswith(str(folder)) if file is None else path == str(folder / file)
    assert path in str(caught.value)
    assert len(str(caught.value)) < 2000


def judge_mutations(folder, file, run):
    """Whatever is changed in a file, it is read or refused, and no file of the folder changes."""
    rng = np.random.default_rng(0)
    original = file.read_bytes()
    before = sorted((str(path), path.stat().st_size) for path in folder.rglob("*"))
    verdicts = []
    for _ in range(TRIALS):
        file.write_bytes(mutated(rng, original))
        verdicts.append(judged(run))
    file.write_bytes(original)
    assert set(verdicts) <= {"read", "refused"}
    assert verdicts.count("refused") > TRIALS // 20
    assert sorted((str(path), path.stat().st_size) for path in folder.rglob("*")) == before
