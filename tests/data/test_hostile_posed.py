"""Files of cameras that lie: every one gives a DataError that names a file of its scene, and opens none beside it."""

import json
import os
import struct
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.data.hostile import TRIALS, judged, mutated, read_scene, scene_refused
from tests.data.posed_writers import llff_rows, save, write_plain_cameras, write_strecha, write_transforms
from tests.data.writers import make_scene, write_colmap
from tests.fuzz import forked

# A reader that hangs or expands a small file without end is stopped, and fails.
pytestmark = pytest.mark.timeout(120)
FULL = make_scene(24, 32)
SCENE = FULL._replace(names=FULL.names[:2], K=FULL.K[:2], R=FULL.R[:2], t=FULL.t[:2], images=FULL.images[:2])
STRECHA = ["0000.png", "0001.png"]


def write(form, folder):
    """A scene of two images; the files whose bytes are attacked."""
    if form in ("transforms", "bent"):
        change = (lambda values: values.update(k1=-0.1)) if form == "bent" else None
        return [write_transforms(SCENE, folder, change, list(SCENE.images)) / "transforms.json"]
    if form == "cameras":
        return [write_plain_cameras(SCENE, folder) / "cameras.json"]
    if form == "strecha":
        return [write_strecha(SCENE, folder, folder, STRECHA) / "0001.png.camera"]
    if form == "llff":
        save(list(SCENE.images), SCENE.names, folder / "images")
        np.save(folder / "poses_bounds.npy", llff_rows(SCENE, 150.0))
        return [folder / "poses_bounds.npy"]
    write_colmap(SCENE, folder, form="text")
    file = folder / "sparse/0/cameras.txt"
    file.write_text("1 OPENCV 32 24 150 150 14 13 -0.1 0.02 0.001 0.002\n2 RADIAL_FISHEYE 32 24 150 14 13 0.1 0.01\n")
    if form == "colmap binary":
        (folder / "sparse/0").rename(folder / "text")
        write_colmap(SCENE, folder, form="binary")
        head = struct.pack("<Q", 2) + struct.pack("<iiQQ8d", 1, 4, 32, 24, 150, 150, 14, 13, -0.1, 0.02, 0.001, 0.002)
        file = folder / "sparse/0/cameras.bin"
        file.write_bytes(head + struct.pack("<iiQQ5d", 2, 9, 32, 24, 150, 14, 13, 0.1, 0.01))
    return [file]


DEEP = 200_000
TEXTS = {
    "nothing": b"",
    "null": b"null",
    "a list": b"[]",
    "no entries": b"{}",
    "another encoding": '{"frames": [], "cameras": []}'.encode("utf-16"),
    "a zero byte": b'{"frames": [1], "cameras": [{"K": 1}]}\0',
    "invalid UTF-8": b'{"frames": ["\xff"]}',
    "a list without end": b"[" * DEEP,
    "an object without end": b'{"frames": [' * DEEP,
    "a closed list without end": b'{"frames": ' + b"[" * DEEP + b"]" * DEEP + b"}",
    "cut off": b'{"frames": [{"file_path": "images/v0.png", "transform_ma',
    "not a number": b'{"frames": [{"file_path": "images/v0.png", "fl_x": NaN}], "cameras": [{"K": NaN}]}',
    "a number beyond all": b'{"frames": [{"file_path": "images/v0.png", "fl_x": ' + b"9" * 5000 + b"}]}",
    "a key twice": b'{"frames": [], "frames": [], "cameras": [], "cameras": []}',
    "too long": b'{"frames": [], "cameras": []}' + b" " * (1 << 24),
    "entries of another kind": b'{"frames": [7], "format": "lsmgeo cameras", "cameras": [7]}',
    "entries that are none": b'{"frames": {"0": 1}, "format": "lsmgeo cameras", "cameras": {"0": 1}}',
    "a million frames": b'{"frames": [' + b"0," * 999_999 + b"0]}",
    "a million cameras": b'{"format": "lsmgeo cameras", "cameras": [' + b"0," * 999_999 + b"0]}",
}  # fmt: skip


