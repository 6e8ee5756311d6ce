"""``lsmgeo convert`` writes what other programs read, and says what it leaves out."""

import pytest

from lsmgeo import cli, data
from tests.data.posed_writers import write_plain_cameras, write_transforms
from tests.data.writers import make_scene, write_colmap


@pytest.fixture(scope="module")
def scene():
    return make_scene(24, 32)


@pytest.mark.parametrize("form", ["colmap", "transforms", "cameras"])
def test_a_model_is_converted(scene, tmp_path, capsys, form):
    write_colmap(scene, tmp_path / "source", form="binary")
    out = tmp_path / "out"
    assert cli.main(["convert", str(tmp_path / "source"), "--to", form, "--out", str(out)]) == 0
    read = data.open(out)
    assert (read.source, len(read)) == (form, 5)
    printed = capsys.readouterr().out
    assert "scene:       5 images, colmap\n" in printed
    assert f"written:     {form} in {out.resolve()}\n" in printed
    assert ("left out:    points" in printed) == (form != "colmap")
    assert "undistorted:" not in printed


def test_distortion_is_said_to_be_gone(scene, tmp_path, capsys):
    write_transforms(scene, tmp_path / "source", lambda values: values.update(k1=-0.2))
    assert cli.main(["convert", str(tmp_path / "source"), "--out", str(tmp_path / "out")]) == 0
    assert "undistorted: 5 images had lens distortion" in capsys.readouterr().out
    assert data.open(tmp_path / "out").lenses is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "nerf"], "to must be one of"),
        (["--to", "colmap"], "no skew: COLMAP cannot hold"),
        (["--to", "cameras", "--out", "{source}"], "exists and is not an empty folder"),
        (["--to", "cameras", "--jobs", "2"], "splits and jobs are for shards"),
    ],
)
def test_what_cannot_be_written_gives_one_line_and_status_2(scene, tmp_path, capsys, arguments, message):
    source = write_plain_cameras(
        scene, tmp_path / "source", lambda values: values["cameras"][0]["K"][0].__setitem__(1, 2.0)
    )
    given = [argument.format(source=source) for argument in arguments]
    given = given if "--out" in given else [*given, "--out", str(tmp_path / "out")]
    assert cli.main(["convert", str(source), *given]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("lsmgeo: error: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]


def test_the_current_folder_is_not_replaced(scene, tmp_path, capsys, monkeypatch):
    write_colmap(scene, tmp_path / "source", form="binary")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert cli.main(["convert", str(tmp_path / "source"), "--out", "."]) == 2
    assert "is the current folder" in capsys.readouterr().err
    assert list((tmp_path / "here").iterdir()) == []
