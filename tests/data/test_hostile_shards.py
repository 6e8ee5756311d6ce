"""Shards and sidecars that lie: a DataError that names the file, little memory, nothing written anywhere."""

import hashlib
import io
import json
import os
import struct
import tarfile
import zlib

import numpy as np
import pytest

from lsmgeo.data import ShardSet, verify_shard
from lsmgeo.data.shards import read_shards
from lsmgeo.errors import DataError
from tests.data.hostile import SIDECAR, TAR, TRIALS, judged, mutated, read_all, refused, rewritten
from tests.data.shapes import SETTINGS, write_set
from tests.fuzz import forked

pytestmark = pytest.mark.timeout(120)


def sealed(text):
    """The text of a sidecar without its check sum, or with one of that length: with one that fits."""
    start = '{"index_sha256":"'
    rest = text[len(start) + 66 :] if text.startswith(start) else text[1:]
    digest = hashlib.sha256(rest.encode("latin-1")).hexdigest()
    return f'{start}{digest}",{rest}'.encode("latin-1")


@pytest.fixture
def folder(tmp_path):
    write_set(tmp_path, shards=1, each=2, views=2)
    return tmp_path


@pytest.fixture
def index(folder):
    values = json.loads((folder / SIDECAR).read_text())
    del values["index_sha256"]
    return values


def to_version_1(index):
    """The sidecar as version 1 had it: check sums by shape, and positions, which are not read."""
    crc32 = index.pop("crc32")
    entries = [{"key": "00000000", "offsets": [0], "crc32": crc32[:7]}, {"crc32": crc32[7:]}]
    index.update(version=1, shapes=2, layouts=[["json"]], entries=entries)


SIDECARS = {
    "another format": (lambda i: i.update(format="x"), "is not the index of a shard"),
    "a newer version": (lambda i: i.update(version=3), "has version int 3"),
    "another tar": (lambda i: i.update(tar="../set-000000.tar"), "belongs to"),
    "another size": (lambda i: i.update(bytes=2**70), "belongs to"),
    "no size": (lambda i: i.pop("bytes"), "lacks 'bytes'"),
    "settings of any kind": (lambda i: i.update(settings=[1]), "settings must be"),
    "a long hash": (lambda i: i.update(sha256="0" * 65), "sha256 must be"),
    "few check sums": (lambda i: i["crc32"].pop(), "has 13 check sums; .* holds 14 members"),
    "a fraction": (lambda i: i["crc32"].__setitem__(2, 0.5), "float"),
    "text": (lambda i: i["crc32"].__setitem__(2, "1"), "str"),
    "a huge number": (lambda i: i["crc32"].__setitem__(2, 2**80), "too large|too big|long"),
    "another check sum": (lambda i: i["crc32"].__setitem__(0, -1), "json is damaged"),
    "check sums of any kind": (lambda i: i.update(crc32={"a": 1}), "str"),
    "no check sums": (lambda i: i.update(crc32=None), "None"),
    "version 1 of two shapes": (lambda i: (to_version_1(i), i["entries"].pop()), "has 7 check sums"),
    "version 1 without entries": (lambda i: i.update(version=1), "lacks 'entries'"),
    "version 1 of any kind": (lambda i: i.update(version=1, entries=["x"]), "str"),
}


@pytest.mark.parametrize("name", SIDECARS)
def test_sidecars_are_checked(folder, index, name):
    change, match = SIDECARS[name]
    change(index)
    (folder / SIDECAR).write_bytes(sealed(json.dumps(index)))
    refused(folder, match, TAR if "damaged" in match else SIDECAR)


def test_a_sidecar_of_version_1_is_a_seal_too(folder, index):
    to_version_1(index)
    (folder / SIDECAR).write_bytes(sealed(json.dumps(index)))
    assert len(read_all(folder)) == 2
    assert verify_shard(folder / TAR, SETTINGS)
    content = bytearray((folder / TAR).read_bytes())
    content[content.index(b"\x93NUMPY") + 130] ^= 1
    (folder / TAR).write_bytes(content)
    assert not verify_shard(folder / TAR, SETTINGS)
    refused(folder, "vox8.npy is damaged", TAR)


@pytest.mark.parametrize(
    ("content", "match"),
    [(b"", "not the index"), (b"null", "not the index"), (b'{"format":"lsmgeo shard index"}', "not the index"),
     (b"[" * 100_000, "not the index"), (bytes((1 << 24) + 1), "larger than the limit")],
)  # fmt: skip
def test_sidecars_of_other_content(folder, content, match):
    (folder / SIDECAR).write_bytes(content)
    refused(folder, match, SIDECAR)


