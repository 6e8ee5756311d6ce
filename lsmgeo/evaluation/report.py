"""Reports: measures of every shape, their means with standard errors, tables, and how all of it is written."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from lsmgeo.data import write_atomic, write_point_cloud
from lsmgeo.metrics import category_means, voxel_iou

__all__ = [
    "Cell",
    "Report",
    "Row",
    "Scores",
    "Table",
    "finite",
    "format_table",
    "iou_by_view",
    "joined",
    "means_of",
    "standard_error",
    "write_report",
]

MARK = "*"


class Cell(NamedTuple):
    """A number of a table."""

    value: float
    error: float = math.nan  # its standard error, where it is known


class Row(NamedTuple):
    """A line of a table."""

    name: str
    cells: Sequence[Cell | None]
    is_elsewhere: bool = False  # measured on other data, by others


class Table(NamedTuple):
    """A table of numbers.

    Attributes:
        key: its name in files.
        title: what it shows, with units.
        columns: the names of the columns.
        rows: the lines.
        digits: decimal places, as printed.
        footnote: a remark on a number.
    """

    key: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    digits: int = 1
    footnote: str = ""


@dataclass(frozen=True)
class Report:
    """The results of one evaluation.

    Attributes:
        name: of the report.
        tables: the tables to print.
        facts: the data, the models and the settings.
        shapes: the measures of every shape, for JSON.
        pictures: PNG files by name, without the extension.
        clouds: positions (N, 3) and colours (N, 3) uint8 of point clouds by name.
        notes: warnings for the reader.
    """

    name: str
    tables: Sequence[Table]
    facts: Mapping[str, Any]
    shapes: Sequence[Mapping[str, Any]] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    notes: Sequence[str] = ()


def format_table(table: Table) -> str:
    """A table as text: names on the left, numbers aligned, each followed by its standard error.

    Example:
        >>> rows = [Row("V-LSM", [Cell(61.54, 0.42), Cell(72.1)]), Row("paper", [Cell(61.5), None], True)]
        >>> print(format_table(Table("iou", "IoU [%]", ["1", "2"], rows)))
        IoU [%]           1     2
        V-LSM    61.5 ± 0.4  72.1
        paper*         61.5     -
        * other data
    """
    lines = [[table.title, *table.columns]]
    for row in table.rows:
        cells = [_shown(cell, table.digits) for cell in row.cells]
        lines.append([row.name + MARK * row.is_elsewhere, *cells])
    widths = [max(len(line[place]) for line in lines) for place in range(len(lines[0]))]
    text = [
        "  ".join(
            item.ljust(width) if place == 0 else item.rjust(width)
            for place, (item, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    if any(row.is_elsewhere for row in table.rows):
        text.append(f"{MARK} other data")
    if table.footnote:
        text.append(table.footnote)
    return "\n".join(text)


def _shown(cell: Cell | None, digits: int) -> str:
    if cell is None or math.isnan(cell.value):
        return "-"
    error = "" if math.isnan(cell.error) else f" ± {cell.error:.{digits}f}"
    return f"{cell.value:.{digits}f}{error}"


def write_report(report: Report, folder: str | PathLike[str]) -> list[Path]:
    """Write a report: all of it as JSON, its tables as CSV, its images and its point clouds.

    Args:
        report: the results.
        folder: created if it does not exist.

    Returns:
        The files written.

    Raises:
        DataError: a file cannot be written; no incomplete file is left.
    """
    folder = Path(folder)
    written = [
        write_atomic(folder / f"{report.name}.json", (json.dumps(_plain(report), indent=1) + "\n").encode()),
        write_atomic(folder / f"{report.name}.csv", _as_csv(report.tables).encode()),
    ]
    written += [write_atomic(folder / f"{name}.png", content) for name, content in report.pictures.items()]
    for name, (positions, colours) in report.clouds.items():
        if len(positions):
            written.append(write_point_cloud(folder / f"{name}.ply", positions, colours))
    return written


def _as_csv(tables: Sequence[Table]) -> str:
    """One line per number: table, row, whether it is from other data, column, value, standard error."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(("table", "row", "other_data", "column", "value", "standard_error"))
    for table in tables:
        for row in table.rows:
            for column, cell in zip(table.columns, row.cells, strict=True):
                if cell is not None:
                    numbers = ("" if math.isnan(number) else f"{number:.6g}" for number in cell)
                    writer.writerow((table.key, row.name, int(row.is_elsewhere), column, *numbers))
    return buffer.getvalue()


