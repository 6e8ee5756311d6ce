"""The benchmarks: competitors agree, one that differs stops them, each command prints its table.

No time is asserted. What is compiled runs here as it stands, uncompiled.
"""

import json
import re
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as command
from benchmarks import comparing, competitors, compiled, measuring, models, report
from benchmarks.measuring import Settings
from benchmarks.problems import TINY, Problem, Scene

DOCS = Path(__file__).resolve().parents[2] / "docs"
PROBLEMS = {
    "unproject": Problem("unproject", **TINY),
    "unproject contiguous bfloat16": Problem("unproject", dtype="bfloat16", layout="contiguous", **TINY),
    "unproject mean": Problem("unproject", statistic="mean", **TINY),
    "unproject variance": Problem("unproject", statistic="variance", **TINY),
    "unproject nearest mean": Problem("unproject", statistic="mean", mode="nearest", **TINY),
    "sweep": Problem("sweep", **TINY),
    "sweep nearest flattened": Problem("sweep", mode="nearest", flatten=True, **TINY),
    "reduce": Problem("reduce", **TINY),
    "points": Problem("points", **TINY),
    "frustum": Problem("frustum", **TINY),
    "frustum variance": Problem("frustum", statistic="variance", **TINY),
    "frustum dot": Problem("frustum", statistic="dot", **TINY),
}


@pytest.fixture(autouse=True)
def _uncompiled(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    monkeypatch.setattr(compiled, "require_compiler", lambda: None)
    compiled.Graphs.cache_clear()
    yield
    compiled.Graphs.cache_clear()


def test_competitors_compute_the_same_and_each_takes_part_somewhere():
    taking = set()
    for problem in PROBLEMS.values():
        scene = Scene(problem)
        runs, left_out = competitors.gather(scene, competitors.COMPETITORS)
        comparing.check(scene, runs)
        assert set(runs) | set(left_out) == set(competitors.COMPETITORS)
        assert len(runs) >= 3
        taking |= set(runs)
    assert taking == set(competitors.COMPETITORS)


@pytest.mark.parametrize(
    ("fault", "what"),
    [
        (lambda output, visible: (1.001 * output, visible), "values differ"),
        (lambda output, visible: (output, ~visible), "visibility differs"),
        (lambda output, visible: (output.detach() + 0.999 * (output - output.detach()), visible), "gradient differ"),
        (lambda output, visible: (output[:, :1], visible), "shape"),
        (lambda output, visible: (output * torch.nan, visible), "values differ"),
    ],
)
def test_a_competitor_that_differs_is_not_timed(fault, what, monkeypatch):
    honest = competitors.COMPETITORS[competitors.HAND]
    monkeypatch.setitem(competitors.COMPETITORS, "faulty", lambda scene: lambda source: fault(*honest(scene)(source)))
    with pytest.raises(comparing.Different, match=what):
        comparing.timings("work", PROBLEMS["unproject"], ["faulty"], Settings(repeats=1))


def test_a_kernel_that_differs_is_not_timed():
    scene = Scene(PROBLEMS["sweep"])
    run = competitors.ours(scene)
    output, _ = comparing.forward(run, comparing.leaves(scene))
    with pytest.raises(comparing.Different, match="kernel: values differ"):
        comparing.check_kernel(scene, lambda: (1.001 * output, scene.source), run)


@pytest.mark.parametrize("name", models.MODELS)
def test_a_model_that_differs_on_hand_written_operators_is_not_timed(name):
    work = models.Work(name, Settings(quick=True), scenes=2, views=2)
    work.check()
    work.models[competitors.HAND].unproject.sites += 0.02
    with pytest.raises(comparing.Different):
        work.check()


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("operators_contiguous", ["Unproject, variance, forward", "kernel, warm memory", "floor, fresh memory"]),
        ("footprint", ["Sweep and 1x1 map, 32 x 64 to 512, forward", "time grows as voxels to the power, forward"]),
        ("systems", ["Frustum, variance, forward", "kornia DepthWarper", "running mean (Atlas)"]),
        ("cost_volumes", ["4 warped volumes, forward", "repeat and warp : correlation", "through points"]),
        ("splats", ["nearest, 6 views onto 200 x 1 x 200, forward", "outer product, index_add : splat"]),
        ("gpu", ["Sweep, 128^3, nearest, forward+backward", "share of the copy's bandwidth"]),
        ("scenes", ["10 solids, 64 x 64, 1 x 20 views, shadows"]),
        ("render_set", ["lsmgeo render, 4 shapes of 2 views at 64 x 64 with depth and voxels"]),
        ("loading", ["4 of 4 views, 64 x 64, with depth", "4 of 4 views, 64 x 64, no depth"]),
        pytest.param("growth", ["threads = 2, forward", "compiled for one number of threads"], marks=pytest.mark.long),
        pytest.param("models_gpu", ["V-LSM, inference", "D-LSM, bfloat16, 16 x 4 views"], marks=pytest.mark.long),
        pytest.param("imports", ["from lsmgeo import Unproject, VoxelGrid : import"], marks=pytest.mark.long),
        pytest.param("operators_channels_last", ["hand-written : lsmgeo"], marks=pytest.mark.long),
        pytest.param("classical", ["analytic sphere", "TSDF, exact depth", "kornia warps"], marks=pytest.mark.long),
    ],
)
def test_each_command_prints_its_table_and_keeps_what_docs_read(name, printed, tmp_path, monkeypatch, capsys):
    # No process of its own is forked off: that takes seconds each.
    monkeypatch.setattr(measuring, "isolated", lambda function, *arguments, **_: function(*arguments))
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)
    monkeypatch.delenv("LSMGEO_TEST_DATA", raising=False)
    command.main([name, "--quick", "--repeats", "1", "--results", str(tmp_path)])
    shown = capsys.readouterr().out
    assert [words for words in printed if words not in shown] == []
    kept = json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))
    assert measuring.processor() in report.machine_line(kept["machine"])
    for table in tables_of(name):
        assert len(report.TABLES[table](kept["cases"])) > 1


def tables_of(name):
    """The tables that pages show of a command and that have rows also where nothing is left out or compiled."""
    pages = "\n".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("*.rst"))
    return set(re.findall(rf"\.\. benchmark:: {name} ([\w-]+)", pages)) - {"machine", "left-out", "compiling"}


def test_pages_read_all_results_that_are_kept_and_make_tables_of_them():
    pages = "\n".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("*.rst"))
    read = re.findall(r"\.\. benchmark:: (\w+) ([\w-]+)", pages)
    kept = {path.stem: path for path in measuring.RESULTS.glob("*.json")}
    assert set(kept) - {"growth"} <= {name for name, _ in read} <= {*command.BENCHMARKS, "every"}
    for name, table in read:
        if name in kept and table != "machine":
            rows = report.TABLES[table](json.loads(kept[name].read_text(encoding="utf-8"))["cases"])
            assert {len(row) for row in rows} == {len(rows[0])}
            assert len(rows) > 1 or table == "left-out"