@pytest.mark.parametrize(
    ("text", "match"),
    [("{", "not JSON"), ('{"a":\xff}', "not JSON"), ('{"a":' + "[" * 100_000, "not JSON"),
     ('{"a":1}', "lacks 'format'"),
     ('{"version":' + "9" * 100_000 + "}", "not JSON"), ('{"format":1}', "not the index of a shard")],
)  # fmt: skip
def test_sidecars_of_other_content_with_a_fitting_check_sum(folder, text, match):
    (folder / SIDECAR).write_bytes(sealed(text))
    refused(folder, match, SIDECAR)


@pytest.mark.parametrize("name", [TAR, SIDECAR])
def test_links_and_pipes(folder, tmp_path_factory, name):
    outside = tmp_path_factory.mktemp("outside")
    (folder / name).rename(outside / name)
    os.mkfifo(folder / name)
    refused(folder, "no such file", name)
    (folder / name).unlink()
    (folder / name).symlink_to(outside / name)
    if name == TAR:
        with pytest.raises(DataError, match="outside its folder"):
            read_all(folder)
    else:
        assert len(read_all(folder)) == 2  # content is checked, wherever it lies
    (folder / name).unlink()
    (folder / name).mkdir()
    refused(folder, "no such file", name)


def test_images_that_are_too_many_at_once(tmp_path, monkeypatch):
    """What a small file claims is neither read nor made; all that is asked for counts together."""
    write_set(tmp_path, shards=1, each=1, views=2)

    def enlarged(members):
        values = json.loads(members["00000000.json"])
        values["size"], values["views"] = [4096, 4096], 17
        values["cameras"] = {name: 9 * matrices[:1] + 8 * matrices[1:] for name, matrices in values["cameras"].items()}
        members["00000000.json"] = json.dumps(values).encode()
        for view in range(2, 17):
            members[f"00000000.{view:02d}.png"] = members["00000000.00.png"]

    rewritten(tmp_path, enlarged)
    shards = ShardSet(tmp_path)
    with pytest.raises(DataError, match=r"00000000: 17 views of 4096 x 4096 are more than .* read fewer views"):
        shards.read(0)
    with pytest.raises(DataError, match=r"is 16 x 12 pixels .* expected 4096 x 4096"):
        shards.read(0, views=range(16))
    folder = tmp_path / "small"
    write_set(folder, shards=1, each=1, views=2)
    monkeypatch.setattr(read_shards, "MAX_PIXELS_AT_ONCE", 2 * 12 * 16)
    assert len(ShardSet(folder).read(0, occupancy=8).images) == 2
    with pytest.raises(DataError, match=r"3 views of 12 x 16 are more than"):
        ShardSet(folder).read(0, views=[0, 1, 0], occupancy=8)


def test_folders_without_shards(tmp_path):
    for path, match in (
        (tmp_path, "holds no shard"),
        (tmp_path / "x", "cannot be read"),
        (tmp_path / "a\0b", "cannot"),
    ):
        with pytest.raises(DataError, match=match):
            ShardSet(path)


