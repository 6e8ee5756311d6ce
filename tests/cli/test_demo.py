"""``lsmgeo demo`` and what the command line does before a command runs."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from lsmgeo import cli
from lsmgeo.demo import run_demo


def test_the_demo_recovers_the_depth_and_draws_it(tmp_path, capsys):
    assert cli.main(["demo", "--out", str(tmp_path / "new")]) == 0
    printed = dict(line.split(":", 1) for line in capsys.readouterr().out.splitlines())
    assert 0 < float(printed["median relative depth error"].strip(" %")) <= 1.0
    assert float(printed["pixels within 1 %"].strip(" %")) >= 70
    path = tmp_path / "new" / "demo.png"
    assert printed["picture"].strip() == str(path.resolve())
    assert [file.name for file in path.parent.iterdir()] == ["demo.png"]
    with Image.open(path) as opened:
        picture = np.array(opened)
    assert min(picture.shape[:2]) > 500
    assert picture.std() > 20


def test_the_demo_s_depth_is_that_of_the_sphere_and_the_floor():
    """The truth of the demonstration, once more by another way: every depth puts its pixel on a surface."""
    result = run_demo(size=(30, 40), voxels=24, planes=16)
    K, E = (value[result.view].numpy() for value in result.cameras[:2])
    v, u = np.nonzero(result.true_depth.numpy())
    assert len(v) > 300
    camera = np.linalg.solve(K, np.stack([u, v, np.ones_like(u)]).astype(float)) * result.true_depth.numpy()[v, u]
    x, y, z = E[:3, :3].T @ (camera - E[:3, 3:])
    distance = np.minimum(np.abs(np.sqrt(x**2 + y**2 + z**2) - 0.4), np.abs(y + 0.4))
    np.testing.assert_allclose(distance, 0, atol=1e-9)
    assert bool((result.true_depth[result.error.isfinite()] > 0).all())


def test_an_unwritable_place_gives_one_line_and_status_2(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert cli.main(["demo", "--out", str(tmp_path / "file")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("lsmgeo: error: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["reconstruct", "--help"]])
def test_questions_about_the_command_end_well(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 0
    assert "lsmgeo" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["dance"], ["reconstruct"], ["reconstruct", ".", "--method", "guess"]])
def test_a_wrong_command_ends_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    assert "error" in capsys.readouterr().err


def test_importing_the_command_line_is_light():
    code = (
        "import sys, lsmgeo; before = set(sys.modules); import lsmgeo.cli; "
        "print(*sorted({name.split('.')[0] for name in set(sys.modules) - before}), "
        "*sorted(name for name in set(sys.modules) - before if name.startswith('lsmgeo')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == ["lsmgeo", "lsmgeo.cli"]