@pytest.mark.parametrize("form", ["transforms", "cameras"])
@pytest.mark.parametrize("attack", TEXTS)
def test_json_that_lies_is_refused(tmp_path, form, attack):
    (file,) = write(form, tmp_path)
    file.write_bytes(TEXTS[attack])
    scene_refused(tmp_path)


NAMES = [
    "../secret.png", "/etc/passwd", "images/../../secret.png", "images", ".", "", "a\0b", "\ud800", "x" * 600,
    "images/link.png", "images/pipe.png", "images/zero.png", "images/loop", "NUL\n", "images/text.png",
]  # fmt: skip


@pytest.mark.parametrize("form", ["transforms", "cameras"])
@pytest.mark.parametrize("name", NAMES)
def test_names_lead_nowhere_else(tmp_path, form, name):
    Image.new("RGB", (32, 24)).save(tmp_path / "secret.png")
    folder = tmp_path / "scene"
    (file,) = write(form, folder)
    (folder / "images/link.png").symlink_to(tmp_path / "secret.png")
    (folder / "images/zero.png").symlink_to("/dev/zero")
    (folder / "images/loop").symlink_to(folder / "images/loop")
    (folder / "images/text.png").write_text("no image")
    os.mkfifo(folder / "images/pipe.png")
    values = json.loads(file.read_text())
    entry = values["frames" if form == "transforms" else "cameras"][1]
    entry["file_path" if form == "transforms" else "file"] = name
    file.write_text(json.dumps(values))
    scene_refused(folder)


NUMBERS = [1e999, -1e300, 1e13, 10**400, True, "5", None, [], {}, 0, -1]


@pytest.mark.parametrize("value", NUMBERS, ids=lambda value: str(value)[:9])
def test_numbers_of_transforms_are_numbers(tmp_path, value):
    (file,) = write("bent", tmp_path)
    original = json.loads(file.read_text())
    for key in ("fl_x", "fl_y", "w", "h", "cx", "k1", "k3", "camera_angle_x", "depth_unit_scale_factor"):
        if key in ("cx", "k1", "k3") and value in (0, -1):
            continue  # these may be
        values = json.loads(json.dumps(original))
        frame = values["frames"][1]
        if key == "camera_angle_x":
            del frame["fl_x"], frame["fl_y"]
        if key == "depth_unit_scale_factor":
            frame["depth_file_path"] = "depth.png"
        frame[key] = value
        file.write_text(json.dumps(values).replace("Infinity", "1e999"))
        scene_refused(tmp_path, f"{key} must|focal lengths must be positive")


@pytest.mark.parametrize("form", ["transforms", "cameras"])
def test_a_key_said_twice_is_refused(tmp_path, form):
    (file,) = write(form, tmp_path)
    text = file.read_text()
    assert len(read_scene(tmp_path)) == 2
    for key in ("w", "transform_matrix", "frames") if form == "transforms" else ("width", "K", "version"):
        at = text.index(f'"{key}": ')
        file.write_text(f'{text[:at]}"{key}": 1, {text[at:]}')
        scene_refused(tmp_path, "uses a key twice")


@pytest.mark.parametrize("value", [1e999, 10**400, True, "5", None, [], 1e13], ids=lambda value: str(value)[:9])
def test_numbers_of_matrices_are_numbers(tmp_path, value):
    for form, entries, key in (
        ("transforms", "frames", "transform_matrix"),
        ("cameras", "cameras", "K"),
        ("cameras", "cameras", "cam_from_world"),
    ):
        folder = tmp_path / key
        (file,) = write(form, folder)
        values = json.loads(file.read_text())
        values[entries][1][key][0][2] = value
        file.write_text(json.dumps(values).replace("Infinity", "1e999"))
        scene_refused(folder, f"{key} must hold finite numbers|holds Infinity")


def npy(header, payload=b"", version=(1, 0)):
    text = header.encode()
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text + payload


