"""What a report holds, how it is printed, and how it is written."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lsmgeo.data import write_atomic, write_point_cloud

__all__ = ["Cell", "Report", "Row", "Table", "finite", "format_table", "write_report"]

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
    """Numbers with names.

    Attributes:
        key: what it is called in files.
        title: what it shows, with units.
        columns: the names of the cells.
        rows: the lines.
        digits: behind the point, as printed.
        footnote: what a reader must know of a number.
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
        tables: to be printed.
        facts: what else is to be known: the data, the models, the settings.
        shapes: what was measured of every shape, for JSON.
        pictures: PNG files by their names without ending.
        clouds: positions (N, 3) and colours (N, 3) uint8 of point clouds by their names.
        notes: what a reader must know.
    """

    name: str
    tables: Sequence[Table]
    facts: Mapping[str, Any]
    shapes: Sequence[Mapping[str, Any]] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    notes: Sequence[str] = ()


def format_table(table: Table) -> str:
    """A table as text: names to the left, numbers aligned, standard errors behind them.

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
    """Write a report: all of it as JSON, its tables as CSV, pictures and point clouds.

    Args:
        report: the results.
        folder: created where it does not exist.

    Returns:
        The files written.

    Raises:
        DataError: a file cannot be written; nothing half-written stays.
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
    """One line a number: table, row, whether of other data, column, value, standard error."""
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
    """A report without its pictures and clouds, as JSON can hold it."""
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
        told = {"key": table.key, "title": table.title, "footnote": table.footnote}
        tables.append({**told, "columns": list(table.columns), "rows": finite(rows)})
    return {
        "report": report.name,
        "facts": dict(report.facts),
        "notes": list(report.notes),
        "tables": tables,
        "shapes": finite(list(report.shapes)),
    }


def finite(value: Any) -> Any:
    """The same with nine digits, and None for every number that JSON has not."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else None
    return value