def _plain(report: Report) -> dict[str, Any]:
    """A report without its images and clouds, for JSON."""
    tables = []
    for table in report.tables:
        rows = [
            {
                "name": row.name,
                "other_data": row.is_elsewhere,
                "values": [None if cell is None else cell.value for cell in row.cells],
                "standard_errors": [None if cell is None else cell.error for cell in row.cells],
            }
            for row in table.rows
        ]
        head = {"key": table.key, "title": table.title, "footnote": table.footnote}
        tables.append({**head, "columns": list(table.columns), "rows": finite(rows)})
    return {
        "report": report.name,
        "facts": dict(report.facts),
        "notes": list(report.notes),
        "tables": tables,
        "shapes": finite(list(report.shapes)),
    }


def finite(value: Any) -> Any:
    """The same with nine decimal places, and None for numbers that are not finite, which JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else None
    return value


@dataclass(eq=False)
class Scores:
    """A measure of N shapes under K conditions, such as numbers of views, collected batch by batch.

    Attributes:
        names: of the shapes.
        categories: of the shapes.
        values: K numbers for each shape.
    """

    names: list[str] = field(default_factory=list)
    categories: list[str] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)

    def add(self, names: Iterable[str], categories: Iterable[str | None], values: Tensor) -> None:
        """Add B shapes with their categories, if any, and their values (B, K)."""
        self.names += names
        self.categories += [category or "all" for category in categories]
        self.values += values.double().tolist()

    def column(self, place: int) -> list[float]:
        """The numbers under one condition."""
        return [numbers[place] for numbers in self.values]

    def cells(self, factor: float = 1.0) -> list[Cell]:
        """The mean over categories with its standard error, under every condition."""
        conditions = range(len(self.values[0]) if self.values else 0)
        return [means_of(self.column(place), self.categories, factor) for place in conditions]

    def category_cells(self, place: int, categories: Sequence[str], factor: float = 1.0) -> list[Cell]:
        """The means of some categories and, last, of all, under one condition."""
        means = category_means(self.column(place), self.categories).categories
        cells = [Cell(factor * means.get(name, math.nan)) for name in categories]
        return [*cells, means_of(self.column(place), self.categories, factor)]

    def by_shape(self, key: str) -> list[dict[str, Any]]:
        """Name, category and numbers of every shape, for JSON."""
        return [
            {"name": name, "category": category, key: values}
            for name, category, values in zip(self.names, self.categories, self.values, strict=True)
        ]


def means_of(values: Sequence[float], categories: Sequence[str], factor: float = 1.0) -> Cell:
    """The mean of the means of the categories and its standard error, times a factor."""
    mean = category_means(values, categories).mean
    return Cell(factor * mean, abs(factor) * standard_error(values, categories))


def standard_error(values: Sequence[float], categories: Sequence[str]) -> float:
    """The standard error of the mean of the means of categories, whose shapes are a random sample.

    Equation: ``sqrt(sum_c s_c^2 / n_c) / C`` with s_c^2 the unbiased variance within category c of n_c shapes; a
    category with one shape takes the pooled variance of the others.

    Args:
        values: one number per shape; NaN is left out.
        categories: the category of each.

    Returns:
        NaN where no category has two shapes.

    Example:
        >>> round(standard_error([0.5, 0.7, 0.2, 0.4], ["car", "car", "lamp", "lamp"]), 4)
        0.0707
    """
    groups: dict[str, list[float]] = {}
    for value, category in zip(values, categories, strict=True):
        if not math.isnan(value):
            groups.setdefault(category, []).append(value)
    squares = [float(np.var(group)) * len(group) for group in groups.values()]
    freedom = sum(len(group) - 1 for group in groups.values())
    if freedom == 0:
        return math.nan
    pooled = sum(squares) / freedom
    variances = [
        square / (len(group) - 1) if len(group) > 1 else pooled
        for square, group in zip(squares, groups.values(), strict=True)
    ]
    total = sum(variance / len(group) for variance, group in zip(variances, groups.values(), strict=True))
    return math.sqrt(total) / len(groups)


def iou_by_view(predicted: Tensor, occupancy: Tensor, threshold: float = 0.4) -> Tensor:
    """IoU (B, V) of predictions after every view (B, V, D, H, W) and the truth (B, D, H, W), NaN if that is empty."""
    return voxel_iou(predicted, occupancy[:, None].expand(predicted.shape), threshold=threshold, skip_empty=True)


def joined(scores: Mapping[str, Scores], key: str) -> list[dict[str, Any]]:
    """The measures of every shape by method, for JSON."""
    first = next(iter(scores.values()))
    return [
        {"name": name, "category": category, key: {method: one.values[place] for method, one in scores.items()}}
        for place, (name, category) in enumerate(zip(first.names, first.categories, strict=True))
    ]