ROW = llff_rows(SCENE, 150.0)
GOOD = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 17), }\n"
ARRAYS = {
    "nothing": b"",
    "a zip": b"PK\x03\x04" + bytes(100),
    "the magic alone": b"\x93NUMPY",
    "another version": npy(GOOD, ROW.tobytes(), (9, 0)),
    "a byte missing": npy(GOOD, ROW.tobytes()[:-1]),
    "a byte more": npy(GOOD, ROW.tobytes() + b"\0"),
    "terabytes": npy(GOOD.replace("(2, 17)", "(8000000000, 17)"), ROW.tobytes()),
    "more than 64 bits": npy(GOOD.replace("(2, 17)", f"({2**70}, 17)"), ROW.tobytes()),
    "a side of thousands of digits": npy(GOOD.replace("(2, 17)", f"(0x{'f' * 9000}, 17)"), ROW.tobytes()),
    "negative": npy(GOOD.replace("(2, 17)", "(-2, -17)"), ROW.tobytes()),
    "many sides": npy(GOOD.replace("(2, 17)", "(" + "1, " * 2000 + ")"), ROW.tobytes()),
    "many sides that fit": npy(GOOD.replace("(2, 17)", "(" + "1, " * 2000 + ")"), ROW.tobytes()[:8]),
    "no side": npy(GOOD.replace("(2, 17)", "()"), ROW.tobytes()[:8]),
    "objects": npy(GOOD.replace("<f8", "|O"), ROW.tobytes()),
    "a pickle": npy(GOOD.replace("<f8", "|O").replace("(2, 17)", "(1,)"), b"cos\nsystem\n(S'touch pwned'\ntR."),
    "fields": npy(GOOD.replace("'<f8'", "[('a', '<f8'), ('b', '<f8')]"), ROW.tobytes()),
    "text": npy(GOOD.replace("<f8", "<U9"), ROW.tobytes()),
    "a header without end": npy("(" * 60000),
    "a program": npy("__import__('os').system('touch pwned')"),
    "a header beyond the file": b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(50),
    "not finite": npy(GOOD, np.full((2, 17), np.inf).tobytes()),
    "the largest numbers": npy(GOOD, np.full((2, 17), 1.7e308).tobytes()),
    "zeros": npy(GOOD, bytes(272)),
}


@pytest.mark.parametrize("attack", ARRAYS)
def test_arrays_that_lie_are_refused(tmp_path, monkeypatch, attack):
    (file,) = write("llff", tmp_path)
    file.write_bytes(ARRAYS[attack])
    monkeypatch.chdir(tmp_path)
    scene_refused(tmp_path)
    assert not (tmp_path / "pwned").exists()


def test_llff_images_lead_nowhere_else(tmp_path):
    Image.new("RGB", (32, 24)).save(tmp_path / "secret.png")
    write("llff", tmp_path / "scene")
    (tmp_path / "scene/images/v1.png").unlink()
    (tmp_path / "scene/images/v1.png").symlink_to(tmp_path / "secret.png")
    scene_refused(tmp_path / "scene", "outside its folder")


CAMERA = "150 0 14\n0 150 13\n0 0 1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 -2\n27 21\n"


CONTENTS = [
    b"",
    b"\0",
    b"\xff\xfe1",
    b"nonsense",
    b"1 " * 30_000,
    CAMERA.encode() * 2,
    CAMERA.encode()[:-6],
    CAMERA.encode() + b"#" * (1 << 17),
    *(
        CAMERA.replace(old, new).encode()
        for old, new in (
            ("14", "nan"),
            ("14", "1e999"),
            ("14", "9" * 5000),
            ("14", "0x10"),
            ("27 21", "-27 -21"),
            ("27 21", "1e308 1e308"),
            ("150 0", "1e300 0"),
            ("1 0 0\n0 1 0", "1e200 0 0\n0 1e200 0"),
            ("1 0 0\n0 1 0", "0 0 0\n0 0 0"),
            ("-2", "-1e300"),
        )
    ),
]


@pytest.mark.parametrize("content", CONTENTS, ids=range(len(CONTENTS)))
def test_strecha_files_that_lie_are_refused(tmp_path, content):
    (file,) = write("strecha", tmp_path)
    file.write_text(CAMERA)
    assert len(read_scene(tmp_path)) == 2
    file.write_bytes(content)
    scene_refused(tmp_path)


