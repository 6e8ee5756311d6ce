"""``lsmgeo info``: what it prints, draws, and returns to a script."""

import numpy as np
import pytest
from PIL import Image

from lsmgeo import cli
from lsmgeo.diagnosis.findings import Check, Findings, report
from tests.data.writers import make_scene, write_colmap, write_middlebury
from tests.diagnosis.textured import on_an_arc, trace, write


@pytest.fixture(scope="module")
def traced():
    return trace(*on_an_arc(4))


def middlebury(traced, folder, E):
    """A *_par.txt written by hand."""
    scene = write(traced, folder)
    lines = [str(len(scene))]
    for name, K, pose in zip(scene.names, traced.K, E, strict=True):
        numbers = (*K.ravel(), *pose[:3, :3].ravel(), *pose[:3, 3])
        lines.append(" ".join([name, *(repr(float(number)) for number in numbers)]))
    (folder / "scene_par.txt").write_text("\n".join(lines) + "\n")
    return folder


def run(path, out, capsys):
    status = cli.main(["info", str(path), "--out", str(out)])
    return status, capsys.readouterr()


def test_a_good_scene_has_status_0(traced, tmp_path, capsys):
    status, printed = run(middlebury(traced, tmp_path / "scene", traced.E), tmp_path / "out", capsys)
    assert status == 0
    assert printed.err == ""
    lines = printed.out.splitlines()
    assert "format:           middlebury" in lines
    assert "images:           4, 320 x 240" in lines
    assert "verdict:          good: the cameras fit the data" in lines
    (line,) = [line for line in lines if line.startswith("epipolar error of matched features")]
    assert " ok " in line
    assert len(lines) <= 25
    assert max(map(len, lines)) < 200
    for name in ("cameras.png", "matches.png"):
        assert str((tmp_path / "out" / name).resolve()) in printed.out
        with Image.open(tmp_path / "out" / name) as image:
            assert min(image.size) > 300
            assert np.asarray(image.convert("RGB")).std() > 5


def test_an_error_has_status_1(traced, tmp_path, capsys):
    status, printed = run(middlebury(traced, tmp_path / "scene", np.linalg.inv(traced.E)), tmp_path / "out", capsys)
    assert status == 1
    assert "verdict:          BAD, the likely cause: poses inverted" in printed.out
    assert "remedy:" in printed.out
    assert "FAILED" in printed.out


def test_what_cannot_be_read_has_status_2(traced, tmp_path, capsys):
    status, printed = run(tmp_path / "nowhere", tmp_path / "out", capsys)
    assert status == 2
    assert "no such file or folder" in printed.err
    scene = middlebury(traced, tmp_path / "scene", traced.E)
    (scene / "frame_2.png").write_bytes((scene / "frame_2.png").read_bytes()[:3000])
    status, printed = run(scene, tmp_path / "out", capsys)
    assert status == 2
    assert "frame_2.png" in printed.err
    assert not (tmp_path / "out").exists()


def test_nothing_measured_has_status_3(traced, tmp_path, capsys):
    blank = type(traced)(traced.K, traced.E, np.full_like(traced.images, 99), traced.depth, traced.mask)
    status, printed = run(middlebury(blank, tmp_path / "scene", traced.E), tmp_path / "out", capsys)
    assert status == 3
    assert "unknown: nothing could be measured" in printed.out
    assert "because:          no features were found in 4 images" in printed.out
    assert "what to do:       They are blank or blurred: add" in printed.out
    assert "check " not in printed.out


@pytest.mark.parametrize("form", ["text", "binary"])
def test_a_colmap_model_is_measured_at_its_points(form, tmp_path, capsys):
    status, printed = run(write_colmap(make_scene(), tmp_path / "scene", form=form), tmp_path / "out", capsys)
    assert status == 0
    assert "reprojection error of sparse points" in printed.out
    assert "sparse points:    42, 210 observations" in printed.out


def test_the_other_commands_return_0_as_before(tmp_path, capsys):
    scene = write_middlebury(make_scene(), tmp_path / "scene")
    assert cli.main(["reconstruct", str(scene), "--size", "48", "--out", str(tmp_path / "out")]) == 0


def test_voxels_have_their_own_examination(tmp_path, capsys, monkeypatch):
    content = np.zeros((2, 2, 2), np.uint8)
    content[0] = 1
    header = b"#binvox 1\ndim 2 2 2\ntranslate 0 0 0\nscale 1\ndata\n"
    (tmp_path / "solid.binvox").write_bytes(header + bytes([1, 4, 0, 4]))
    status, printed = run(tmp_path / "solid.binvox", tmp_path / "out", capsys)
    assert status == 3
    assert "because:          there is no mesh beside the voxels" in printed.out
    assert printed.out.splitlines()[-1] == "no figures are drawn of voxels only"
    assert not (tmp_path / "out").exists()


def test_a_single_image_cannot_be_compared(tmp_path, capsys):
    alone = trace(*on_an_arc(1))
    status, printed = run(middlebury(alone, tmp_path / "scene", alone.E), tmp_path / "out", capsys)
    assert status == 3
    assert "there is only one image" in printed.out
    assert "1 images" not in printed.out
    assert (tmp_path / "out" / "cameras.png").exists()


def test_a_report_without_checks_and_cause():
    assert "unknown" in report(Findings((), (), None))
    check = Check("epipolar error of matched features", float("inf"), "px", 1.0, 0, "matches")
    assert "infinite px" in report(Findings((), (check,), None))