def header(name, size, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = size, kind, link
    return info.tobuf(tarfile.GNU_FORMAT)


def parted(folder, name):
    """A header whose name is in two fields."""
    content = bytearray(header(name, 0))
    content[345 : 345 + len(folder)] = folder.encode()
    content[148:156] = b" " * 8
    content[148:155] = b"%06o\0" % sum(content)
    return bytes(content)


def block(content):
    return content + bytes(-len(content) % 512)


END = bytes(1024)
TARS = {
    "nothing": (b"", "damaged tar header at byte 0"),
    "an empty tar": (bytes(10240), "must hold 1 to 10000 shapes; got 0"),
    "no tar": (b"x" * 2048, "damaged tar header at byte 0"),
    "half a header": (header("00000000.json", 2)[:300], "damaged tar header at byte 0"),
    "a size beyond the file": (header("00000000.json", 2**20), "announces 1048576 bytes"),
    "a size of another coding": (header("00000000.json", 2**33), "damaged tar header at byte 0"),
    "a negative size": (header("00000000.json", -1), "damaged tar header at byte 0"),
    "a path": (header("../00000000.json", 0) + END, "not a member of a shape"),
    "a path from the root": (header("/00000000.json", 0) + END, "not a member of a shape"),
    "a name with a path in it": (header("00000000./../json", 0) + END, "not a member of a shape"),
    "another file": (header("readme.txt", 0) + END, "not a member of a shape"),
    "a link": (header("00000000.json", 0, tarfile.SYMTYPE, "/etc/passwd"), "something other than regular files"),
    "a hard link": (header("00000000.json", 0, tarfile.LNKTYPE, "00000000.00.png"), "something other"),
    "a device": (header("00000000.json", 0, tarfile.CHRTYPE), "something other than regular files"),
    "a folder": (header("00000000.json", 0, tarfile.DIRTYPE), "something other than regular files"),
    "a sparse file": (header("00000000.json", 0, tarfile.GNUTYPE_SPARSE), "something other than regular files"),
    "a long name": (header("x", 600, tarfile.GNUTYPE_LONGNAME) + block(b"y" * 600), "something other"),
    "a long extension": (header("x", 1 << 17, tarfile.XHDTYPE) + bytes(1 << 17), "something other than regular files"),
    "no json": (header("00000000.00.png", 0) + END, "holds no 00000000.json"),
    "a member twice": (2 * header("00000000.00.png", 0) + END, "holds 00000000.00.png twice"),
    "no end": (header("00000000.00.png", 2) + block(b"{}"), "damaged tar header at byte 1024"),
    "a path in two parts": (parted("folder", "00000000.json") + END, "not a member of a shape"),
    "an empty json": (header("00000000.json", 0) + bytes(1024), "is not JSON"),
}


@pytest.mark.parametrize("name", TARS)
def test_tars_are_checked(tmp_path, name):
    content, match = TARS[name]
    (tmp_path / TAR).write_bytes(content)
    refused(tmp_path, match, TAR)


def changed_json(change):
    def apply(members):
        values = json.loads(members["00000000.json"])
        change(values)
        members["00000000.json"] = json.dumps(values).encode()

    return apply


def matrix(values, name, row, column, value):
    values["cameras"][name][1][row][column] = value


JSONS = {
    "another key": (lambda v: v.update(key="00000001"), "belongs to key"),
    "no name": (lambda v: v.update(name=None), "name must be a string"),
    "a name of any kind": (lambda v: v.update(name=["a"]), "name must be"),
    "a name of two lines": (lambda v: v.update(name="a\nb"), "name must be"),
    "no views": (lambda v: v.update(views=0), "views must be a whole number"),
    "many views": (lambda v: v.update(views=2**40), "views must be a whole number"),
    "other views": (lambda v: v.update(views=3), "must be 3 x 3 x 3 numbers"),
    "a view less": (lambda v: (v.update(views=1), [m.pop() for m in v["cameras"].values()]), "states 1 views"),
    "an invalid size": (lambda v: v.update(size=[12, 10**9]), "size: a side must be a whole number"),
    "another size": (lambda v: v.update(size=[4096, 4096]), "is 16 x 12 pixels .* expected 4096 x 4096"),
    "a size of any kind": (lambda v: v.update(size="12x16"), r"size must be \[height, width\]"),
    "a step of nothing": (lambda v: v.update(depth_step=0), "depth_step must be"),
    "a huge step": (lambda v: v.update(depth_step=1e300), "depth_step must be"),
    "no step": (lambda v: v.update(depth_step=None), "has no depth"),
    "a negative seed": (lambda v: v.update(seed=-1), "seed must be a whole number, at least 0"),
    "voxels of any kind": (lambda v: v.update(voxels=8), "voxels must be a list"),
    "many voxels": (lambda v: v.update(voxels=[10**6]), "voxels: a resolution must be a whole number"),
    "other voxels": (lambda v: v.update(voxels=[32]), "no occupancy of int 8 voxels; it has 32"),
    "no cameras": (lambda v: v.pop("cameras"), "lacks 'cameras'"),
    "cameras of any kind": (lambda v: v.update(cameras=[]), "cameras must be an object"),
    "a ragged camera": (lambda v: v["cameras"]["intrinsics"][1][1].pop(), "must be 2 x 3 x 3 numbers"),
    "a camera of text": (lambda v: matrix(v, "intrinsics", 0, 0, "1"), "must hold finite numbers"),
    "a camera of huge numbers": (lambda v: matrix(v, "intrinsics", 0, 0, 10**400), "must hold finite numbers"),
    "a camera of infinity": (lambda v: matrix(v, "intrinsics", 0, 0, float("inf")), "is not JSON .*Infinity"),
    "a camera without focal length": (lambda v: matrix(v, "intrinsics", 0, 0, 0), "intrinsics must be invertible"),
    "a camera that is not rigid": (lambda v: matrix(v, "cam_from_world", 0, 0, 3.0), "rotation must be orthonormal"),
}


@pytest.mark.parametrize("name", JSONS)
def test_jsons_are_checked(folder, name):
    change, match = JSONS[name]
    rewritten(folder, changed_json(change))
    refused(folder, match, TAR)


@pytest.mark.parametrize(
    ("content", "match"),
    [(b"\xff", "not JSON"), (b"[" * 100_000, "not JSON"), (b"[]", "expected an object"), (b"{}", "lacks 'key'"),
     (b" " * ((1 << 22) + 1), "larger than the limit")],
)  # fmt: skip
def test_jsons_of_other_content(folder, content, match):
    rewritten(folder, lambda members: members.update({"00000000.json": content}))
    refused(folder, f"00000000.json:? .*{match}", TAR)


def npy(array, version=(1, 0)):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version)
    return stream.getvalue()