@pytest.mark.parametrize("name", ["..camera", "0002\n.png.camera", "0002.png.camera", ".camera"])
def test_names_of_strecha_files_lead_nowhere_else(tmp_path, name):
    Image.new("RGB", (32, 24)).save(tmp_path / "secret.png")
    (file,) = write("strecha", tmp_path / "scene")
    (tmp_path / "scene" / name).write_bytes(file.read_bytes())
    (tmp_path / "scene" / "0002.png").symlink_to(tmp_path / "secret.png")
    scene_refused(tmp_path / "scene")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("-0.1 0.02", "nan 0.02", "finite"),
        ("-0.1 0.02", "1e999 0.02", "finite"),
        ("-0.1 0.02", "1e300 0.02", "parameters must be finite"),
        ("-0.1 0.02", "9e6 9e6", "the distortion"),
        ("-0.1 0.02", "-9e6 9e6", "the distortion"),
        ("-0.1 0.02", "-0.1 0.02 5", "OPENCV has 8 parameters; got 9"),
        ("-0.1 0.02", "-0.1", "OPENCV has 8 parameters; got 7"),
        ("150 150", "1e-5 150", "the distortion|focal"),
        ("150 150", "150 -150", "focal lengths positive"),
        ("150 14 13", "-150 14 13", "focal lengths positive"),
        ("14 13 -0.1", "1e6 -1e6 -0.1", "the distortion"),
        ("OPENCV 32 24", "OPENCV 131072 131072", "at most 32766 pixels"),
        ("OPENCV 32 24", "OPENCV 1 1", "the distortion|expects 1 x 1"),
        ("0.1 0.01", "1e6 1e6", "the distortion"),
        ("0.1 0.01", "-1e6 -1e6", "the distortion"),
        ("RADIAL_FISHEYE 32 24 150", "RADIAL_FISHEYE 32 24 1e-3", "the distortion|focal"),
    ],
)
def test_lenses_that_make_no_sense_are_refused(tmp_path, old, new, match):
    (file,) = write("colmap", tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    scene_refused(tmp_path, match)


def watch(folder, opened):
    """Note every file beside the scene's folder that is opened, from now on: in a child process, which ends."""

    def hook(event, arguments):
        if event == "open" and isinstance(arguments[0], str | os.PathLike | bytes):
            name = os.fsdecode(arguments[0])
            if name.startswith(str(folder.parent)) and not name.startswith(str(folder) + "/"):
                opened.append(name)

    sys.addaudithook(hook)


@pytest.mark.parametrize("form", ["transforms", "bent", "cameras", "strecha", "llff", "colmap", "colmap binary"])
def test_mutated_files_are_refused_or_read(tmp_path, form):
    """Beyond errors: no crash, no hang, no gigabytes, no other file."""
    folder = tmp_path / "scene"
    (file,) = write(form, folder)
    Image.new("RGB", (32, 24)).save(tmp_path / "secret.png")
    content = file.read_bytes()
    before = sorted(str(path) for path in tmp_path.rglob("*"))
    opened = []

    def judge(number):
        if not opened:
            # OpenCV's threads do not live on in a forked child.
            cv2.setNumThreads(0)
            opened.append("")
            watch(folder, opened)
        rng = np.random.default_rng([number, len(form)])
        if number % 2:
            changed = bytearray(content)
            for at in rng.integers(len(changed), size=int(rng.integers(1, 4))):
                changed[at] = rng.choice(np.frombuffer(b"0123456789.-e,[]{}/\\ x", np.uint8))
            file.write_bytes(bytes(changed))
        else:
            file.write_bytes(mutated(rng, content))
        came = judged(lambda: read_scene(folder))
        return f"opened {opened[1]}" if len(opened) > 1 else came

    came = forked.outcomes(range(TRIALS), judge)
    assert set(came) <= {"refused", "read"}
    assert came.count("refused") > TRIALS // 5
    assert came.count("read") > 0
    assert sorted(str(path) for path in tmp_path.rglob("*")) == before
