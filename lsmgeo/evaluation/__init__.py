"""The tables and figures of the paper, measured on any checkpoint: one module each."""

from lsmgeo.evaluation.evaluate import REPORTS, evaluate
from lsmgeo.evaluation.held_out_shapes import Shapes, open_shapes
from lsmgeo.evaluation.methods import Contender, Training, open_contenders
from lsmgeo.evaluation.options import Options
from lsmgeo.evaluation.report import Cell, Report, Row, Table, format_table, write_report

__all__ = [
    "REPORTS",
    "Cell",
    "Contender",
    "Options",
    "Report",
    "Row",
    "Shapes",
    "Table",
    "Training",
    "evaluate",
    "format_table",
    "open_contenders",
    "open_shapes",
    "write_report",
]
