"""``lsmgeo evaluate``: every report end to end, on untrained models."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import cli
from lsmgeo.data import Recipe, render_set
from lsmgeo.models import create
from lsmgeo.models.weights import write_weights

VARIANTS = {
    "": {},
    "-first": {"categories": "first"},
    "-second": {"categories": "second"},
    "-bg": {"background": "random"},
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with tiny untrained models, as if trained on this and that."""
    folder = tmp_path_factory.mktemp("weights")
    with torch.random.fork_rng():
        for name in ("voxel-lsm", "depth-lsm", "r2n2", "r2n2-pose"):
            for variant, data in VARIANTS.items():
                torch.manual_seed(len(variant))
                model = create(name, preset="tiny")
                write_weights(folder / f"{name}{variant}.safetensors", model, about={"training": {"data": data}})
    return folder


def run(out, *arguments):
    assert cli.main(["evaluate", *map(str, arguments), "--out", str(out)]) == 0
    names = {path.name for path in out.iterdir()}
    for name in names:
        if name.endswith(".png"):
            with Image.open(out / name) as opened:
                picture = np.array(opened.convert("RGB"))
            assert min(picture.shape[:2]) > 150
            assert picture.std() > 5
    return names


def test_iou_of_a_model_is_printed_and_written(weights, tmp_path, capsys):
    made = run(tmp_path, weights / "voxel-lsm.safetensors", "--shapes", 2, "--views", 2)
    assert made == {"iou.json", "iou.csv", "iou.png"}
    printed = capsys.readouterr().out
    for words in ("2 test shapes of synthetic-13", "V-LSM", "visual hull, strict", "paper, V-LSM*", "* other data"):
        assert words in printed
    written = json.loads((tmp_path / "iou.json").read_text())
    assert [shape["category"] for shape in written["shapes"]] == ["airplane", "bench"]
    assert written["facts"]["models"][0]["network"] == "voxel-lsm"


def test_depth_of_a_model_is_printed_and_written(weights, tmp_path, capsys):
    made = run(tmp_path, weights / "depth-lsm.safetensors", "--shapes", 1, "--views", 2, "--planes", 16)
    assert made == {"depth.json", "depth.csv", "depth.png"}
    with Image.open(tmp_path / "depth.png") as picture:
        assert picture.width > 4 * 160 + 3 * 4  # the view, the truth, the sweep and the model
        assert picture.height > 160
    printed = capsys.readouterr().out
    assert "plane sweep" in printed
    assert "paper, D-LSM*" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{weights}/nothing.safetensors"], "nothing.safetensors: "),
        ([","], "checkpoints must name at least one model"),
        (["{weights}/r2n2.safetensors,{weights}/r2n2.safetensors"], "two are called '3D-R2N2'"),
        (["{weights}/r2n2.safetensors", "--report", "all"], "report must be one of"),
        (["{weights}/r2n2.safetensors", "--report", "clouds"], "report 'clouds' measures depth"),
        (["{weights}/r2n2.safetensors", "--report", "unseen"], "of 3D-R2N2 there are: 3D-R2N2 (on all)"),
        (["{weights}/r2n2.safetensors", "--degrees", "5,many"], "degrees must be numbers separated by commas"),
        (["{weights}/r2n2.safetensors", "--shards", "{weights}"], "holds no shard"),
        (["{weights}/r2n2.safetensors", "--shapes", "0"], "shapes must be"),
        (["{weights}/r2n2.safetensors", "--device", "abacus"], "device must be"),
    ],
)
def test_what_cannot_be_evaluated_is_told_in_one_line(weights, tmp_path, capsys, arguments, message):
    arguments = [argument.format(weights=weights) for argument in arguments]
    assert cli.main(["evaluate", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("lsmgeo: error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.long
@pytest.mark.parametrize(
    ("report", "models", "pictures"),
    [
        ("iou", "voxel-lsm,r2n2,r2n2-pose", 1),
        ("backgrounds", "voxel-lsm,voxel-lsm-bg", 1),
        ("unseen", "voxel-lsm,voxel-lsm-first,voxel-lsm-second,r2n2-pose,r2n2-pose-first,r2n2-pose-second", 1),
        ("pose-noise", "voxel-lsm,r2n2-pose", 1),
        ("order", "voxel-lsm", 1),
        ("sequences", "voxel-lsm,r2n2-pose", 3),
        ("depth", "depth-lsm", 1),
        ("clouds", "depth-lsm", 2),
    ],
)
def test_every_report_runs_on_shards(weights, tmp_path, tmp_path_factory, report, models, pictures):
    folder = tmp_path_factory.getbasetemp() / "shards"
    if not folder.exists():
        render_set("synthetic-13", folder, Recipe(0, 20, 32, (16, 32)), shapes=65, jobs=1)
    paths = ",".join(f"{weights}/{name}.safetensors" for name in models.split(","))
    number = {"unseen": 13, "sequences": 3}.get(report, 2)
    made = run(tmp_path, paths, "--report", report, "--shards", folder, "--shapes", number, "--planes", 40)
    assert {f"{report}.json", f"{report}.csv"} <= made
    assert sum(name.endswith(".png") for name in made) == pictures
    assert sum(name.endswith(".ply") for name in made) == (18 if report == "clouds" else 0)