def npy_header(text):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


GRID = np.zeros((8, 8, 1), np.uint8)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "not an array file"),
        (b"PK\x03\x04" + bytes(100), "not an array file"),
        (npy(GRID)[:-1], "holds 63 bytes of data"),
        (npy(GRID) + b"\0", "holds 65 bytes of data"),
        (npy(GRID, (2, 0)), "version is not 1.0"),
        (npy(np.zeros((16, 16, 2), np.uint8)), r"expected \(8, 8, 1\)"),
        (npy(np.zeros((8, 8, 1), np.float64)), r"expected \(8, 8, 1\)"),
        (npy(np.asfortranarray(np.zeros((8, 8, 2), np.uint8))[..., :1]), r"expected \(8, 8, 1\)"),
        (npy_header("{'descr': '|u1', 'fortran_order': False, 'shape': (100000, 100000, 9), }\n"), "expected"),
        (npy_header("{'descr': '|O', 'fortran_order': False, 'shape': (8, 8, 1), }\n"), "expected"),
        (npy_header("(" * 60000), "not an array file"),
        (npy_header("__import__('os').system('touch pwned')"), "not an array file"),
    ],
)
def test_arrays_are_checked(folder, content, match):
    rewritten(folder, lambda members: members.update({"00000000.vox8.npy": content}))
    refused(folder, match, TAR)
    assert not os.path.exists("pwned")


def listing(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("what", ["sidecar", "tar", "json", "fitting sidecar"])
def test_mutated_shards_are_refused_or_read(tmp_path, what):
    """Beyond errors: no crash, no hang, no gigabytes, no other file."""
    folder = tmp_path / "set"
    write_set(folder, shards=1, each=1, views=1)
    tar, sidecar = folder / TAR, folder / SIDECAR
    content, index = tar.read_bytes(), sidecar.read_bytes()
    size = int(content[124:135], 8)
    assert content[:13] == b"00000000.json"
    if what in ("tar", "json"):
        sidecar.unlink()
    before = listing(tmp_path)

    def judge(number):
        rng = np.random.default_rng([number, len(what)])
        if what == "sidecar":
            text = mutated(rng, index)
            sidecar.write_bytes(text if number % 4 == 0 else sealed(text.decode("latin-1")))
        elif what == "tar":
            tar.write_bytes(mutated(rng, content))
        else:
            # Bytes change in place, so that nothing before the json's own checks can refuse it.
            text = bytearray(content[512 : 512 + size])
            for at in rng.integers(size, size=int(rng.integers(1, 4))):
                text[at] = rng.choice(np.frombuffer(b'0123456789.-e,[]{}"naul', np.uint8))
            tar.write_bytes(content[:512] + bytes(text) + content[512 + size :])
            if what == "fitting sidecar":
                fitting = json.loads(index)
                fitting["crc32"][0] = zlib.crc32(text)
                sidecar.write_bytes(sealed(json.dumps(fitting)))
        return judged(lambda: read_all(folder))

    came = forked.outcomes(range(TRIALS), judge)
    assert set(came) <= {"refused", "read"}
    assert came.count("refused") > TRIALS // 4
    assert listing(tmp_path) == before
