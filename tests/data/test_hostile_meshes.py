"""Mesh files that lie: a DataError that names the file, in bounded memory, and nothing read or written elsewhere."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lsmgeo.data import load_mesh
from lsmgeo.data.meshes import mesh_parsing
from lsmgeo.errors import DataError
from tests.data import mesh_writers as writers

pytestmark = pytest.mark.timeout(120)

LITTLE, BIG, TEXT = (writers.ply(form) for form in ("binary_little_endian", "binary_big_endian", "ascii"))
HEAD = LITTLE.index(b"end_header\n") + len(b"end_header\n")
FIRST = struct.pack("<4i", *writers.QUADS[0])
PACKED = {"attributes": {"POSITION": 0}, "extensions": {"KHR_draco_mesh_compression": {"bufferView": 0}}}
MANY = str(10**15).encode()


def refused(tmp_path, name, content, match, **options):
    path = tmp_path / name
    path.write_bytes(content)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match=match) as caught:
        load_mesh(path, **options)
    assert str(caught.value.path) in str(caught.value)
    assert Path(caught.value.path).is_relative_to(tmp_path)
    assert sorted(tmp_path.rglob("*")) == before


def changed(**changes):
    return writers.glb(writers.gltf(**changes))


def text(**changes):
    return json.dumps(writers.gltf(**changes)).encode()


def accessor(index, **changes):
    accessors = writers.gltf()["accessors"]
    accessors[index] |= changes
    return {"accessors": [{k: v for k, v in item.items() if v is not None} for item in accessors]}


ATTACKS = [
    ("empty.obj", b"", "holds no face"),
    ("points.obj", b"v 0 0 0\nv 1 0 0\n", "holds no face"),
    ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "names vertex 4, of 3"),
    ("back.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "names vertex -4, of 3"),
    ("zero.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "names vertex 0"),
    ("later.obj", b"f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0\n", "names vertex 1, of 0"),
    ("huge.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999999999\n", "names vertex|damaged"),
    ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    ("infinite.obj", b"v 0 0 1e400\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    ("far.obj", b"v 0 0 1e300\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1e15"),
    ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n", "no face with an area"),
    ("two.obj", b"v 0 0\nf 1 1 1\n", "a vertex has 2 numbers"),
    ("word.obj", b"v 0 0 zero\n", "damaged"),
    ("digits.obj", b"v 0 0 " + b"9" * 100 + b"\n", "64 characters"),
    ("line.obj", b"v" + b" 0" * 50_000, "line of more than"),
    ("binary.obj", b"v 0 0 0\n\0", "zero byte"),
    ("ngon.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 500 + b"\n", "the limit is 1000"),
    ("head.ply", LITTLE[:40], "damaged|no header"),
    ("other.ply", b"plyx" + LITTLE[3:], "no header"),
    ("count.ply", LITTLE.replace(b"vertex 8", b"vertex " + MANY), "unexpected length"),
    ("faces.ply", LITTLE.replace(b"face 6", b"face 4000000000"), "unexpected length"),
    ("strange.ply", LITTLE.replace(b"strange 2", b"strange " + MANY), "unexpected length"),
    ("nothing.ply", LITTLE.replace(b"face 6", b"face 0"), "damaged"),
    ("minus.ply", LITTLE.replace(b"vertex 8", b"vertex -8"), "damaged"),
    ("short.ply", LITTLE[:-30], "unexpected length"),
    ("big.ply", BIG[:-30], "unexpected length"),
    ("text.ply", TEXT[:-30], "ends inside a list|ends after|too few|damaged"),
    ("count_text.ply", TEXT.replace(b"vertex 8", b"vertex " + MANY), "damaged|ends after"),
    ("format.ply", LITTLE.replace(b"binary_little_endian", b"binary_middle_endian"), "no header"),
    ("type.ply", LITTLE.replace(b"property float y", b"property quad y"), "quad"),
    ("list.ply", LITTLE.replace(b"list uchar int", b"list float int"), "damaged"),
    ("line.ply", LITTLE.replace(b"comment made", b"execute made"), "unknown line"),
    ("twice.ply", LITTLE.replace(b"property float y", b"property float z"), "unexpected length"),
    ("axis.ply", LITTLE.replace(b"property float y", b"property float w"), "damaged"),
    ("none.ply", LITTLE.replace(b"element face", b"element fade"), "damaged"),
    ("index.ply", LITTLE.replace(FIRST, struct.pack("<4i", 0, 2, 3, 88)), r"got 0\.\.88"),
    ("below.ply", LITTLE.replace(FIRST, struct.pack("<4i", 0, 2, 3, -1)), r"got -1\.\.7"),
    ("length.ply", LITTLE[:-20] + b"\xff" + LITTLE[-19:], "different lengths"),
    ("nan.ply", LITTLE[:HEAD] + struct.pack("<d", np.nan) + LITTLE[HEAD + 8 :], "finite"),
    ("cut.ply", TEXT[: TEXT.rindex(b"4 1 3")], "ends after 8 vertices and 5 faces"),
    ("cut_row.ply", TEXT[: TEXT.rindex(b"51 102")], "damaged"),
    ("cut_list.ply", writers.ply("ascii", tinted="vertex")[:-3], "ends inside its list"),
    ("word.ply", TEXT.replace(b"4 0 2", b"4 x 2"), "not numbers"),
    ("lines.ply", TEXT + b"1\n" * 80_000, "more lines than the limit"),
    ("mixed.ply", writers.ply("binary_little_endian", mixed=True), "lists of different lengths"),
    ("magic.off", b"NOFF\n3 1 0\n", "not an OFF file"),
    ("count.off", b"OFF\n1000000000 1 0\n0 0 0\n", "more than it can hold"),
    ("minus.off", b"OFF\n-3 1 0\n0 0 0\n", "more than it can hold"),
    ("short.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n", "does not have 3 numbers"),
    ("size.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n9 0 1 2\n", "announces 9 vertices"),
    ("index.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", r"got 0\.\.7"),
    ("short.stl", writers.stl()[:-1], "not an STL file"),
    ("count.stl", writers.stl()[:80] + struct.pack("<I", 2**32 - 1) + writers.stl()[84:], "not an STL file"),
    ("text.stl", b"solid x\nvertex 0 0 0\nvertex 1 0 0\n", "ends inside a triangle"),
    ("nan.stl", writers.stl()[:96] + struct.pack("<f", np.nan) + writers.stl()[100:], "finite"),
    ("magic.glb", b"glTX" + changed()[4:], "incorrect header"),
    ("length.glb", changed() + b"\0", "not a glTF of"),
    ("version.glb", b"glTF\1\0\0\0" + changed()[8:], "only GLTF 2"),
    ("chunk.glb", changed()[:12] + struct.pack("<I", 10**9) + changed()[16:], "damaged"),
    ("first.glb", changed()[:16] + b"BIN\0" + changed()[20:], "no initial JSON"),
    ("accessor.glb", changed(**accessor(0, count=10**9)), "more than it can hold"),
    ("indices.glb", changed(**accessor(1, count=3000)), "more than it can hold|limit of 1000"),
    ("every.glb", changed(**accessor(1, count=10**12)), "whole number|more than it can hold"),
    ("zeros.glb", changed(**accessor(0, count=10**9, bufferView=None)), "sparse or empty"),
    ("sparse.glb", changed(**accessor(0, sparse={"count": 10**9})), "sparse or empty"),
    ("offset.glb", changed(**accessor(0, byteOffset=-8)), "whole number"),
    ("stride.glb", changed(bufferViews=[{"buffer": 0, "byteLength": 96, "byteStride": -9}] * 2), "whole number"),
    ("kind.glb", changed(**accessor(0, componentType=77)), "damaged"),
    ("width.glb", changed(**accessor(0, type="VEC2")), "damaged"),
    ("index.glb", changed(**accessor(1, bufferView=0)), "names vertex"),
    ("cycle.glb", changed(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]), "not a tree"),
    ("self.glb", changed(nodes=[{"mesh": 0, "children": [0]}]), "not a tree"),
    ("shared.glb", changed(nodes=[{"children": [1, 1]}, {"mesh": 0}]), "not a tree"),
    ("missing.glb", changed(nodes=[{"mesh": 7}]), "damaged"),
    ("child.glb", changed(nodes=[{"mesh": 0, "children": [9]}]), "not a tree"),
    ("copies.glb", changed(nodes=[{"mesh": 0}] * 500, scenes=[{"nodes": list(range(500))}]), "limit of 1000"),
    ("nan.glb", changed(nodes=[{"mesh": 0, "scale": [float("nan"), 1, 1]}]), "finite"),
    ("infinite.glb", changed(nodes=[{"mesh": 0, "scale": [1e300, 1, 1]}]), "1e15"),
    ("matrix.glb", changed(nodes=[{"mesh": 0, "matrix": [1, 2]}]), "damaged"),
    ("draco.glb", changed(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco"),
    ("packed.glb", changed(meshes=[{"primitives": [PACKED]}]), "compressed"),
    ("strip.glb", changed(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]), "strips, fans"),
    ("lines.glb", changed(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}]), "holds no face"),
    ("list.gltf", b"[]", "damaged"),
    ("nesting.gltf", b"[" * 200_000, "damaged"),
    ("text.gltf", b"not json", "damaged"),
    ("uri.gltf", text(buffers=[{"byteLength": 9, "uri": "../../etc/passwd"}]), "outside"),
    ("http.gltf", text(buffers=[{"byteLength": 9, "uri": "http://a.b/c"}]), "outside"),
    ("none.gltf", text(buffers=[{"byteLength": 10**11}]), "damaged"),
    ("lie.gltf", text(buffers=[{"byteLength": 999, "uri": "data:;base64,AAAA"}]), "fewer bytes"),
    ("base.gltf", text(buffers=[{"byteLength": 9, "uri": "data:;base64,A!"}]), "base64|damaged"),
    ("scene.blend", b"BLENDER", "expected a name that ends in one of glb, gltf, obj"),
    ("archive.3mf", b"PK", "expected a name that ends in"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "match"), ATTACKS, ids=[name for name, *_ in ATTACKS])
def test_lies_are_refused(tmp_path, name, content, match):
    refused(tmp_path, name, content, match, max_faces=1000)


@pytest.mark.parametrize("name", ["sparse.glb", "nan.obj"])
def test_lies_are_refused_by_the_guarded_process_too(tmp_path, name):
    _, content, match = next(attack for attack in ATTACKS if attack[0] == name)
    refused(tmp_path, name, content, match, max_faces=1000, guarded=True)


@pytest.mark.parametrize(
    ("library", "match"),
    [("../outside.mtl", "outside its folder"), ("/etc/passwd", "outside its folder"), ("a\x07b.mtl", "unusable")],
)
def test_materials_stay_in_the_folder(tmp_path, library, match):
    (tmp_path / "outside.mtl").write_bytes(writers.mtl(list("abcdef")))
    (tmp_path / "inner").mkdir()
    refused(tmp_path, "inner/cube.obj", writers.obj(materials=list("abcdef"), library=library), match)


def test_a_link_to_materials_outside_is_refused(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "secret").write_bytes(writers.mtl(list("abcdef")))
    (tmp_path / "inner" / "cube.mtl").symlink_to(tmp_path / "secret")
    refused(tmp_path, "inner/cube.obj", writers.obj(materials=list("abcdef")), "outside its folder")


@pytest.mark.parametrize("text", ["newmtl a\nKd 1 x 0\n", "newmtl a\nKd 1 0\n", "newmtl a\nKd 1 nan 0\n", "\0"])
def test_materials_are_checked(tmp_path, text):
    (tmp_path / "cube.mtl").write_text(text)
    refused(tmp_path, "cube.obj", writers.obj(materials=list("abcdef")), "three|zero byte")


def test_missing_files_folders_and_pipes(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        load_mesh(tmp_path / "nothing.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(DataError, match="no such file"):
        load_mesh(tmp_path / "folder.obj")


@pytest.mark.parametrize("name", list(writers.samples()))
def test_damaged_bytes_give_a_data_error_or_a_mesh(tmp_path, name):
    original = writers.samples()[name]
    path = tmp_path / name
    rng = np.random.default_rng(0)
    refusals = 0
    for _ in range(60):
        content = bytearray(original)
        for _ in range(int(rng.integers(1, 6))):
            content[int(rng.integers(len(content)))] = int(rng.integers(256))
        path.write_bytes(bytes(content[: int(rng.integers(len(content)))] if rng.random() < 0.2 else content))
        try:
            mesh = load_mesh(path, max_faces=10_000)
            assert np.isfinite(mesh.vertices).all()
        except DataError:
            refusals += 1
    assert refusals > 5
    assert list(tmp_path.iterdir()) == [path]


MUTATE = """
import resource, sys, warnings
from pathlib import Path
limit = 1 << 30
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.path.append(sys.argv[1])
import numpy as np
from mesh_parsing import parse_mesh
warnings.simplefilter("error")
done = refused = 0
for path in sorted(Path(sys.argv[2]).iterdir()):
    original = path.read_bytes()
    rng = np.random.default_rng(int(sys.argv[3]))
    for _ in range(int(sys.argv[4])):
        content = bytearray(original)
        for _ in range(int(rng.integers(1, 6))):
            kind, at = int(rng.integers(4)), int(rng.integers(len(content)))
            if kind == 0:
                content[at] = int(rng.integers(256))
            elif kind == 1:
                content[at : at + 4] = rng.choice([b"\\xff" * 4, b"\\xff\\xff\\xff\\x7f", bytes(4), b"9999", b"-1e9"])
            elif kind == 2:
                del content[at : at + int(rng.integers(1, 20))]
            else:
                content[at:at] = content[int(rng.integers(len(content))) :][: int(rng.integers(1, 60))]
            if not content:
                content = bytearray(b"x")
        done += 1
        try:
            parse_mesh(bytes(content), path.suffix[1:], 10_000, {})
        except ValueError:
            refused += 1
# Not getrusage, whose peak counts what the process was before it became this one.
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(done, refused, int(peak.split()[1]) // 1024)
"""


@pytest.mark.parametrize(("seed", "trials"), [(0, 100), pytest.param(1, 5000, marks=pytest.mark.long)])
def test_mutated_files_in_little_memory(tmp_path, seed, trials):
    for name, content in writers.samples().items():
        (tmp_path / name).write_bytes(content)
    parsers = Path(mesh_parsing.__file__).parent
    command = [sys.executable, "-I", "-c", MUTATE, str(parsers), str(tmp_path), str(seed), str(trials)]
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    done, refusals, megabytes = map(int, result.stdout.split())
    assert done == trials * len(writers.samples())
    assert refusals > done // 4
    assert megabytes <= 512
