"""Means of categories and their standard errors, against numpy and against repeated draws."""

import json
import math

import numpy as np
import pytest
import torch

from lsmgeo.evaluation import Cell, Report, Row, Table, format_table, write_report
from lsmgeo.evaluation.report import Scores, means_of, standard_error


def test_the_standard_error_is_the_spread_of_repeated_draws():
    generator = np.random.default_rng(0)
    names = ["a"] * 4 + ["b"] * 9
    means, estimates = [], []
    for _ in range(3000):
        values = np.r_[generator.normal(1.0, 0.5, 4), generator.normal(3.0, 0.1, 9)]
        means.append((values[:4].mean() + values[4:].mean()) / 2)
        estimates.append(standard_error(values.tolist(), names) ** 2)
    np.testing.assert_allclose(np.mean(estimates), np.var(means), rtol=0.06)
    np.testing.assert_allclose(np.mean(estimates), (0.5**2 / 4 + 0.1**2 / 9) / 4, rtol=0.06)


def test_what_is_missing_counts_nowhere():
    assert math.isnan(standard_error([0.5, 0.6], ["a", "b"]))
    assert standard_error([0.5, 0.7, math.nan], ["a", "a", "b"]) == pytest.approx(0.1)
    cell = means_of([0.2, math.nan, 0.4, 0.8], ["a", "a", "a", "b"], 100)
    assert cell.value == pytest.approx(55.0)


def test_scores_come_in_batches():
    scores = Scores()
    scores.add(["1", "2"], ["a", None], torch.tensor([[0.1, 0.2], [0.3, 0.4]]))
    scores.add(["3"], ["a"], torch.tensor([[0.5, 0.6]]))
    assert scores.categories == ["a", "all", "a"]
    np.testing.assert_allclose([cell.value for cell in scores.cells()], [0.3, 0.4], rtol=1e-6)
    np.testing.assert_allclose(
        [cell.value for cell in scores.category_cells(1, ["a", "c"])], [0.4, math.nan, 0.4], rtol=1e-6
    )


def test_nothing_that_json_has_not_is_written(tmp_path):
    table = Table("t", "title", ["x", "y"], [Row("r", [Cell(math.nan), None]), Row("s", [Cell(1.5, 0.25), Cell(2.0)])])
    report = Report("bare", [table], {}, [{"value": math.inf, "many": [math.nan, 1.0]}])
    write_report(report, tmp_path)
    written = json.loads((tmp_path / "bare.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert written["tables"][0]["rows"][0]["values"] == [None, None]
    assert written["shapes"] == [{"value": None, "many": [None, 1.0]}]
    assert format_table(table).splitlines()[1:] == ["r              -    -", "s      1.5 ± 0.2  2.0"]
